"""The joint belief of the windowed filters: the present IMU state, clones of past poses, landmarks, their covariance.

Only this class touches the covariance. Every quantity that measurements are linearised about is kept twice: its present
estimate and its first estimate; the filter chooses which of the two a Jacobian uses. At the latest estimates, the
same landmark or pose enters different Jacobians with different values; together these reduce the variance of the
heading, which no measurement observes. At first estimates the unobservable directions stay unobservable (Huang,
Mourikis & Roumeliotis 2010; Li & Mourikis 2013, "High-precision, consistent EKF-based visual-inertial odometry",
section 4).
"""

from copy import copy
from dataclasses import replace
from typing import NamedTuple, Self

import numpy as np
from scipy.linalg.blas import dsyrk, dtrmm, dtrsm
from scipy.linalg.lapack import dpotrf

from filters.kalman.online_output import LandmarkMemory
from toolkit.arrays import is_among
from toolkit.estimator import Setup
from toolkit.geometry import Array, BoolArray, IntArray, se3_exp, se3_inverse, transform
from toolkit.measurements import Motion, StereoFrame, StereoRig
from toolkit.models import stereo
from toolkit.models.gating import FrameGate, mahalanobis_squared
from toolkit.models.state import POSE, Belief, Increment, Prediction, Predictor
from toolkit.settings import Scalar

# At least this share of each variance is assumed independent of all other errors. A smaller share is lost in rounding,
# and without it the covariance of two clones of one pose, equal to sixteen digits, has no Cholesky root.
_LEAST_INDEPENDENT = 1e-12


