"""Landmarks in a joint belief: how a frame corrects it by them.

It uses the newest clone, whose estimate and covariance are those of the present pose.
"""

from typing import NamedTuple

import numpy as np
from scipy.sparse import csr_array

from filters.kalman.joint import JointBelief, Linearisation
from toolkit.geometry import Array, IntArray, se3_inverse
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


class StackedSightings(NamedTuple):
    """Whitened residuals (L, 3) of the state's landmarks, and their Jacobians to the k errors of landmarks and clones.

    A sighting depends on nine of these errors: ``blocks`` (L, 3, 9) are its Jacobians to its landmark and to the newest
    clone, and ``own`` (L, 9) are the indices of these errors among all k.
    """

    residuals: Array
    blocks: Array
    own: IntArray
    k: int

    def weighed(self, weights: Array) -> tuple[csr_array, Array]:
        """Return the stacked Jacobian (m, k) and residuals (m,) of the landmarks whose weight (L,) is not zero."""
        rows, roots = np.flatnonzero(weights), np.sqrt(weights[weights > 0.0])
        values = roots[:, None, None] * self.blocks[rows]
        places = np.repeat(self.own[rows], 3, axis=0)
        H = csr_array((values.ravel(), places.ravel(), np.arange(0, values.size + 1, 9)), (3 * len(rows), self.k))
        return H, (roots[:, None] * self.residuals[rows]).reshape(-1)


def correct(
    joint: JointBelief,
    frame: StereoFrame,
    at: Linearisation,
    rig: StereoRig,
    gate: FrameGate,
) -> None:
    """Correct the whole state by its landmarks; the frame must show every one of them."""
    if not len(joint.landmark_ids):
        return
    seen = linearise_sightings(joint, frame, at, rig)
    weights = weighed(joint, seen, gate)
    if weights.any():
        H, residuals = stacked(joint, seen).weighed(weights)
        joint.update(H, residuals, columns(joint))


def linearise_sightings(joint: JointBelief, frame: StereoFrame, at: Linearisation, rig: StereoRig) -> LandmarkSightings:
    """Linearise the frame's sightings of all landmarks of the state; the frame must show every one of them."""
    order = np.argsort(frame.track_ids)
    uvs_px = frame.uvs_px[order[np.searchsorted(frame.track_ids, joint.landmark_ids, sorter=order)]]
    predicted_px, depth_m = images(joint.points, joint.clones[-1:], rig)
    there = linearised_images(at.points(joint), at.clones(joint)[-1:], rig)
    whitener = stereo.whitener(uvs_px, rig)
    residuals = stereo.whitened_residuals(uvs_px, predicted_px[:, 0], rig)
    H_pose, H_point = whitener @ there.d_uv_d_pose[:, 0], whitener @ there.d_uv_d_point[:, 0]
    return LandmarkSightings(residuals, H_pose, H_point, depth_m[:, 0], stereo.degrees_of_freedom(uvs_px))


def stacked(joint: JointBelief, seen: LandmarkSightings) -> StackedSightings:
    """Expand the Jacobians to each landmark and the newest clone to the columns of all landmarks and clones."""
    count, k = len(seen.H_pose), 3 * len(seen.H_pose) + 6 * len(joint.clones)
    own = np.empty((count, 9), dtype=np.int64)
    own[:, :3] = np.arange(3 * count).reshape(count, 3)
    own[:, 3:] = np.arange(k - 6, k)
    blocks = np.concatenate([seen.H_point, seen.H_pose], axis=2)
    return StackedSightings(seen.residuals, blocks, own, k)


def columns(joint: JointBelief) -> slice:
    """Return the columns of the error state that :class:`StackedSightings` has."""
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


def _in_imu(points: Array, poses: Array) -> Array:
    """Return points (F, 3) of the world in the IMU frame of each pose (W, 4, 4), (F, W, 3)."""
    T_imu_world = se3_inverse(poses)
    rotated = points @ np.swapaxes(T_imu_world[:, :3, :3], 1, 2)
    return np.swapaxes(rotated, 0, 1) + T_imu_world[:, :3, 3]


def linearised_images(points: Array, poses: Array, rig: StereoRig) -> stereo.StereoPrediction:
    """Predict the images of points (F, 3) from poses (W, 4, 4), with Jacobians: the leading axes are (F, W)."""
    return stereo.linearise(_in_imu(points, poses), poses[:, :3, :3], rig)


def images(points: Array, poses: Array, rig: StereoRig) -> tuple[Array, Array]:
    """Predict the images (F, W, 3) px of points (F, 3) from poses (W, 4, 4), and their depths (F, W) m."""
    return stereo.images(_in_imu(points, poses), rig)
