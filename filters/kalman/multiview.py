"""Landmarks seen from several poses of a window: their measurements are linearised and the landmark is eliminated.

Everything works on F tracks at once, padded to W poses: ``uvs_px`` (F, W, 3) with a mask ``seen`` (F, W). Source:
Mourikis & Roumeliotis 2007, "A multi-state constraint Kalman filter for vision-aided inertial navigation", eqs. 17-26;
the stereo measurement replaces their monocular one.
"""

from typing import NamedTuple

import numpy as np
from scipy.linalg.blas import dtrmm
from scipy.linalg.lapack import dgeqrf

from toolkit.geometry import Array, BoolArray, IntArray, se3_inverse
from toolkit.measurements import StereoRig, is_left_only
from toolkit.models import stereo


class TrackSightings(NamedTuple):
    """F tracks seen from the W poses of a window: ids (F,), (uL, uR, v) (F, W, 3) px, and which were seen (F, W)."""

    track_ids: IntArray
    uvs_px: Array
    seen: BoolArray

    @property
    def left_only(self) -> BoolArray:
        """Say which sightings (F, W) lack the right image."""
        return self.seen & is_left_only(self.uvs_px)

    @property
    def degrees_of_freedom(self) -> IntArray:
        """Return how many coordinates of each track (F,) remain once its landmark is eliminated."""
        return np.asarray(3 * self.seen.sum(axis=1) - self.left_only.sum(axis=1) - 3)

    def select(self, rows: BoolArray | IntArray) -> "TrackSightings":
        """Return the tracks of a mask (F,) or of some rows; the object itself if the mask is all True."""
        if rows.dtype == np.bool_:
            rows = rows.nonzero()[0]  # once for all three arrays; indexing by a mask would repeat it for each
            if rows.size == self.track_ids.size:
                return self
        return TrackSightings(self.track_ids[rows], self.uvs_px[rows], self.seen[rows])

    def since(self, begin: int) -> "TrackSightings":
        """Return the sightings from pose ``begin`` on."""
        if not begin:
            return self
        return TrackSightings(self.track_ids, self.uvs_px[:, begin:], self.seen[:, begin:])

    def joined(self, other: "TrackSightings") -> "TrackSightings":
        """Return the tracks of both, concatenated."""
        return TrackSightings(*(np.concatenate(pair) for pair in zip(self, other, strict=True)))


class Linearised(NamedTuple):
    """Whitened residuals (F, W, 3) with Jacobians to each pose (F, W, 3, 6) and to the landmark (F, W, 3, 3)."""

    residuals: Array
    H_pose: Array
    H_point: Array
    depth_m: Array

    def select(self, rows: BoolArray | IntArray) -> "Linearised":
        """Return the rows of the tracks of a mask (F,) or of some indices."""
        return Linearised(*(array[rows] for array in self))

    def scaled(self, factors: Array) -> "Linearised":
        """Return all rows of each track multiplied by its factor (F,)."""
        by = factors[:, None, None]
        return self._replace(
            residuals=by * self.residuals, H_pose=by[..., None] * self.H_pose, H_point=by[..., None] * self.H_point
        )


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


def linearise(sightings: TrackSightings, points: Array, poses: Array, poses_at: Array, rig: StereoRig) -> Linearised:
    """Linearise the sightings of points (F, 3) from poses (W, 4, 4).

    Residuals are taken at the poses, Jacobians at ``poses_at`` (W, 4, 4): the same poses, or their first estimates.
    Rows of unseen places are zero throughout, and so is the row of uR where the right image is missing.
    """
    whitener, seen = stereo.whitener(sightings.uvs_px, rig), sightings.seen[..., None]
    there = linearised_images(points, poses_at, rig)
    if poses_at is poses:
        uv_px, depth_m = there.uv_px, there.depth_m
    else:
        uv_px, depth_m = images(points, poses, rig)
    residuals = np.where(seen, stereo.whitened_residuals(sightings.uvs_px, uv_px, rig), 0.0)
    H_pose = np.where(seen[..., None], whitener @ there.d_uv_d_pose, 0.0)
    H_point = np.where(seen[..., None], whitener @ there.d_uv_d_point, 0.0)
    return Linearised(residuals, H_pose, H_point, np.where(sightings.seen, depth_m, np.inf))


