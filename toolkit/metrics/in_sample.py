"""In-sample reprojection: the estimator's own landmarks, projected from its own poses, against its observations."""

import numpy as np

from toolkit.arrays import rows_of
from toolkit.geometry import Array, BoolArray, IntArray, se3_inverse, transform
from toolkit.metrics.parts.evaluation import Evaluation
from toolkit.metrics.parts.residuals import pixel_metrics, pixel_scores, reprojection_errors_px
from toolkit.metrics.parts.scores import Scores, Unavailable
from toolkit.models import stereo

ORDER = 50
METRICS = pixel_metrics(
    "reproj", "reprojection error of the estimator's own landmarks, in-sample", "own", ("reproj", "own")
)


def score(evaluation: Evaluation) -> Scores:
    """Score the reprojection of the run's landmarks from the evaluated poses."""
    lacking = "lack a landmark, a second sighting or a pose of their frame"
    return pixel_scores("reproj", errors(evaluation), len(evaluation.sequence.visible), lacking)


def errors(evaluation: Evaluation) -> Array:
    """Return the reprojection error (N,) px of every visible observation that has a landmark and a pose.

    Tracks seen only once are left out: a landmark started from one sighting reprojects onto it exactly.
    """
    return _errors_of_sightings(evaluation)[1]


def errors_of_landmarks(evaluation: Evaluation) -> tuple[IntArray, Array]:
    """Return the track ids (M,) of the landmarks that have such observations, and the RMS (M,) px over each one's."""
    rows, errors_px = _errors_of_sightings(evaluation)
    seen, of_landmark, counts = np.unique(rows, return_inverse=True, return_counts=True)
    sums = np.bincount(of_landmark, weights=errors_px**2, minlength=seen.size)
    return evaluation.run.landmarks.track_ids[seen], np.sqrt(sums / counts)


def _errors_of_sightings(evaluation: Evaluation) -> tuple[IntArray, Array]:
    """Return the row (N,) of each observation's landmark, and the observation's error (N,) px."""
    landmarks, rig = evaluation.run.landmarks, evaluation.sequence.rig
    if not len(landmarks):
        raise Unavailable("the estimator has no landmarks")
    observations = evaluation.sequence.visible
    row, has_landmark = rows_of(observations.track_id, landmarks.track_ids)
    known = has_landmark & evaluation.has_pose[observations.frame] & _seen_again(observations.track_id)
    T_cam_world = se3_inverse(evaluation.poses_of_frames @ rig.T_imu_cam)
    points_cam = transform(T_cam_world[observations.frame[known]], landmarks.points_world[row[known]])
    uv_predicted_px = stereo.project(points_cam, rig)
    return row[known], reprojection_errors_px(uv_predicted_px, observations.uv_px[known], points_cam[:, 2] > 0.0)


def _seen_again(track_ids: IntArray) -> BoolArray:
    """Say for each observation (N,) whether its track has another one."""
    _, row_of, counts = np.unique(track_ids, return_inverse=True, return_counts=True)
    return np.asarray(counts[row_of] > 1)
