"""Landmarks in a joint belief: how a frame corrects it by them.

It uses the newest clone, whose estimate and covariance are those of the present pose.
"""

from typing import NamedTuple

import numpy as np
from scipy.sparse import csr_array

from filters.kalman.joint import JointBelief, Linearisation
from toolkit.geometry import Array, IntArray, se3_inverse, transform
from toolkit.measurements import StereoFrame, StereoRig
from toolkit.models import stereo
from toolkit.models.gating import FrameGate, mahalanobis_squared


class LandmarkSightings(NamedTuple):
    """Whitened residuals (L, 3) of the state's landmarks, their Jacobians and the landmarks' depths (L,) m.

    ``H_pose`` (L, 3, 6) is to the newest clone, ``H_point`` (L, 3, 3) to the landmark. ``dof`` are the degrees of
    freedom of the residuals: (L,), or one number for all.
    """

    residuals: Array
    H_pose: Array
    H_point: Array
    depth_m: Array
    dof: int | IntArray


def correct(joint: JointBelief, frame: StereoFrame, at: Linearisation, rig: StereoRig, gate: FrameGate) -> None:
    """Correct the whole state by its landmarks; the frame must show every one of them."""
    if not len(joint.landmark_ids):
        return
    seen = linearise_sightings(joint, frame, at, rig)
    weights = weighed(joint, seen, gate)
    if weights.any():
        H, residuals = stacked(joint, seen, weights)
        joint.update(H, residuals, columns(joint))


def linearise_sightings(joint: JointBelief, frame: StereoFrame, at: Linearisation, rig: StereoRig) -> LandmarkSightings:
    """Linearise the frame's sightings of all landmarks of the state; the frame must show every one of them."""
    order = np.argsort(frame.track_ids)
    uvs_px = frame.uvs_px[order[np.searchsorted(frame.track_ids, joint.landmark_ids, sorter=order)]]
    predicted_px, depth_m = stereo.images(transform(se3_inverse(joint.clones[-1]), joint.points), rig)
    there = stereo.predict(at.points(joint), at.clones(joint)[-1], rig)
    whitener = stereo.whitener(uvs_px, rig)
    residuals = stereo.whitened_residuals(uvs_px, predicted_px, rig)
    H_pose, H_point = whitener @ there.d_uv_d_pose, whitener @ there.d_uv_d_point
    return LandmarkSightings(residuals, H_pose, H_point, depth_m, stereo.degrees_of_freedom(uvs_px))


def stacked(joint: JointBelief, seen: LandmarkSightings, weights: Array) -> tuple[csr_array, Array]:
    """Return Jacobian (m, k) and residuals (m,) of the landmarks whose weight (L,) is not zero, stacked.

    The columns are the k errors of landmarks and clones, of which a sighting depends on its landmark's and on those of
    the newest clone.
    """
    rows, roots = np.flatnonzero(weights), np.sqrt(weights[weights > 0.0])[:, None, None]
    k = 3 * len(weights) + 6 * len(joint.clones)
    own = np.concatenate([3 * rows[:, None] + np.arange(3), np.tile(np.arange(k - 6, k), (len(rows), 1))], axis=1)
    blocks = roots * np.concatenate([seen.H_point[rows], seen.H_pose[rows]], axis=2)
    places, ends = np.repeat(own, 3, axis=0).ravel(), np.arange(0, blocks.size + 1, 9)
    return csr_array((blocks.ravel(), places, ends), (3 * len(rows), k)), (roots[..., 0] * seen.residuals[rows]).ravel()


def columns(joint: JointBelief) -> slice:
    """Return the columns of the error state that :func:`stacked` has: those of landmarks and clones."""
    return slice(joint.landmark_columns.start, joint.cov.shape[0])


def weighed(joint: JointBelief, seen: LandmarkSightings, gate: FrameGate) -> Array:
    """Return the weights of landmarks (L,): 0 unless in front of the camera with residuals that pass the gate.

    The projection formula gives a point behind the camera an image too, which may even match the measured one.
    """
    H = np.concatenate([seen.H_pose, seen.H_point], axis=2)
    predicted = H @ _pose_and_landmark_cov(joint) @ np.swapaxes(H, 1, 2)
    nis = mahalanobis_squared(seen.residuals, predicted + np.eye(3))
    return gate.weights(nis, seen.dof, gate.accepts(nis, seen.dof, seen.depth_m > 0.0))


def _pose_and_landmark_cov(joint: JointBelief) -> Array:
    """Return the covariance (L, 9, 9) of the newest clone and each landmark."""
    newest = np.arange(joint.clone_columns.stop - 6, joint.clone_columns.stop)
    own = np.arange(joint.landmark_columns.start, joint.landmark_columns.stop).reshape(-1, 3)
    rows = np.concatenate([np.tile(newest, (len(own), 1)), own], axis=1)
    return np.asarray(joint.cov[rows[:, :, None], rows[:, None, :]])
