"""The one adjustment of states to stereo tracks: landmarks eliminated, the states solved for, the oldest left out.

A :class:`StereoWindow` is the problem: states, motion factors between them, a linear prior, and sightings of points
that are no variables. ``solve_window`` finds its minimum by Levenberg-Marquardt and the covariance of each state. The
fixed-lag smoother `smart` solves one frame by frame, the start and the measurement of noise on stretches of a
recording; `sliding-window` ties some of its landmarks to the prior. Everything is dense: a window has a few hundred
unknowns.

Each track is a smart factor (Carlone, Kira, Beall, Indelman & Dellaert 2014, "Eliminating conditionally independent
sets in factor graphs"; Forster et al. 2017, eqs. 47-50): its landmark's 3x3 block is eliminated by a Schur complement,
for all tracks at once. GTSAM's SmartStereoProjectionPoseFactor does the same only for noise that is equal and
independent in uL, uR and v; here the rig's full covariance is used, and each sighting has its weight by Huber's loss.
States that leave are marginalised by a Schur complement, together with every track they saw, so that each sighting is
used once (Dong-Si & Mourikis 2011, "Motion tracking with fixed-lag smoothing"; Leutenegger et al. 2015, section 3.4).
"""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import gtsam
import numpy as np
from scipy.linalg import cho_solve, cholesky, solve_triangular
from scipy.sparse import csc_array

from toolkit.errors import EstimatorError
from toolkit.estimate import Estimate
from toolkit.geometry import Array, BoolArray, IntArray, se3_inverse, transform
from toolkit.measurements import StereoFrame, StereoRig
from toolkit.models import stereo
from toolkit.models.factors import ordering_of
from toolkit.models.gating import LEAST_DISPARITY_PX, huber_losses, huber_weights
from toolkit.models.graph_state import MotionModel

# Squared norm of a point behind the camera: it has no gradient and must not cost less than one in front of it.
_BEHIND = 100.0**2
# Added to a landmark's 3x3 block so that it is never singular; far below the information of any sighting.
_LEAST_INFORMATION_PER_M2 = 1e-12
# Marquardt's damping, a share of each unknown's information, used only after a step that fails. It begins small because
# motion samples tie neighbouring states so tightly that a millionth would already fix roll and pitch.
_FIRST_DAMPING, _MOST_DAMPING = 1e-12, 1e6
# Parts of a landmark's step that are tried if the window's step raises the cost; damping the poses does not shorten it.
_SHARES = (1.0, 0.5, 0.25, 0.0)


@dataclass(frozen=True, eq=False)
class RobustCamera:
    """A rig, and the threshold of Huber's loss of whitened sightings; None for no loss."""

    rig: StereoRig
    huber: float | None


@dataclass(frozen=True, eq=False)
class Sightings:
    """N sightings in the order of time: rows of poses (N,) and points (N,), measurements (N, 3) px."""

    pose: IntArray
    point: IntArray
    uv_px: Array


class ReducedVision(NamedTuple):
    """Information matrix (D, D) and vector (D,) on the poses, and the matrices for back-substitution of points.

    D is 6K, or 6K + C where the sightings share C more unknowns. Of points that were not eliminated, ``root`` is the
    identity, and ``of_points`` (M, 3, 3), ``coupling`` and ``point_vector`` are the rest of the normal equations.
    """

    information: Array
    vector: Array
    coupling: Array
    root: Array
    point_vector: Array
    of_points: Array

    def point_steps(self, pose_steps: Array) -> Array:
        """Return the steps (M, 3) of the points for steps (D,) of the others."""
        whitened = self.point_vector - (self.coupling.T @ pose_steps).reshape(-1, 3)
        return (self.root @ whitened[..., None])[..., 0]