class Constraints(NamedTuple):
    """Constraints of F tracks on the W poses: whitened residuals (F, 3W - 3), Jacobians (F, 3W - 3, 6W), dof (F,)."""

    residuals: Array
    H: Array
    dof: IntArray

    def select(self, rows: BoolArray | IntArray) -> "Constraints":
        """Return the constraints of the tracks of a mask (F,) or of some indices."""
        return Constraints(self.residuals[rows], self.H[rows], self.dof[rows])

    def scaled(self, factors: Array) -> "Constraints":
        """Return all rows of each track multiplied by its factor (F,)."""
        return Constraints(factors[:, None] * self.residuals, factors[:, None, None] * self.H, self.dof)

    def joined(self, other: "Constraints") -> "Constraints":
        """Return the constraints of both, concatenated."""
        residuals, H = np.concatenate([self.residuals, other.residuals]), np.concatenate([self.H, other.H])
        return Constraints(residuals, H, np.concatenate([self.dof, other.dof]))


def without_landmark(linearised: Linearised, sightings: TrackSightings) -> Constraints:
    """Project the measurements onto the left null space of the landmark's Jacobian (MSCKF, eqs. 23-24)."""
    tracks, window = sightings.seen.shape
    dof = sightings.degrees_of_freedom
    stacked = linearised.residuals.reshape(tracks, 3 * window, 1)
    vectors, weighted = _reflectors(linearised)
    residuals = (stacked - vectors @ (weighted @ stacked))[:, 3:, 0]
    reached = np.swapaxes(by_pose(weighted) @ linearised.H_pose, 1, 2).reshape(tracks, 3, 6 * window)
    H = vectors @ -reached
    own_poses = np.einsum("fwiwj->fwij", H.reshape(tracks, window, 3, window, 6))
    own_poses += linearised.H_pose
    return Constraints(residuals, H[:, 3:], dof)


def by_pose(rows: Array) -> Array:
    """Return the columns of rows (F, n, 3W) that belong to each pose, (F, W, n, 3)."""
    tracks, count, columns = rows.shape
    return np.swapaxes(rows.reshape(tracks, count, columns // 3, 3), 1, 2)


def null_space(linearised: Linearised) -> Array:
    """Return rows (F, 3W - 3, 3W) whose span is the left null space of the landmark's Jacobian.

    Multiplied by them, a track's residuals are independent and of unit variance.
    """
    vectors, weighted = _reflectors(linearised)
    return np.asarray((np.eye(vectors.shape[1]) - vectors @ weighted)[:, 3:])


def _reflectors(linearised: Linearised) -> tuple[Array, Array]:
    """Return V (F, 3W, 3) and T^T V^T (F, 3, 3W) of the QR decomposition of the landmark's Jacobian, Q = 1 - V T V^T.

    Three Householder reflections a track in compact form (Schreiber & Van Loan 1989, "A storage-efficient WY
    representation for products of Householder transformations"): Q itself, 3W by 3W, is never formed.
    """
    tracks, window = linearised.residuals.shape[:2]
    packed, tau = np.linalg.qr(linearised.H_point.reshape(tracks, 3 * window, 3), mode="raw")
    packed[:, :, :3] = np.triu(packed[:, :, :3], 1) + np.eye(3)
    overlap = packed @ np.swapaxes(packed, 1, 2)
    triangle = tau[:, None] * np.eye(3)
    triangle[:, 0, 1] = -tau[:, 0] * tau[:, 1] * overlap[:, 0, 1]
    triangle[:, :2, 2] = -tau[:, 2, None] * (triangle[:, :2, :2] @ overlap[:, :2, 2, None])[..., 0]
    return np.swapaxes(packed, 1, 2), np.swapaxes(triangle, 1, 2) @ packed


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
