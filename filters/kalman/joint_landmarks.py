"""Landmarks in a joint belief: how tracks become part of the state and how they correct it afterwards.

Both use the newest clone, whose estimate and covariance are those of the present pose.
"""

from typing import NamedTuple

import numpy as np
from scipy.linalg.blas import dtrmm
from scipy.linalg.lapack import dgeqrf
from scipy.sparse import csr_array

from filters.kalman.joint import JointBelief, Linearisation
from filters.kalman.online_output import LandmarkMemory
from filters.kalman.tracks import TrackSightings
from toolkit.arrays import is_among
from toolkit.geometry import Array, BoolArray, IntArray, se3_inverse
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
    """Whitened residuals (L, 3) of the state's landmarks, and their Jacobians to the k errors of clones and landmarks.

    A sighting depends on nine of these errors: ``blocks`` (L, 3, 9) are its Jacobians to the newest clone and to its
    landmark, and ``own`` (L, 9) are the indices of these errors among all k.
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


class Linearised(NamedTuple):
    """Whitened residuals (F, W, 3) with Jacobians to each pose (F, W, 3, 6) and to the landmark (F, W, 3, 3)."""

    residuals: Array
    H_pose: Array
    H_point: Array

    def scaled(self, factors: Array) -> "Linearised":
        """Return all rows of each track multiplied by its factor (F,)."""
        by = factors[:, None, None]
        return self._replace(
            residuals=by * self.residuals, H_pose=by[..., None] * self.H_pose, H_point=by[..., None] * self.H_point
        )


def forget_lost(joint: JointBelief, frame: StereoFrame, memory: LandmarkMemory) -> None:
    """Marginalise the landmarks of the state that the frame does not show; the memory keeps their last estimates."""
    if len(joint.landmark_ids):
        forget(joint, ~is_among(joint.landmark_ids, frame.track_ids), memory)


def forget(joint: JointBelief, which: BoolArray, memory: LandmarkMemory) -> None:
    """Marginalise landmarks (L,) of the state; the memory keeps their last estimates."""
    if which.any():
        memory.remember(joint.landmark_ids[which], joint.points[which])
        joint.forget_landmarks(which)


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
    """Expand the Jacobians to the newest clone and each landmark to the columns of all clones and landmarks."""
    clones, count = 6 * len(joint.clones), len(seen.H_pose)
    own = np.empty((count, 9), dtype=np.int64)
    own[:, :6] = np.arange(clones - 6, clones)
    own[:, 6:] = np.arange(clones, clones + 3 * count).reshape(count, 3)
    blocks = np.concatenate([seen.H_pose, seen.H_point], axis=2)
    return StackedSightings(seen.residuals, blocks, own, clones + 3 * count)


def columns(joint: JointBelief) -> slice:
    """Return the columns of the error state that :class:`StackedSightings` has."""
    return slice(joint.clone_columns.start, joint.cov.shape[0])


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


def add_tracks(joint: JointBelief, track_ids: IntArray, points: Array, linearised: Linearised) -> None:
    """Add N tracks seen from the clones to the state at points (N, 3) m, with the correlations of their sightings.

    A landmark's error follows from the errors of its measurements, ``linearised`` with their weights, and of the poses:
    it is ``-(H_f^T H_f)^-1 H_f^T (H_x x + n)``, the error of its least-squares point.
    """
    count, window = linearised.residuals.shape[:2]
    H_point = linearised.H_point.reshape(count, 3 * window, 3)
    cov_each = np.linalg.inv(np.swapaxes(H_point, 1, 2) @ H_point)
    pull = -cov_each @ np.swapaxes(H_point, 1, 2)
    blocks = np.swapaxes(_by_pose(pull) @ linearised.H_pose, 1, 2).reshape(3 * count, 6 * window)
    clones = np.tile(np.arange(joint.clone_columns.start, joint.clone_columns.stop), 3 * count)
    ends = np.arange(0, blocks.size + 1, 6 * window)
    jacobian = csr_array((blocks.ravel(), clones, ends), (3 * count, joint.cov.shape[0]))
    cov = np.zeros((count, 3, count, 3))
    cov[np.arange(count), :, np.arange(count), :] = cov_each
    joint.add_landmarks(track_ids, points, jacobian, cov.reshape(3 * count, 3 * count))


def linearise(sightings: TrackSightings, points: Array, poses: Array, poses_at: Array, rig: StereoRig) -> Linearised:
    """Linearise the sightings of points (F, 3) from poses (W, 4, 4).

    Residuals are taken at the poses, Jacobians at ``poses_at`` (W, 4, 4): the same poses, or their first estimates.
    Rows of unseen places are zero throughout, and so is the row of uR where the right image is missing.
    """
    whitener, seen = stereo.whitener(sightings.uvs_px, rig), sightings.seen[..., None]
    there = linearised_images(points, poses_at, rig)
    uv_px = there.uv_px if poses_at is poses else images(points, poses, rig)[0]
    residuals = np.where(seen, stereo.whitened_residuals(sightings.uvs_px, uv_px, rig), 0.0)
    H_pose = np.where(seen[..., None], whitener @ there.d_uv_d_pose, 0.0)
    H_point = np.where(seen[..., None], whitener @ there.d_uv_d_point, 0.0)
    return Linearised(residuals, H_pose, H_point)


def _by_pose(rows: Array) -> Array:
    """Return the columns of rows (F, n, 3W) that belong to each pose, (F, W, n, 3)."""
    tracks, count, columns = rows.shape
    return np.swapaxes(rows.reshape(tracks, count, columns // 3, 3), 1, 2)


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


class Triangle(NamedTuple):
    """An upper triangular matrix (n, n). BLAS does not read its lower half, which may hold any values."""

    matrix: Array

    def __matmul__(self, right: Array) -> Array:
        if right.flags.c_contiguous:
            # BLAS is column-major and NumPy row-major: BLAS sees everything transposed, the triangle as a lower one.
            result: Array = dtrmm(1.0, self.matrix.T, right.T, side=1, lower=1).T
        else:
            result = dtrmm(1.0, self.matrix.T, right, trans_a=1, lower=1)
        return result


def compressed(H: Array, residuals: Array) -> tuple[Array | Triangle, Array]:
    """Return an equivalent system (k, n), (k,) with no more rows than columns, by QR (MSCKF, eqs. 28-30)."""
    count, columns = H.shape
    if count <= columns:
        return H, residuals
    # LAPACK is column-major: in that layout it works in place. With workspace for a block of 32 reflections it takes
    # half of the time; the result equals np.linalg.qr bit for bit.
    system = np.empty((columns + 1, count))
    system[:-1], system[-1] = H.T, residuals
    packed = dgeqrf(system.T, lwork=32 * (columns + 1), overwrite_a=1)[0]
    return Triangle(np.ascontiguousarray(packed[:columns, :-1])), packed[:columns, -1].copy()