@dataclass(frozen=True, eq=False)
class Vision:
    """N sightings evaluated at K poses and M points: their cost, and on demand their normal equations.

    ``points_imu`` (N, 3) m are the points in the frames of the IMU, whose attitudes are ``R_world_imu`` (N, 3, 3), and
    ``in_front`` (N,) says which are in front of the camera; ``counts`` are K and M.
    """

    counts: tuple[int, int]
    sightings: Sightings
    camera: RobustCamera
    R_world_imu: Array
    points_imu: Array
    in_front: BoolArray

    @classmethod
    def at(cls, poses: Array, points: Array, sightings: Sightings, camera: RobustCamera) -> "Vision":
        """Evaluate sightings at poses (K, 4, 4) of the IMU in the world and points (M, 3) m in the world."""
        T_imu_world = se3_inverse(poses)[sightings.pose]
        with np.errstate(invalid="ignore"):
            points_imu = (T_imu_world[:, :3, :3] @ points[sightings.point, :, None])[..., 0] + T_imu_world[:, :3, 3]
            in_front = stereo.in_camera(points_imu, camera.rig)[:, 2] > 0.0
        counts = len(poses), len(points)
        return cls(counts, sightings, camera, poses[sightings.pose, :3, :3], points_imu, in_front)

    @cached_property
    def losses(self) -> Array:
        """The losses (N,) of the whitened residuals by Huber, times the weight of tracks."""
        squares = np.where(self.in_front, self._squares, _BEHIND)
        return self.camera.rig.track_weight * huber_losses(squares, self.camera.huber)

    @property
    def loss_of_points(self) -> Array:
        """The part (M,) of the loss due to the sightings of each point."""
        return np.asarray(np.bincount(self.sightings.point, self.losses, minlength=self.counts[1]), dtype=np.float64)

    def reduced(self, tied: IntArray | None = None) -> ReducedVision:
        """Linearise and eliminate the points; the poses' errors are GTSAM's: [rotation, position] in the body.

        Points ``tied`` (rows) to more than their sightings are not eliminated.
        """
        weights = self.camera.rig.track_weight * huber_weights(self._squares, self.camera.huber)
        roots = np.where(self.in_front, np.sqrt(weights), 0.0)
        weighted = roots[:, None, None] * stereo.whitener(self.sightings.uv_px, self.camera.rig)
        J_pose, J_point = weighted @ self._predicted.d_uv_d_pose, weighted @ self._predicted.d_uv_d_point
        return eliminated(roots[:, None] * self.whitened, J_pose, J_point, self.sightings, self.counts, tied=tied)

    @cached_property
    def _predicted(self) -> stereo.StereoPrediction:
        """The predicted images; points behind the camera are replaced by one that has an image."""
        somewhere = transform(self.camera.rig.T_imu_cam, np.array([0.0, 0.0, 1.0]))
        points_imu = np.where(self.in_front[:, None], self.points_imu, somewhere)
        return stereo.linearise(points_imu, self.R_world_imu, self.camera.rig)

    @property
    def H_pose(self) -> Array:
        """The whitened Jacobians (N, 3, 6) to the pose of each sighting."""
        whitener = stereo.whitener(self.sightings.uv_px, self.camera.rig)
        return np.asarray(whitener @ stereo.seen_rows(self.sightings.uv_px, self._predicted.d_uv_d_pose))

    @property
    def residual_px(self) -> Array:
        """Measured less predicted (N, 3) px, zero where uR is missing."""
        return stereo.residuals_px(self.sightings.uv_px, self._predicted.uv_px)

    @cached_property
    def whitened(self) -> Array:
        """Measured less predicted, whitened by the stated noise (N, 3)."""
        return stereo.whitened_residuals(self.sightings.uv_px, self._predicted.uv_px, self.camera.rig)

    @cached_property
    def _squares(self) -> Array:
        return np.asarray(np.square(self.whitened).sum(axis=1))