class JointBelief:
    """Error state in this order: the IMU's d, three per landmark (in world axes), six per clone (oldest first)."""

    def __init__(self, core: Belief) -> None:
        self._core = core
        self.first_core = core
        self.clones: Array = np.empty((0, 4, 4))
        self.first_clones: Array = np.empty((0, 4, 4))
        self.landmark_ids: IntArray = np.empty(0, dtype=np.int64)
        self.points: Array = np.empty((0, 3))
        self.first_points: Array = np.empty((0, 3))
        self._cov = _symmetric(core.cov)

    @property
    def core(self) -> Belief:
        """Return the belief of the present IMU state, everything else marginalised."""
        core, d = self._core, self._core.layout.size
        # Copied: a view would keep the whole covariance alive.
        return Belief(core.layout, core.T_world_imu, core.v_world, core.bias, self._cov[:d, :d].copy())

    @property
    def cov(self) -> Array:
        """Return the whole covariance (n, n); do not write to it."""
        return self._cov

    @property
    def landmark_columns(self) -> slice:
        d = self._core.layout.size
        return slice(d, d + 3 * len(self.points))

    @property
    def clone_columns(self) -> slice:
        return slice(self.landmark_columns.stop, self._cov.shape[0])

    def propagate(self, prediction: Prediction, transition: Array) -> None:
        """Propagate the IMU state by its transition (d, d); the prediction is the first estimate of the new instant."""
        d = self._core.layout.size
        self._core = replace(self._core, T_world_imu=prediction.T_world_imu, v_world=prediction.v_world)
        self.first_core = self._core
        cov, carried = self._cov.copy(), transition @ self._cov[:d]
        cov[:d], cov[d:, :d] = carried, carried[:, d:].T
        cov[:d, :d] = _symmetric(carried[:, :d] @ transition.T + prediction.noise)
        self._cov = cov

    def clone(self) -> None:
        """Add a clone of the present pose with all its correlations (stochastic cloning)."""
        cov, n = self._cov, len(self._cov)
        self._cov = np.empty((n + 6, n + 6))
        self._cov[:n, :n], self._cov[n:, :n] = cov, cov[:6]
        self._cov[:n, n:], self._cov[n:, n:] = cov[:, :6], cov[:6, :6]
        self.clones = np.concatenate([self.clones, self._core.T_world_imu[None]])
        self.first_clones = np.concatenate([self.first_clones, self.first_core.T_world_imu[None]])

    def marginalise_clones(self, count: int) -> None:
        """Marginalise the oldest clones: their rows and columns are dropped."""
        cov, n, first = self._cov, 6 * count, self.clone_columns.start
        self._cov = np.empty((len(cov) - n, len(cov) - n))
        self._cov[:first, :first], self._cov[first:, :first] = cov[:first, :first], cov[first + n :, :first]
        self._cov[:first, first:], self._cov[first:, first:] = cov[:first, first + n :], cov[first + n :, first + n :]
        self.clones, self.first_clones = self.clones[count:], self.first_clones[count:]

    def marginalise_landmarks(self, which: BoolArray) -> None:
        """Marginalise landmarks (L,)."""
        kept = np.ones(self._cov.shape[0], dtype=bool)
        kept[self.landmark_columns] = np.repeat(~which, 3)
        self._cov = self._cov.compress(kept, axis=0).compress(kept, axis=1)
        self.landmark_ids = self.landmark_ids[~which]
        self.points, self.first_points = self.points[~which], self.first_points[~which]

    def add_landmarks(self, track_ids: IntArray, points: Array, jacobian: Array, covs: Array) -> None:
        """Add landmarks (N,) at points (N, 3) m of error ``jacobian`` (3 N, 6 C) times the clones' error, plus noise.

        ``covs`` (N, 3, 3) are the covariances of that noise, independent of the state and from landmark to landmark.
        """
        before, end = self._cov, self.landmark_columns.stop
        cross = jacobian @ before[self.clone_columns]
        own = cross[:, self.clone_columns] @ jacobian.T
        own.reshape(len(covs), 3, len(covs), 3)[np.arange(len(covs)), :, np.arange(len(covs))] += covs
        rows = np.concatenate([before[:end], cross, before[end:]])
        columns = np.concatenate([cross.T[:end], _symmetric(own), cross.T[end:]])
        self._cov = np.concatenate([rows[:, :end], columns, rows[:, end:]], axis=1)
        self.landmark_ids = np.concatenate([self.landmark_ids, track_ids])
        self.points = np.concatenate([self.points, points])
        self.first_points = np.concatenate([self.first_points, points])

    def update(self, carried: Array, innovation_cov: Array, residual: Array) -> None:
        """Correct the whole state by whitened residuals (m,), given H P (m, n) and H P H^T + 1 (m, m), overwritten."""
        root, half_gain = self.reduce_covariance(carried, innovation_cov)
        self.move(half_gain.T @ divided_by_root(root, residual[:, None].copy())[:, 0])

    def inform(self, blocks: Array, taken: Array, vector: Array) -> None:
        """Correct the whole state by information on the last clones: a matrix L (k, k) and a vector (k,).

        L is block diagonal with ``blocks`` (k / 6, 6, 6), less ``E^T E`` with E = ``taken`` (m, k), which may be
        overwritten. It equals :meth:`update` by rows H and residuals r with ``H^T H = L`` and ``H^T r`` the vector,
        whatever their number. Let P be the covariance, P_k its rows of those clones, R the root of their covariance,
        ``Y = R^-1 P_k`` and ``M = 1 + R^T L R``. Then the correction is ``Y^T M^-1 R^T H^T r`` and the new covariance
        ``P - Y^T Y + Y^T M^-1 Y``. The columns of Y for those clones are ``R^T``.
        """
        first = self._cov.shape[0] - len(vector)
        root = regular_root(self._cov[first:, first:])
        matrix_root = root_with_information(root, blocks, times_root(taken, root))
        to_others = divided_by_root(root, self._cov[first:, :first].copy())
        half_gain = divided_by_root(matrix_root, np.concatenate([to_others, root.T], axis=1))
        others = self._cov[:first, :first] - to_others.T @ to_others
        self._cov = half_gain.T @ half_gain
        self._cov[:first, :first] += others
        self.move(half_gain.T @ divided_by_root(matrix_root, (root.T @ vector)[:, None])[:, 0])

    def reduce_covariance(self, carried: Array, innovation_cov: Array) -> tuple[Array, Array]:
        """Reduce the covariance by whitened measurements, given as to :meth:`update`; the estimates stay.

        Return the lower root of the innovations' covariance (m, m), and H P divided by it.
        """
        root = cholesky_root(innovation_cov)
        half_gain = divided_by_root(root, carried)
        # NumPy's product of a matrix with its own transpose is exactly symmetric.
        taken_away = half_gain.T @ half_gain
        self._cov = np.subtract(self._cov, taken_away, out=taken_away)
        return root, half_gain

    def move(self, delta: Array) -> None:
        """Move every estimate by an error (n,); first estimates stay."""
        self._displace(delta)

    def displaced(self, delta: Array) -> Self:
        """Return the estimates as after :meth:`move` by an error (n,), with the covariance from before it."""
        result = copy(self)
        result._displace(delta)
        return result

    def _displace(self, delta: Array) -> None:
        d, clones = self._core.layout.size, self.clone_columns
        steps = se3_exp(np.concatenate([delta[POSE], delta[clones]]).reshape(-1, 6))
        self._core = self._core.displaced(delta[:d], steps[0])
        self.clones = self.clones @ steps[1:]
        self.points = self.points + delta[self.landmark_columns].reshape(-1, 3)


