"""What a metric is computed from: an estimate against the truth, or one output of a run and its sequence.

Association, the same for every estimator on a sequence: a truth stamp is scored where an estimate lies within the
stamp tolerance (1 ms, or a quarter of the truth's period if that is less; stamps that coincide up to rounding are
never interpolated), or where it lies between two estimates at most 1.5 frame periods apart (the estimate is then
interpolated on the geodesic of SE(3)). Everything else is not scored; the coverage counts it as missing.

Alignment: by the first pose, or by the best fit of all positions. Sources: Umeyama, "Least-squares estimation of
transformation parameters between two point patterns" (PAMI 1991); Zhang and Scaramuzza, "A tutorial on quantitative
trajectory evaluation for visual(-inertial) odometry" (IROS 2018) for the fit of yaw and position, the four degrees of
freedom a visual-inertial estimator cannot observe.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from toolkit.answers import Output, Run
from toolkit.arrays import rows_of
from toolkit.estimate import Trajectory
from toolkit.geometry import (
    Array,
    BoolArray,
    IntArray,
    about_z,
    interpolate_poses,
    nearest_rotation,
    se3,
    se3_inverse,
    so3_angle,
)
from toolkit.metrics.parts.leave_one_out import errors_left_out
from toolkit.metrics.parts.scores import Unavailable
from toolkit.sequence import Sequence, Truth

STAMP_TOLERANCE_NS = 1_000_000
WIDEST_BRIDGE_IN_FRAME_PERIODS = 1.5
# Ratio of the second to the first singular value of the covariance below which the positions lie on a line: the
# squared sideways extent is then 1e-12 of the squared length, a micrometre in a metre.
_COLLINEAR = 1e-12


@dataclass(frozen=True, eq=False)
class Matched:
    """The n pairs that are scored: stamps (n,), true and estimated poses (n, 4, 4), path (n,) m.

    ``path_m`` is the distance travelled along the whole truth up to each pair, so a gap in the estimate does
    not shorten it. The estimates are in their own world.
    """

    t_ns: IntArray
    truth: Array
    estimate: Array
    path_m: Array

    def __len__(self) -> int:
        return self.t_ns.size

    @property
    def positions(self) -> tuple[Array, Array]:
        """The true and the estimated positions (n, 3) m, to fit the one to the other."""
        return self.truth[:, :3, 3], self.estimate[:, :3, 3]


def finite_poses(poses: Array) -> BoolArray:
    return np.asarray(np.isfinite(poses).all(axis=(-2, -1)))


def median_period_ns(t_ns: IntArray) -> float:
    """Return the median step of stamps (N,), 0 where there are fewer than two."""
    return float(np.median(np.diff(t_ns))) if t_ns.size > 1 else 0.0


def associate(estimate: Trajectory, truth: Truth, frame_period_ns: float) -> Matched:
    """Match an estimate with the truth on the truth's stamps; poses that are not finite take no part."""
    known = finite_poses(truth.T_world_imu)
    truth_t_ns, truth_poses = truth.t_ns[known], truth.T_world_imu[known]
    usable = finite_poses(estimate.T_world_imu)
    t_ns, poses = estimate.t_ns[usable], estimate.T_world_imu[usable]
    if t_ns.size == 0 or truth_t_ns.size == 0:
        return Matched(np.empty(0, np.int64), np.empty((0, 4, 4)), np.empty((0, 4, 4)), np.empty(0))
    scored, estimates = poses_at(t_ns, poses, truth_t_ns, frame_period_ns)
    path_m = distance_along(truth_poses[:, :3, 3])
    return Matched(truth_t_ns[scored], truth_poses[scored], estimates, path_m[scored])


def true_poses_at(t_ns: IntArray, truth: Truth, frame_period_ns: float) -> tuple[BoolArray, Array]:
    """Return which of the stamps (N,) the truth covers, and the true poses (n, 4, 4) there, by the rule above.

    The roles are exchanged: here the truth is interpolated, because a stated covariance belongs to the estimate's own
    stamp.
    """
    known = finite_poses(truth.T_world_imu)
    if not known.any() or t_ns.size == 0:
        return np.zeros(t_ns.size, dtype=bool), np.empty((0, 4, 4))
    return poses_at(truth.t_ns[known], truth.T_world_imu[known], t_ns, frame_period_ns)


def poses_at(t_ns: IntArray, poses: Array, at_ns: IntArray, frame_period_ns: float) -> tuple[BoolArray, Array]:
    """Return which of the stamps (M,) finite poses (N, 4, 4), N > 0, cover by the rule above, and the poses there."""
    tolerance_ns = min(STAMP_TOLERANCE_NS, median_period_ns(at_ns) / 4.0) if at_ns.size > 1 else STAMP_TOLERANCE_NS
    after = np.clip(np.searchsorted(t_ns, at_ns), 0, t_ns.size - 1)
    before = np.maximum(after - 1, 0)
    nearest = np.where(np.abs(t_ns[after] - at_ns) < np.abs(at_ns - t_ns[before]), after, before)
    coincides = np.abs(t_ns[nearest] - at_ns) <= tolerance_ns
    inside = (t_ns[before] < at_ns) & (at_ns < t_ns[after])
    bridged = inside & (t_ns[after] - t_ns[before] <= WIDEST_BRIDGE_IN_FRAME_PERIODS * frame_period_ns) & ~coincides
    result = np.array(poses[nearest])
    if bridged.any():
        result[bridged] = interpolate_poses(t_ns, poses, at_ns[bridged])
    scored = coincides | bridged
    return scored, result[scored]