def eliminated(
    residual: Array,
    J_pose: Array,
    J_point: Array,
    seen: Sightings,
    counts: tuple[int, int],
    J_common: Array | None = None,
    tied: IntArray | None = None,
) -> ReducedVision:
    """Eliminate M points of N sightings from K poses by Schur complements.

    ``residual`` (N, 3) is measured less predicted, ``J_pose`` (N, 3, 6) and ``J_point`` (N, 3, 3) the Jacobians of the
    prediction, and ``J_common`` (N, 3, C) those by unknowns that all sightings share, which come behind the poses'; all
    whitened and weighted. ``counts`` are K and M. Points ``tied`` (rows) are not eliminated.
    """
    (pose_count, point_count), point, pose = counts, seen.point, seen.pose
    # Small matrix products are several times as fast on contiguous arrays.
    to_point = np.ascontiguousarray(np.swapaxes(J_point, 1, 2))
    per_point = _summation(point, point_count)
    information_point = (per_point @ (to_point @ J_point).reshape(-1, 9)).reshape(-1, 3, 3)
    information_point += _LEAST_INFORMATION_PER_M2 * np.eye(3)
    vector_point = per_point @ (to_point @ residual[..., None])[..., 0]
    gone, root = np.ones(point_count, dtype=bool), np.tile(np.eye(3), (point_count, 1, 1))
    if tied is not None:
        gone[tied] = False
    root[gone] = np.swapaxes(np.linalg.inv(np.linalg.cholesky(information_point[gone])), 1, 2)
    whitened_vector = (np.swapaxes(root, 1, 2) @ vector_point[..., None])[..., 0]
    coupling = np.zeros((pose_count, 6, point_count, 3))
    to_pose, per_pose = np.ascontiguousarray(np.swapaxes(J_pose, 1, 2)), _summation(pose, pose_count)
    J_root = J_point @ root[point]
    coupling[pose, :, point, :] = to_pose @ J_root
    vector = (per_pose @ (to_pose @ residual[..., None])[..., 0]).ravel()
    across = coupling.reshape(6 * pose_count, 3 * point_count)
    own, here = np.zeros((pose_count, 6, pose_count, 6)), np.arange(pose_count)
    own[here, :, here] = (per_pose @ (to_pose @ J_pose).reshape(-1, 36)).reshape(-1, 6, 6)
    information = own.reshape(6 * pose_count, 6 * pose_count)
    if J_common is not None:
        to_common, shared = np.swapaxes(J_common, 1, 2), J_common.shape[2]
        of_points = (per_point @ (to_common @ J_root).reshape(len(pose), -1)).reshape(point_count, shared, 3)
        across = np.concatenate([across, np.swapaxes(of_points, 0, 1).reshape(shared, -1)])
        of_poses = (per_pose @ (to_pose @ J_common).reshape(len(pose), -1)).reshape(-1, shared)
        rows = J_common.reshape(-1, shared)
        information = np.block([[information, of_poses], [of_poses.T, rows.T @ rows]])
        vector = np.concatenate([vector, rows.T @ residual.ravel()])
    leaving = across if gone.all() else across[:, np.repeat(gone, 3)]
    information -= leaving @ leaving.T
    vector = vector - leaving @ whitened_vector[gone].ravel()
    return ReducedVision(information, vector, across, root, whitened_vector, information_point)


def _summation(groups: IntArray, count: int) -> csc_array:
    """Return the matrix (count, N) that sums the rows (N, d) of each group."""
    return csc_array((np.ones(groups.size), groups, np.arange(groups.size + 1)), shape=(count, groups.size))


@dataclass(frozen=True, eq=False)
class MarginalPrior:
    """Information matrix (D, D) and vector (D,) on the first D unknowns of the window, linearised at ``about``."""

    information: Array
    vector: Array
    about: gtsam.Values


