"""Reprojection errors: of the own landmarks, of tracks that no estimator is given, and of these over the motion.

In-sample: the estimator's landmarks, projected from its own poses, against its observations. Held-out: each sighting of
a withheld track is predicted from the others of its track; this needs no ground truth, and overfitting does not lower
it, because the points come from the estimated poses alone.

Held-out over motion shows whether vision helped. An estimator corrects the measured motion by the tracks that it is
given. If it predicts withheld tracks worse than the motion alone, its corrections were wrong or, in a causal output,
jump back and forth by more than they gain, whatever its covariance. The motion is integrated from the output's own
first state. Errors are paired over the tracks, which differ far more from each other than two estimates of one do.
"""

import numpy as np

from toolkit.answers import Run
from toolkit.arrays import rows_of
from toolkit.estimate import Landmarks, Trajectory
from toolkit.geometry import Array, se3_inverse, transform
from toolkit.metrics.parts.evaluation import Evaluation, rmse
from toolkit.metrics.parts.leave_one_out import CAP_PX, FEWEST_VIEWS, errors_left_out, reprojection_errors_px
from toolkit.metrics.parts.scores import Metric, Scores, Unavailable
from toolkit.models import stereo
from toolkit.models.corrections import belief_at
from toolkit.models.motion import motion_model
from toolkit.models.state import predicted
from toolkit.sequence import Sequence

ORDER = 50
RATIO, ERROR = "heldout_over_motion", "heldout_over_motion_error"
# Added to both errors, in squares, so that differences far below a tenth of a pixel, as without noise, do not count.
_FLOOR_PX = 0.1
# This many tracks, drawn evenly, give the ratio to a few percent; with fewer than the second number it is not computed.
_MOST_TRACKS, _FEWEST_TRACKS = 1000, 30
# Vision did harm if a run is worse by the first factor, or by the second in the worst of ten stretches, in both cases
# by more than this many standard errors. Chosen by looking at sound simulated runs (docs/metrics.md).
MOST_RATIO, MOST_RATIO_OF_STRETCH, SIGMAS = {"twist": 1.25, "imu": 2.5}, {"twist": 2.0, "imu": 4.0}, 5.0
_STRETCHES, _FEWEST_IN_STRETCH = 10, 10
_OF_CAUSAL = ": look for wrong tracks, or corrections it takes back later"
_OF_FINAL = ": look for wrong tracks or a wrong calibration"
_CAPPED = f"RMSE of the same, each observation's error capped at {CAP_PX:g} px (px)"
_IN_SAMPLE = (
    Metric(
        "reproj_median_px",
        "median reprojection error of the estimator's own landmarks, in-sample (px)",
        "px",
        ("reproj", "own"),
    ),
    Metric("reproj_rmse_px", _CAPPED, "px", ("own", "RMSE"), name="reproj own RMSE"),
)
_HELD_OUT = (
    Metric(
        "heldout_reproj_median_px",
        "median leave-one-view-out reprojection error of the one track in ten no estimator is given (px)",
        "px",
        ("held-", "out"),
        name="reproj held-out",
        table="always",
        over_seeds=True,
    ),
    Metric("heldout_reproj_rmse_px", _CAPPED, "px", ("held-out", "RMSE"), name="reproj held-out RMSE"),
)
_OVER_MOTION = (
    Metric(
        RATIO,
        "held-out error over that of the measured motion alone (geometric mean over tracks); below 1 vision has helped",
        "1",
        ("held-out", "/ motion"),
    ),
    Metric(
        ERROR,
        "standard error, over the tracks, of the logarithm of held-out / motion",
        "1",
        ("held-out", "/motion +-"),
        name="held-out / motion, error",
    ),
)
METRICS = (*_IN_SAMPLE, *_HELD_OUT, *_OVER_MOTION)