class AtLatestEstimates:
    """Where Jacobians are evaluated: at the latest estimates, as in the standard EKF.

    ``transition`` (d, d) is that of a prediction, ``clones`` (C, 4, 4) and ``points`` (L, 3) m are where sightings are
    linearised, and ``outdated`` (L,) says which landmarks are too far from there.
    """

    def transition(self, joint: JointBelief, increment: Increment, prediction: Prediction) -> Array:
        return prediction.transition

    def clones(self, joint: JointBelief) -> Array:
        return joint.clones

    def points(self, joint: JointBelief) -> Array:
        return joint.points

    def outdated(self, joint: JointBelief) -> BoolArray:
        return np.zeros(len(joint.points), dtype=bool)


class AtFirstEstimates:
    """First-estimate Jacobians, valid for landmarks that have moved by at most a share of their distance since."""

    def __init__(self, most_moved: float = np.inf) -> None:
        self._most_moved = most_moved

    def transition(self, joint: JointBelief, increment: Increment, prediction: Prediction) -> Array:
        """Return the transition (d, d) between the first estimates of both instants."""
        return increment.transition_between(joint.first_core, prediction)

    def clones(self, joint: JointBelief) -> Array:
        return joint.first_clones

    def points(self, joint: JointBelief) -> Array:
        return joint.first_points

    def outdated(self, joint: JointBelief) -> BoolArray:
        """Say which landmarks (L,) have moved by more than that share of their distance from the newest clone."""
        moved_m = np.linalg.norm(joint.points - joint.first_points, axis=1)
        distance_m = np.linalg.norm(joint.points - joint.clones[-1, :3, 3], axis=1)
        return np.asarray(moved_m > self._most_moved * distance_m)


Linearisation = AtLatestEstimates | AtFirstEstimates


def linearisation(setup: Setup, first: AtFirstEstimates) -> Linearisation:
    """Return what an estimator's option ``linearisation`` says: at ``first`` estimates, or at the latest."""
    points: dict[Scalar, Linearisation] = {"first": first, "latest": AtLatestEstimates()}
    return setup.choice("linearisation", points)


def propagate(joint: JointBelief, model: Predictor, at: Linearisation, motion: Motion | None) -> None:
    """Propagate a joint belief over the motion between two frames; the first frame has none (None)."""
    if motion is None:
        return
    core = joint.core
    increment = model.integrate(motion, core.bias)
    prediction = increment.predict(core)
    joint.propagate(prediction, at.transition(joint, increment, prediction))


def marginalise_lost(joint: JointBelief, frame: StereoFrame, memory: LandmarkMemory) -> None:
    """Marginalise the landmarks of the state that the frame does not show; the memory keeps their last estimates."""
    if len(joint.landmark_ids):
        marginalise(joint, ~is_among(joint.landmark_ids, frame.track_ids), memory)


def marginalise(joint: JointBelief, which: BoolArray, memory: LandmarkMemory) -> None:
    """Marginalise landmarks (L,) of the state; the memory keeps their last estimates."""
    if which.any():
        memory.remember(joint.landmark_ids[which], joint.points[which])
        joint.marginalise_landmarks(which)


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


def correct_by_landmarks(
    joint: JointBelief, frame: StereoFrame, at: Linearisation, rig: StereoRig, gate: FrameGate
) -> None:
    """Correct the whole state by its landmarks; the frame must show every one of them.

    The newest clone is the present pose: its estimate and covariance are those of the pose.
    """
    if not len(joint.landmark_ids):
        return
    seen = linearise_sightings(joint, frame, at, rig)
    cross_covs = covs_with_state(joint, seen)
    weights = weighed(joint, seen, cross_covs, gate)
    if weights.any():
        joint.update(*innovation(joint, seen, cross_covs, weights))


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


def covs_with_state(joint: JointBelief, seen: LandmarkSightings) -> Array:
    """Return the covariances H P (L, 3, n) of sightings with the whole state."""
    P = joint.cov
    by_point = seen.H_point @ P[joint.landmark_columns].reshape(-1, 3, len(P))
    return np.asarray(by_point + (seen.H_pose.reshape(-1, 6) @ P[-6:]).reshape(by_point.shape))