@dataclass(frozen=True, eq=False)
class StereoWindow:
    """States in the order of time: their keys (each [pose, velocity, bias] or [pose, bias]), factors and sightings.

    ``motion[i]`` ties state i to the one before it; ``points`` (M, 3) are the landmarks of the sightings, of the tracks
    ``track_ids`` (M,).
    """

    keys: tuple[tuple[int, ...], ...]
    values: gtsam.Values
    motion: tuple[gtsam.NonlinearFactorGraph, ...]
    prior: MarginalPrior
    sightings: Sightings
    points: Array
    track_ids: IntArray

    @classmethod
    def empty(cls) -> "StereoWindow":
        none, values = np.empty(0, dtype=np.int64), gtsam.Values()
        prior = MarginalPrior(np.zeros((0, 0)), np.zeros(0), values)
        return cls((), values, (), prior, Sightings(none, none, np.empty((0, 3))), np.empty((0, 3)), none)

    @property
    def poses(self) -> Array:
        """Return the poses (K, 4, 4) of the IMU in the world."""
        return np.array([self.values.atPose3(keys[0]).matrix() for keys in self.keys])

    @property
    def all_keys(self) -> list[int]:
        """Return the keys of all states, in the order of the unknowns."""
        return [key for keys in self.keys for key in keys]

    @property
    def size(self) -> int:
        """Return the number of unknowns of one state."""
        return int(self.values.extract(list(self.keys[0])).dim())

    def extended(
        self,
        model: MotionModel,
        estimate: Estimate,
        factors: gtsam.NonlinearFactorGraph,
        frame: StereoFrame,
        k: int,
        rig: StereoRig,
    ) -> "StereoWindow":
        """Return the window with state k at an estimate, the factors that tie it, and the frame it sees.

        Known tracks continue, new ones are triangulated; new tracks of too small a disparity are left out.
        """
        values, seen = gtsam.Values(self.values), self.sightings
        model.insert(values, estimate, k)
        known = np.isin(frame.track_ids, self.track_ids)
        new = frame.select(~known & (stereo.disparity_px(frame.uvs_px) > LEAST_DISPARITY_PX))
        used = frame.select(known | np.isin(frame.track_ids, new.track_ids))
        ids = np.concatenate([self.track_ids, new.track_ids])
        order = np.argsort(ids)
        rows, newest = (
            order[np.searchsorted(ids, used.track_ids, sorter=order)],
            np.full(len(used.uvs_px), len(self.keys)),
        )
        return replace(
            self,
            keys=(*self.keys, tuple(model.keys(k))),
            values=values,
            motion=(*self.motion, factors),
            points=np.concatenate([self.points, stereo.triangulate_world(new.uvs_px, estimate.T_world_imu, rig)]),
            track_ids=ids,
            sightings=Sightings(
                np.concatenate([seen.pose, newest]),
                np.concatenate([seen.point, rows]),
                np.concatenate([seen.uv_px, used.uvs_px]),
            ),
        )

    def points_by_id(self) -> dict[int, Array]:
        return dict(zip(self.track_ids.tolist(), self.points, strict=True))

    def moved(self, step: Array, point_steps: Array) -> "StereoWindow":
        """Return the window after a step (D,) of its states and one (M, 3) of its landmarks."""
        delta, start, dims = gtsam.VectorValues(), 0, self.values.dims()
        for key in self.all_keys:
            delta.insert(key, step[start : start + dims[key]])
            start += dims[key]
        return replace(self, values=self.values.retract(delta), points=self.points + point_steps)

    def newest(self, frame: StereoFrame) -> StereoFrame:
        """Return the newest state's frame without the sightings that are not in the window."""
        taken = self.track_ids[self.sightings.point[self.sightings.pose == len(self.keys) - 1]]
        return frame.select(np.isin(frame.track_ids, taken))

    def with_points(self, rows: IntArray, kept: BoolArray) -> "StereoWindow":
        """Return the window with the points of some rows (m,), and with sightings of these alone, a mask (N,)."""
        seen, place = self.sightings, np.empty(len(self.points), dtype=np.int64)
        place[rows] = np.arange(len(rows))
        left = Sightings(seen.pose[kept], place[seen.point[kept]], seen.uv_px[kept])
        return replace(self, points=self.points[rows], track_ids=self.track_ids[rows], sightings=left)

    def with_sightings(self, kept: BoolArray) -> "StereoWindow":
        """Return the window with some of its sightings, a mask (N,), and without points that have none."""
        return self.with_points(np.unique(self.sightings.point[kept]), kept)

    def later(self, count: int) -> "StereoWindow":
        """Return the window without its ``count`` oldest states, their sightings, and all factors that tie them."""
        values, seen = gtsam.Values(self.values), self.sightings
        for key in (key for keys in self.keys[:count] for key in keys):
            values.erase(key)
        stay = seen.pose >= count
        left = Sightings(seen.pose[stay] - count, seen.point[stay], seen.uv_px[stay])
        motion = gtsam.NonlinearFactorGraph(), *self.motion[count + 1 :]
        return replace(self, keys=self.keys[count:], values=values, motion=motion, sightings=left)

    def in_front(self, rig: StereoRig) -> tuple["StereoWindow", IntArray]:
        """Drop the points that are behind a camera that saw them; return the window and the ids (n,) of these."""
        seen = self.sightings
        in_front = Vision.at(self.poses, self.points, seen, RobustCamera(rig, None)).in_front
        behind = np.unique(seen.point[~in_front])
        return self.with_sightings(~np.isin(seen.point, behind)) if behind.size else self, self.track_ids[behind]


@dataclass(frozen=True, eq=False)
class System:
    """The normal equations (D, D), (D,) of a window and the elimination of its landmarks."""

    information: Array
    vector: Array
    vision: ReducedVision

    @cached_property
    def root(self) -> Array:
        """The lower Cholesky factor (D, D) of the information; raises LinAlgError where there is none."""
        return lower_factor(self.information)

    def damped_root(self, damping: float) -> Array:
        """Return the lower Cholesky factor (D, D) with a share of the diagonal added; raises as ``root`` does."""
        if damping == 0.0:
            return self.root
        return lower_factor(self.information + damping * np.diag(np.diag(self.information)))