def distance_along(positions: Array) -> Array:
    """Return the distance travelled (N,) m at each of the positions (N, 3)."""
    steps_m = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(steps_m)])


@dataclass(frozen=True, eq=False)
class Alignment:
    """The similarity x -> scale R x + t from the estimate's world to the truth's.

    ``rotation_is_unique`` is False where the positions lie on a line (or in a point): the residual distances are then
    still the least ones, but any rotation about the line gives the same distances.
    """

    rotation: Array
    translation: Array
    scale: float = 1.0
    rotation_is_unique: bool = True

    def apply(self, poses: Array) -> Array:
        """Return poses (n, 4, 4), rotated and with their positions also scaled."""
        positions = self.scale * poses[:, :3, 3] @ self.rotation.T + self.translation
        return se3(self.rotation @ poses[:, :3, :3], positions)


def place_first(truth: Array, estimate: Array, level: bool) -> Alignment:
    """Place the first estimated pose (4, 4) on the true one, by heading and position alone where the world is level.

    An estimator starts in a world of its own. With an IMU the vertical is measured, so that a tilt is an error and
    stays; without one the whole first pose is arbitrary.
    """
    if level:
        rotation = about_z(_best_yaw(truth[:3, :3] @ estimate[:3, :3].T))
        return Alignment(rotation, truth[:3, 3] - rotation @ estimate[:3, 3])
    T_truth_estimate = truth @ se3_inverse(estimate)
    return Alignment(T_truth_estimate[:3, :3], T_truth_estimate[:3, 3])


def fit_se3(truth: Array, estimate: Array) -> Alignment:
    """Fit rotation and translation to positions (n, 3) by least squares (Umeyama, eqs. 38-43 with c = 1).

    Raises Unavailable for fewer than three pairs, as do the other fits.
    """
    rotation, d = nearest_rotation(_covariance(truth, estimate))
    return _centred(truth, estimate, rotation, is_unique=bool(d[1] > _COLLINEAR * d[0]))


def fit_sim3(truth: Array, estimate: Array) -> Alignment:
    """Fit rotation, translation and scale to positions (n, 3) by least squares (Umeyama, eqs. 38-43)."""
    rotation, d = nearest_rotation(_covariance(truth, estimate))
    variance_m2 = float(np.mean(np.sum((estimate - estimate.mean(axis=0)) ** 2, axis=1)))  # eq. 36
    if variance_m2 == 0.0:
        raise Unavailable("the estimated positions are all the same, so no scale fits them")
    return _centred(truth, estimate, rotation, float(d.sum()) / variance_m2, bool(d[1] > _COLLINEAR * d[0]))


def fit_yaw(truth: Array, estimate: Array) -> Alignment:
    """Fit heading and translation to positions (n, 3) by least squares (Zhang and Scaramuzza 2018)."""
    return _centred(truth, estimate, about_z(_best_yaw(_covariance(truth, estimate))))


def _covariance(truth: Array, estimate: Array) -> Array:
    """Return the mean of (y - mean y)(x - mean x)^T (3, 3) over truth y and estimate x (Umeyama, eq. 38)."""
    if len(truth) < 3:
        raise Unavailable(f"a fit needs 3 matched pairs, there are {len(truth)}")
    covariance: Array = (truth - truth.mean(axis=0)).T @ (estimate - estimate.mean(axis=0)) / len(truth)
    if not np.isfinite(covariance).all():
        raise Unavailable("the estimated positions are too large to fit")
    return covariance


def _best_yaw(covariance: Array) -> Array:
    """Return the angle that maximises tr(Rz(angle)^T C) = (C00 + C11) cos(angle) + (C10 - C01) sin(angle)."""
    angle: Array = np.arctan2(covariance[1, 0] - covariance[0, 1], covariance[0, 0] + covariance[1, 1])
    return angle


def _centred(truth: Array, estimate: Array, rotation: Array, scale: float = 1.0, is_unique: bool = True) -> Alignment:
    """Return an alignment with the translation that maps mean to mean (Umeyama, eq. 41)."""
    return Alignment(rotation, truth.mean(axis=0) - scale * rotation @ estimate.mean(axis=0), scale, is_unique)