def score(evaluation: Evaluation) -> Scores:
    visible, held_out = evaluation.sequence.visible, evaluation.sequence.held_out
    unknown = "lack a landmark, a second sighting or a pose of their frame"
    few = f"belong to frames without a pose or to tracks with fewer than {FEWEST_VIEWS} posed views"
    return (
        Scores.attempt(_IN_SAMPLE, lambda: _pixel_scores("reproj", in_sample_errors(evaluation), len(visible), unknown))
        | Scores.attempt(
            _HELD_OUT, lambda: _pixel_scores("heldout_reproj", held_out_errors(evaluation), len(held_out), few)
        )
        | Scores.attempt(_OVER_MOTION, lambda: _over_motion(evaluation))
    )


def _pixel_scores(prefix: str, errors_px: Array, observation_count: int, why_left_out: str) -> Scores:
    """Score the median and the root mean square of errors (N,) px, as the metrics PREFIX_median_px and PREFIX_rmse_px.

    A remark says how many of the observations were scored, why others were not, and how many of the scored ones are at
    the cap. Raises Unavailable where there are none.
    """
    if not errors_px.size:
        raise Unavailable("no observation could be reprojected")
    parts = []
    if errors_px.size < observation_count:
        parts.append(f"{errors_px.size} of {observation_count} observations scored, the others {why_left_out}")
    at_cap = int(np.count_nonzero(errors_px >= CAP_PX))
    if at_cap:
        parts.append(f"{at_cap} behind the camera or off by more than {CAP_PX:g} px, counted as {CAP_PX:g} px")
    scores = Scores({f"{prefix}_median_px": float(np.median(errors_px)), f"{prefix}_rmse_px": rmse(errors_px)})
    return scores.remarked(scores.values, "; ".join(parts))


def in_sample_errors(evaluation: Evaluation) -> Array:
    """Return the reprojection error (N,) px of every visible observation that has a landmark and a pose.

    Tracks seen only once are left out: a landmark started from one sighting reprojects onto it exactly.
    """
    landmarks, rig = evaluation.run.landmarks, evaluation.sequence.rig
    if not len(landmarks):
        raise Unavailable("the estimator has no landmarks")
    observations = evaluation.sequence.visible
    row, has_landmark = rows_of(observations.track_id, landmarks.track_ids)
    _, track, counts = np.unique(observations.track_id, return_inverse=True, return_counts=True)
    known = has_landmark & evaluation.has_pose[observations.frame] & (counts[track] > 1)
    T_cam_world = se3_inverse(evaluation.poses_of_frames @ rig.T_imu_cam)
    points_cam = transform(T_cam_world[observations.frame[known]], landmarks.points_world[row[known]])
    uv_predicted_px = stereo.project(points_cam, rig)
    return reprojection_errors_px(uv_predicted_px, observations.uv_px[known], points_cam[:, 2] > 0.0)


def held_out_errors(evaluation: Evaluation) -> Array:
    """Return the leave-one-view-out error (N,) px of every sighting of a withheld track with enough posed views."""
    _, errors_px = evaluation.held_out_errors
    if not errors_px.size:
        raise Unavailable(f"no withheld track has {FEWEST_VIEWS} views from frames with a pose")
    return errors_px


def _over_motion(evaluation: Evaluation) -> Scores:
    """Score the ratio of the errors of withheld tracks under the evaluated poses to those under the motion alone.

    If vision did harm, a remark on the ratio says so, and in which stretch most.
    """
    log_ratio, t_s = _paired(evaluation)
    ratio, error = _mean(log_ratio)
    harm = _harm(log_ratio, t_s, evaluation.sequence.motion_kind)
    if harm:
        harm += _OF_CAUSAL if evaluation.output == "causal" else _OF_FINAL
    scores = Scores({RATIO: float(np.exp(ratio)), ERROR: error})
    return scores.remarked((RATIO,), harm)