def weighed(joint: JointBelief, seen: LandmarkSightings, cross_covs: Array, gate: FrameGate) -> Array:
    """Return the weights of landmarks (L,): 0 unless in front of the camera with residuals that pass the gate.

    The projection formula gives a point behind the camera an image too, which may even match the measured one.
    """
    each = np.arange(len(cross_covs))
    own = cross_covs[:, :, joint.landmark_columns].reshape(each.size, 3, each.size, 3)[each, :, each]
    covs = own @ seen.H_point.mT + cross_covs[:, :, -6:] @ seen.H_pose.mT + np.eye(3)
    nis = mahalanobis_squared(seen.residuals, covs)
    return gate.weights(nis, seen.dof, gate.accepts(nis, seen.dof, seen.depth_m > 0.0))


def innovation(
    joint: JointBelief, seen: LandmarkSightings, cross_covs: Array, weights: Array
) -> tuple[Array, Array, Array]:
    """Return H P (m, n), H P H^T + 1 (m, m) and residuals (m,) of the landmarks whose weight (L,) is not zero."""
    rows = np.flatnonzero(weights)
    roots, m = np.sqrt(weights[rows])[:, None, None], 3 * rows.size
    H_pose, H_point = roots * seen.H_pose[rows], roots * seen.H_point[rows]
    cross = (roots * cross_covs[rows]).reshape(m, -1)
    # Transposed, so that each landmark's columns are a matrix in one piece.
    of_points = H_point @ np.ascontiguousarray(cross[:, joint.landmark_columns].T).reshape(-1, 3, m)[rows]
    cov = of_points.reshape(m, m) + H_pose.reshape(m, 6) @ cross[:, -6:].T
    cov.flat[:: m + 1] += 1.0
    return cross, cov, (roots[..., 0] * seen.residuals[rows]).ravel()


def cholesky_root(cov: Array) -> Array:
    """Return the lower triangular C of ``C C^T`` (n, n), which may be overwritten; raise LinAlgError without one."""
    # LAPACK is column-major and NumPy row-major: the transposed upper root is the lower one, and nothing is copied.
    root, failed = dpotrf(cov.T, lower=0, overwrite_a=1)
    if failed:
        raise np.linalg.LinAlgError("Matrix is not positive definite")
    return np.asarray(root.T)


def regular_root(cov: Array) -> Array:
    """Return the lower triangular root of a covariance (n, n) that may be singular up to rounding.

    Each variance is increased by a relative rounding error. Raises LinAlgError where it has no root even then.
    """
    cov = cov.copy()
    cov.flat[:: len(cov) + 1] *= 1.0 + _LEAST_INDEPENDENT
    return cholesky_root(cov)


def divided_by_root(root: Array, right: Array) -> Array:
    """Return ``C^-1 B`` of a lower triangular root C (n, n) and right sides B (n, m), which may be overwritten."""
    # BLAS is column-major and NumPy row-major: for the transposed problem nothing is copied.
    result: Array = dtrsm(1.0, root.T, right.T, side=1, overwrite_b=1).T
    return result


def times_root(left: Array, root: Array) -> Array:
    """Return ``A C`` of A (m, n), which may be overwritten, and a lower triangular C (n, n)."""
    result: Array = dtrmm(1.0, root.T, left.T, overwrite_b=1).T if len(left) else left
    return result


def transposed_root_times(root: Array, right: Array) -> Array:
    """Return ``C^T B`` of a lower triangular C (n, n) and B (n, m), which may be overwritten."""
    result: Array = dtrmm(1.0, root.T, right.T, side=1, trans_a=1, overwrite_b=1).T
    return result


def root_with_information(
    root: Array, blocks: Array, taken: Array, weight: float = 1.0, narrow: Array | None = None
) -> Array:
    """Return the root of ``1 + weight (R^T D R - E^T E)``: R lower triangular (6 W, 6 W), D of blocks (W, 6, 6).

    E = ``taken`` (m, 6 W) is what multiplies errors of unit covariance, R times which are those of W poses; ``narrow``
    (l, k) are further rows of E of which only the first k columns are not zero.
    """
    size = len(root)
    by_blocks = (blocks @ root.reshape(-1, 6, size)).reshape(size, size)
    matrix = transposed_root_times(root, by_blocks)
    # Of the symmetric matrix only the lower half is made.
    matrix = dsyrk(-weight, taken.T, weight, matrix.T, overwrite_c=1).T if len(taken) else weight * matrix
    if narrow is not None:
        k = narrow.shape[1]
        matrix[:k, :k] -= weight * (narrow.T @ narrow)
    matrix.flat[:: size + 1] += 1.0
    return cholesky_root(matrix)


def _symmetric(cov: Array) -> Array:
    result: Array = 0.5 * (cov + cov.T)
    return result