@dataclass(frozen=True, eq=False)
class Evaluated:
    """A window and its cost at its values: half the squared errors of motion and prior, and Huber's losses."""

    window: StereoWindow
    motion: gtsam.GaussianFactorGraph
    off_prior: Array
    vision: Vision

    @classmethod
    def of(cls, window: StereoWindow, camera: RobustCamera) -> "Evaluated":
        """Evaluate a window. Its motion is linearised at once: Python factors cost as much to evaluate."""
        vision = Vision.at(window.poses, window.points, window.sightings, camera)
        motion = gtsam.NonlinearFactorGraph()
        for graph in window.motion:
            motion.push_back(graph)
        return cls(window, motion.linearize(window.values), _off_prior(window), vision)

    @cached_property
    def error(self) -> float:
        prior, off = self.window.prior, self.off_prior
        of_prior = float(0.5 * off @ prior.information @ off - prior.vector @ off)
        return of_prior + float(self.motion.error(self.window.values.zeroVectors())) + float(self.vision.losses.sum())

    def linearised(self) -> System:
        window, count, size = self.window, len(self.window.keys), len(self.off_prior)
        d = window.size
        information, vector = self.of_motion(window.all_keys)
        information[:size, :size] += window.prior.information
        vector[:size] += window.prior.vector - window.prior.information @ self.off_prior
        vision = self.vision.reduced()
        information.reshape(count, d, count, d)[:, :6, :, :6] += vision.information.reshape(count, 6, count, 6)
        vector.reshape(count, d)[:, :6] += vision.vector.reshape(count, 6)
        return System(information, vector, vision)

    def of_motion(self, keys: list[int]) -> tuple[Array, Array]:
        """Return the normal equations of the motion factors on some variables, which include all that are tied."""
        known = set(self.motion.keyVector())
        tied, dims = [key in known for key in keys], self.window.values.dims()
        rows = np.flatnonzero(np.repeat(tied, [dims[key] for key in keys]))
        size = sum(dims[key] for key in keys)
        if not known:
            return np.zeros((size, size)), np.zeros(size)
        # The matrix is symmetric and column-major, so its transpose is the same matrix in NumPy's row-major order.
        augmented = self.motion.augmentedHessian(ordering_of(key for key in keys if key in known)).T
        if len(rows) == size:
            return augmented[:-1, :-1], augmented[-1, :-1]
        information, vector = np.zeros((size, size)), np.zeros(size)
        information[np.ix_(rows, rows)], vector[rows] = augmented[:-1, :-1], augmented[-1, :-1]
        return information, vector


def _off_prior(window: StereoWindow) -> Array:
    """Return the deviation (D,) of the prior's states from its linearisation point."""
    about = window.prior.about
    keys = [key for key in window.all_keys if about.exists(key)]
    if not keys:
        return np.zeros(0)
    delta = about.localCoordinates(window.values.extract(keys))
    return np.concatenate([delta.at(key) for key in keys])


def lower_factor(matrix: Array) -> Array:
    """Return the lower Cholesky factor of a symmetric matrix; raises LinAlgError where there is none."""
    # LAPACK is column-major and NumPy row-major: a symmetric matrix is its own transpose and need not be copied.
    root = np.asarray(cholesky(matrix.T, lower=True, check_finite=False))
    # OpenBLAS takes NaN for positive. A row of the factor that has any has it on the diagonal.
    if not np.isfinite(np.diagonal(root)).all():
        raise np.linalg.LinAlgError("the information matrix has entries that are not finite")
    return root


@dataclass(frozen=True, eq=False)
class SolvedWindow:
    """A window at its minimum, and the root of its information, linearised one step before the minimum."""

    window: StereoWindow
    root: Array

    def cov(self, i: int) -> Array:
        """Return the marginal covariance (d, d) of state i, in GTSAM's tangent spaces.

        The root's rows are in the order of time, and rows before the state do not involve it.
        """
        d = self.window.size
        later = self.root[i * d :, i * d :]
        half = solve_triangular(later, np.eye(len(later), d), lower=True, check_finite=False)
        return np.asarray(half.T @ half)


@dataclass(frozen=True)
class Ending:
    """When a solve ends: after a short step, in sigmas of all states together, a small gain, or too many iterations.

    Newton's method converges quadratically: after a step of two sigmas, the next is a tenth of a sigma, and a smoother
    takes it with the next frame. If a step gains hardly anything, further ones gain nothing.
    """

    step_sigmas: float = 2.0
    relative_decrease: float = 1e-3
    iterations: int = 5