def _paired(evaluation: Evaluation) -> tuple[Array, Array]:
    """Return the errors of n withheld tracks over those under the measured motion alone, as logarithms (n,).

    With them the mean times (n,) s of the tracks' sightings.
    """
    sequence = evaluation.sequence
    motion = _motion_alone(evaluation.estimate, sequence)
    seen, errors_px = evaluation.held_out_errors
    ids = np.unique(sequence.held_out.track_id[seen])
    some = ids[np.linspace(0, ids.size - 1, min(ids.size, _MOST_TRACKS)).round().astype(int)]  # an even draw
    drawn = np.isin(sequence.held_out.track_id[seen], some)
    tracks, errors_px = sequence.held_out.select(seen[drawn]), errors_px[drawn]
    poses_by_motion = Evaluation(motion, "causal", sequence).poses_of_frames
    _, by_motion_px = errors_left_out(tracks, poses_by_motion, sequence.rig)
    ids, track, count = np.unique(tracks.track_id, return_inverse=True, return_counts=True)
    if ids.size < _FEWEST_TRACKS or by_motion_px.size != errors_px.size:
        raise Unavailable(
            f"{ids.size} withheld tracks have {FEWEST_VIEWS} views from frames with a pose; {_FEWEST_TRACKS} are needed"
        )
    apart = 0.5 * np.log((errors_px**2 + _FLOOR_PX**2) / (by_motion_px**2 + _FLOOR_PX**2))
    t_s = sequence.frames_s[tracks.frame]
    return np.bincount(track, apart) / count, np.bincount(track, t_s) / count


def _motion_alone(estimate: Trajectory, sequence: Sequence) -> Run:
    """Return a run that integrates the measured motion from the first state of an estimate."""
    if sequence.motion_kind == "none":
        raise Unavailable("no motion was measured")
    if sequence.motion_kind == "imu" and estimate.v_world is None:
        raise Unavailable("the output states no velocity that the motion of an IMU could be integrated from")
    packets = [packet for packet in sequence.packets() if len(estimate) and packet.frame.t_ns >= estimate.t_ns[0]]
    if not packets:
        raise Unavailable("there is no pose to integrate the motion from")
    model = motion_model(sequence.noise, sequence.gravity_world)
    belief = belief_at(estimate, 0, model)
    poses = [belief.T_world_imu]
    for packet in packets[1:]:
        belief = predicted(belief, model, packet.motion)
        poses.append(belief.T_world_imu)
    motion = Trajectory(np.array([packet.frame.t_ns for packet in packets], dtype=np.int64), np.array(poses))
    return Run("the measured motion", "ok", motion, None, Landmarks.none(), timings=None)


def _harm(log_ratio: Array, t_s: Array, kind: str) -> str:
    """Return by how much, and in which stretch most, vision did harm; empty if it did not."""
    whole, notes = _mean(log_ratio), list[str]()
    if _least(whole) > np.log(MOST_RATIO[kind]):
        ratio = float(np.exp(whole[0]))
        notes.append(f"{ratio:.2f} +- {ratio * whole[1]:.2f} times ({t_s.size} tracks)")
    edges = np.linspace(t_s.min(), t_s.max(), _STRETCHES + 1)
    stretch = np.clip(np.searchsorted(edges, t_s, side="right") - 1, 0, _STRETCHES - 1)
    many = [k for k in range(_STRETCHES) if np.count_nonzero(stretch == k) >= _FEWEST_IN_STRETCH]
    of_stretch = {k: _mean(log_ratio[stretch == k]) for k in many}
    worst = max(many, key=lambda k: _least(of_stretch[k]), default=None)
    if worst is not None and _least(of_stretch[worst]) > np.log(MOST_RATIO_OF_STRETCH[kind]):
        notes.append(f"{np.exp(of_stretch[worst][0]):.2g} times at {edges[worst]:.0f}-{edges[worst + 1]:.0f} s")
    if not notes:
        return ""
    return f"explains withheld tracks worse than dead reckoning, with {', '.join(notes)} its error"


def _mean(values: Array) -> tuple[float, float]:
    """Return the mean of values (n,) and its standard error."""
    return float(values.mean()), float(values.std(ddof=1) / np.sqrt(values.size))


def _least(mean: tuple[float, float]) -> float:
    return mean[0] - SIGMAS * mean[1]