class AgainstTruth:
    """Pairs of true and estimated poses with their alignments, from which trajectory metrics are computed.

    The properties raise Unavailable where there is no truth, or too few pairs.
    """

    @property
    def matched(self) -> Matched:
        """The pairs of true and estimated poses that are scored; there may be none."""
        raise NotImplementedError

    @property
    def level(self) -> bool:
        """Whether the vertical is measured, as an IMU does, so that only heading and position are free."""
        raise NotImplementedError

    @cached_property
    def compared(self) -> Matched:
        """The matched pairs, of which there are at least two."""
        if len(self.matched) < 2:
            raise Unavailable(f"{len(self.matched)} pose(s) match the ground truth in time, a comparison needs 2")
        return self.matched

    @cached_property
    def oriented(self) -> Matched:
        """The matched pairs, where the true orientations are known.

        Raises Unavailable where they are all one and the estimated ones are not, as of a truth that is of positions
        alone: a prism's, an antenna's. A measured orientation does not repeat itself exactly.
        """
        pairs = self.compared
        if len(pairs) > 2 and not changes(pairs.truth[:, :3, :3]) and changes(pairs.estimate[:, :3, :3]):
            raise Unavailable("the truth is of positions alone: its orientations are all one")
        return pairs

    @cached_property
    def placed(self) -> Array:
        """The estimates (n, 4, 4) in the truth's world, brought there by the first pair alone.

        Every estimator starts in a world frame of its own. With an IMU the vertical is measured, so only heading
        and position of the first pose are aligned; without one, the whole first pose is.
        """
        pairs = self.oriented
        return place_first(pairs.truth[0], pairs.estimate[0], self.level).apply(pairs.estimate)

    @cached_property
    def se3_alignment(self) -> Alignment:
        """The rigid motion that fits the estimated positions to the true ones."""
        return fit_se3(*self.compared.positions)


@dataclass(frozen=True, eq=False)
class PairsAgainstTruth(AgainstTruth):
    """Pairs that were matched already, of a trajectory without its recording."""

    pairs: Matched
    is_level: bool = False

    @property
    def matched(self) -> Matched:
        return self.pairs

    @property
    def level(self) -> bool:
        return self.is_level


@dataclass(frozen=True, eq=False)
class Evaluation(AgainstTruth):
    """One output of a run and its sequence; properties raise Unavailable where truth or pairs are missing."""

    run: Run
    output: Output
    sequence: Sequence

    @cached_property
    def estimate(self) -> Trajectory:
        trajectory = self.run.trajectory(self.output)
        if trajectory is None:
            raise ValueError(f"{self.run.estimator} has no {self.output} output to score")
        return trajectory

    @cached_property
    def matched(self) -> Matched:
        if self.sequence.truth is None:
            raise Unavailable("the sequence has no ground truth")
        return associate(self.estimate, self.sequence.truth, median_period_ns(self.sequence.frames_t_ns))

    @property
    def level(self) -> bool:
        return self.sequence.motion_kind == "imu"

    @cached_property
    def poses_of_frames(self) -> Array:
        """The estimated pose of every frame (K, 4, 4), NaN where there is none."""
        frames_t_ns, estimate = self.sequence.frames_t_ns, self.estimate
        poses = np.full((frames_t_ns.size, 4, 4), np.nan)
        row, answered = rows_of(frames_t_ns, estimate.t_ns)
        poses[answered] = estimate.T_world_imu[row[answered]]
        return poses

    @cached_property
    def has_pose(self) -> BoolArray:
        """Whether each frame (K,) has a finite pose."""
        return finite_poses(self.poses_of_frames)

    @cached_property
    def held_out_errors(self) -> tuple[IntArray, Array]:
        """Which sightings (M,) of withheld tracks have views enough, by track, and their errors (M,) px."""
        return errors_left_out(self.sequence.held_out, self.poses_of_frames, self.sequence.rig)

    @cached_property
    def counted_frames(self) -> BoolArray:
        """Which frames (K,) an estimate is due for: those in the truth's time range, or all without a truth."""
        frames_t_ns, truth = self.sequence.frames_t_ns, self.sequence.truth
        if truth is None or truth.t_ns.size == 0:
            return np.ones(frames_t_ns.size, dtype=bool)
        begins = frames_t_ns >= truth.t_ns[0] - STAMP_TOLERANCE_NS
        return np.asarray(begins & (frames_t_ns <= truth.t_ns[-1] + STAMP_TOLERANCE_NS))


def changes(values: Array) -> bool:
    return bool(np.ptp(values, axis=0).max() > 0.0)


def relative_errors(matched: Matched, first: IntArray, last: IntArray) -> Array:
    """Return E = (Q_i^-1 Q_j)^-1 (P_i^-1 P_j) (p, 4, 4) for true poses Q, estimates P and index pairs (p,), (p,).

    Sturm et al., "A benchmark for the evaluation of RGB-D SLAM systems" (IROS 2012), eq. 2. Free of any gauge.
    """
    true_motion = se3_inverse(matched.truth[first]) @ matched.truth[last]
    estimated_motion = se3_inverse(matched.estimate[first]) @ matched.estimate[last]
    return se3_inverse(true_motion) @ estimated_motion


def lengths(vectors: Array) -> Array:
    return np.asarray(np.linalg.norm(vectors, axis=-1))


def angles_deg(rotations: Array) -> Array:
    """Return the rotation angle (...,) in degrees, 0 to 180, of rotations (..., 3, 3)."""
    return np.degrees(so3_angle(rotations))


def rmse(errors: Array) -> float:
    return float(np.sqrt(np.mean(errors**2)))