def solve_window(window: StereoWindow, camera: RobustCamera, ending: Ending) -> SolvedWindow:
    """Return the window at its minimum, by Levenberg-Marquardt; raise EstimatorError where it has none."""
    here, damping = Evaluated.of(window, camera), 0.0
    check_error(here.error)
    for _ in range(ending.iterations):
        system = here.linearised()
        there, sigmas, damping = _descent(here, system, damping, camera)
        decrease, here = here.error - there.error, there
        if sigmas <= ending.step_sigmas or decrease <= ending.relative_decrease * here.error:
            break
        damping = damping / 10.0 if damping > _FIRST_DAMPING else 0.0
    try:
        return SolvedWindow(here.window, system.root)
    except np.linalg.LinAlgError as refusal:
        raise EstimatorError(f"the window does not determine its states ({refusal})") from refusal


def check_error(error: float) -> None:
    """Raise EstimatorError where a window's error is not finite: no step would be found to lower it."""
    if not np.isfinite(error):
        raise EstimatorError("the window's error is not a number; look for NaN in the measurements or the start")


class Eliminated(NamedTuple):
    """Unknowns that were eliminated: the lower root (n, n) of their information, and what they depend on.

    ``across`` (n, m) is their coupling to the others and ``vector`` (n,) their own, both divided by the root.
    """

    root: Array
    across: Array
    vector: Array

    def steps(self, others: Array) -> Array:
        """Return their steps (n,) for steps (m,) of the others."""
        whitened = self.vector - self.across @ others
        return np.asarray(solve_triangular(self.root, whitened, lower=True, trans="T", check_finite=False))


def without(information: Array, vector: Array, count: int) -> tuple[Array, Array, Eliminated]:
    """Eliminate the first ``count`` unknowns of normal equations (D, D), (D,): a Schur complement.

    Raises LinAlgError where the information is singular.
    """
    root = lower_factor(information[:count, :count])
    right = np.column_stack([information[:count, count:], vector[:count]])
    right = solve_triangular(root, right, lower=True, check_finite=False)
    across, own = right[:, :-1], right[:, -1]
    reduced = information[count:, count:] - across.T @ across
    return reduced, vector[count:] - across.T @ own, Eliminated(root, across, own)


def without_oldest(window: StereoWindow, count: int, camera: RobustCamera) -> StereoWindow:
    """Marginalise the ``count`` oldest states with every track they saw."""
    seen = window.sightings
    is_leaving = np.isin(seen.point, seen.point[seen.pose < count])
    leaving = replace(window.with_sightings(is_leaving), motion=window.motion[: count + 1])
    system, gone = Evaluated.of(leaving, camera).linearised(), count * window.size
    information, vector, _ = without(system.information, system.vector, gone)
    left = window.with_sightings(~is_leaving).later(count)
    return replace(left, prior=MarginalPrior(information, vector, left.values))


def _descent(here: Evaluated, system: System, damping: float, camera: RobustCamera) -> tuple[Evaluated, float, float]:
    """Return the window after the least damped step that does not raise the cost, or after a step of length zero.

    With it the step's length, in standard deviations of all states together, and its damping.
    """
    while damping <= _MOST_DAMPING:
        try:
            step = cho_solve((system.damped_root(damping), True), system.vector, check_finite=False)
            pose_steps = step.reshape(len(here.window.keys), -1)[:, :6].ravel()
            moved = here.window.moved(step, system.vision.point_steps(pose_steps))
            there = Evaluated.of(moved, camera)
            if not there.error <= here.error:
                there = Evaluated.of(_with_shortened_landmark_steps(moved, here.window.points, camera), camera)
            if there.error <= here.error:
                return there, float(np.sqrt(step @ system.vector)), damping
        except np.linalg.LinAlgError:
            pass
        damping = max(10.0 * damping, _FIRST_DAMPING)
    return here, 0.0, damping


def _with_shortened_landmark_steps(moved: StereoWindow, before: Array, camera: RobustCamera) -> StereoWindow:
    """Return the window with each landmark (M,) moved by the part of its step with the lowest cost of its sightings.

    A landmark that comes nearer by metres may overshoot to behind a camera, and alone would make every step fail.
    """
    places = np.array([before + share * (moved.points - before) for share in _SHARES])
    costs = [Vision.at(moved.poses, points, moved.sightings, camera).loss_of_points for points in places]
    cheapest = np.nan_to_num(costs, nan=np.inf).argmin(axis=0)
    return replace(moved, points=places[cheapest, np.arange(len(before))])
