"""Errors (NEES) and innovations (NIS) normalised by their stated covariance, and the bands of a consistent estimator.

Bar-Shalom, Li and Kirubarajan, "Estimation with applications to tracking and navigation" (2001), section 5.4:
the normalised estimation error squared (NEES) e^T P^-1 e of a consistent estimator is chi-square distributed. Every
error is the motion, or the difference, from the estimate to the truth, in the body frame.
"""

from dataclasses import dataclass
from typing import NamedTuple, Self

import numpy as np

from toolkit.geometry import Array, BoolArray, IntArray, se3_inverse, se3_log
from toolkit.metrics.parts.evaluation import Evaluation, finite_poses, median_period_ns, place_first, true_poses_at
from toolkit.metrics.parts.scores import Unavailable
from toolkit.models.gating import chi2_bound, mahalanobis_squared
from toolkit.models.state import IMU_LAYOUT, POSE, TWIST_LAYOUT, Layout
from toolkit.sequence import Sequence

POSE_DOF = 6
SIGHTING_DOF = 3
BAND_PROBABILITY = 0.95
# The scatter of a run is estimated from the 80 % quantile of its changes from step to step (1.28 standard deviations),
# with this many frames or more.
_USUAL_SHARE, _USUAL_SIGMAS, _FEWEST_FRAMES = 0.8, 1.2816, 20
INNOVATIONS_ARE_CAUSAL = "innovations belong to the causal output"
# A first pose this improbable under its own covariance is expressed in another world frame than the truth.
OTHER_WORLD = 1e-6
PLACED = (
    "the estimate has its own world frame: its first pose is placed on the truth's, whose noise there is included "
    "in full"
)
NOT_MET = "no pose has a true one at its time"
NOT_PLACED = "the estimate has its own world frame, and the truth has no pose for its first one"
UNCOUPLED = "what couples orientation and position is not stated"
NO_SUCH_BLOCK = "it is no part of the state where the motion is a measured twist"
_LAYOUTS = {layout.size: layout for layout in (IMU_LAYOUT, TWIST_LAYOUT)}


@dataclass(frozen=True, eq=False)
class BodyErrors:
    """T_estimate^-1 T_truth (n, 4, 4) at the estimate's stamps (n,), which are its ``rows`` (n,).

    ``T_world_imu`` (n, 4, 4) are the estimated poses in the truth's world. ``placed`` is True if the estimate has its
    own world frame and was aligned with the truth's by its first pose.
    """

    t_ns: IntArray
    rows: IntArray
    T_estimate_truth: Array
    T_world_imu: Array
    placed: bool

    @classmethod
    def between(
        cls, t_ns: IntArray, rows: IntArray, poses: Array, true_poses: Array, *, placed: bool, level: bool
    ) -> Self:
        """Compare poses (n, 4, 4), ``placed`` by the first of all or not; raises Unavailable if it has no truth."""
        if placed and rows[0] != 0:
            raise Unavailable(NOT_PLACED)
        placed_poses = place_first(true_poses[0], poses[0], level).apply(poses) if placed else poses
        return cls(t_ns, rows, se3_inverse(placed_poses) @ true_poses, placed_poses, placed)

    @property
    def distance_m(self) -> Array:
        """Distances (n,) m between estimated and true positions."""
        return np.asarray(np.linalg.norm(self.T_estimate_truth[:, :3, 3], axis=1))

    def select(self, kept: BoolArray) -> "BodyErrors":
        errors, poses = self.T_estimate_truth[kept], self.T_world_imu[kept]
        return BodyErrors(self.t_ns[kept], self.rows[kept], errors, poses, self.placed)


class StatedErrors(NamedTuple):
    """The n errors whose covariance the estimate states, and these covariances (n, d, d).

    Those of orientation and position are finite; what couples the two is NaN where it is not stated.
    """

    errors: BodyErrors
    cov: Array


@dataclass(frozen=True, eq=False)
class Nees:
    """NEES at stamps (n,) of pose, orientation and position, each (n,) and divided by its degrees of freedom.

    ``errors`` (n, 6) are the logarithms. That of the pose is NaN where orientation and position are stated apart.
    """

    t_ns: IntArray
    pose: Array
    orientation: Array
    position: Array
    placed: bool
    errors: Array

    @property
    def is_coupled(self) -> bool:
        """Say whether the covariance of the whole pose is stated everywhere."""
        return bool(np.isfinite(self.pose).all())


@dataclass(frozen=True, eq=False)
class Nis:
    """The innovations of the frames that report any: their ``rows`` (n,) among the causal estimates, and sums (n,).

    ``expected`` is the mean ``nis`` of a consistent estimator: ``dof``, or less behind a gate, which removes the
    largest innovations.
    """

    rows: IntArray
    nis: Array
    dof: Array
    expected: Array

    @property
    def mean(self) -> float:
        """Return the ratio of the run's NIS to its expectation: 1 if the estimator is consistent."""
        return float(self.nis.sum() / self.expected.sum())

    @property
    def independent_dof(self) -> float:
        """Return the degrees of freedom of a chi-square variable whose relative scatter is at least that of the mean.

        Frames are independent in a consistent filter. The innovations of one frame share the error of its pose: in the
        worst case they are one innovation of a stereo sighting, of three degrees of freedom.
        """
        weights = self.expected / self.expected.sum()
        return float(1.0 / np.sum(weights**2 / np.minimum(self.dof, SIGHTING_DOF)))

    def bands(self) -> tuple[Array, Array]:
        """Return the two-sided 95 % band (n,), (n,) of each frame's ``nis`` divided by its expectation.

        A gate makes the sum of a frame's innovations scatter less than chi-square; their shared pose error makes it
        scatter more: on simulated drives 1.3 and 0.7 times the degrees of freedom. Frames are independent in a
        consistent filter, so the scatter is estimated from the changes of the run from frame to frame, which a constant
        excess does not affect. With few frames it is that of chi-square.
        """
        dof = np.asarray(self.dof, dtype=float)
        change = np.abs(np.diff((self.nis / self.expected - 1.0) * np.sqrt(dof)))
        if change.size >= _FEWEST_FRAMES:
            usual = float(np.quantile(change, _USUAL_SHARE) / (_USUAL_SIGMAS * np.sqrt(2.0)))
            dof = np.maximum(2.0 * dof / max(usual, 1e-9) ** 2, 1.0)
        tail = (1.0 - BAND_PROBABILITY) / 2.0
        return chi2_bound(dof, tail) / dof, chi2_bound(dof, 1.0 - tail) / dof


def nees_band(dof: float, runs: int = 1, probability: float = BAND_PROBABILITY) -> tuple[float, float]:
    """Return the two-sided band of a probability of the mean over ``runs`` of a NEES over its degrees of freedom.

    The sum of N independent NEES is chi-square with N times their degrees of freedom.
    """
    tail = (1.0 - probability) / 2.0
    low, high = (float(chi2_bound(dof * runs, p)) / (dof * runs) for p in (tail, 1.0 - tail))
    return low, high


def nis_over_time(evaluation: Evaluation) -> Nis:
    """Return the innovations a causal output reports, with their expected sums.

    An estimator that reports no ``nis_expected`` is assumed to have no gate. Raises Unavailable where it reports none.
    """
    info = evaluation.run.info
    if evaluation.output != "causal" or evaluation.run.causal is None:
        raise Unavailable(INNOVATIONS_ARE_CAUSAL)
    if not {"nis", "nis_dof"} <= info.keys():
        raise Unavailable("the estimator reports no innovations")
    nis, dof = info["nis"], info["nis_dof"]
    expected = info.get("nis_expected", dof)
    expected = np.where(np.isfinite(expected), expected, dof)
    rows = np.flatnonzero(np.isfinite(nis) & np.isfinite(dof) & (dof > 0.0) & (expected > 0.0))
    if not rows.size:
        raise Unavailable("no step reports an innovation")
    return Nis(rows, nis[rows], dof[rows], expected[rows])


def body_errors(evaluation: Evaluation) -> BodyErrors:
    """Return the errors of the evaluated estimate in the body frame, wherever the truth has a pose.

    In the truth's world frame without any alignment, if the sequence has a prior in that frame, as a simulated one has.
    Otherwise every estimator starts in a frame of its own and is placed by its first pose, as for ``ate_none_m``: only
    the degrees of freedom that the start fixes without measuring them are aligned. Raises Unavailable without truth, or
    where the truth begins after the estimate, for then there is no first pose to place.
    """
    truth, estimate = evaluation.sequence.truth, evaluation.estimate
    if truth is None:
        raise Unavailable("the sequence has no ground truth")
    usable = np.flatnonzero(finite_poses(estimate.T_world_imu))
    frame_period_ns = median_period_ns(evaluation.sequence.frames_t_ns)
    reached, true_poses = true_poses_at(estimate.t_ns[usable], truth, frame_period_ns)
    rows = usable[reached]
    if not rows.size:
        raise Unavailable(NOT_MET)
    if len(evaluation.matched) > 1:
        evaluation.oriented  # noqa: B018 - raises where the truth is of positions alone
    placed = not starts_in_the_truths_world(evaluation.sequence)
    compared = estimate.t_ns[rows], rows, estimate.T_world_imu[rows], true_poses
    return BodyErrors.between(*compared, placed=placed, level=evaluation.level)


def starts_in_the_truths_world(sequence: Sequence) -> bool:
    """Say whether the sequence's own prior agrees with its truth within its stated covariance."""
    truth, prior = sequence.truth, sequence.prior
    if truth is None or prior is None:
        return False
    reached, true_poses = true_poses_at(sequence.frames_t_ns[:1], truth, median_period_ns(sequence.frames_t_ns))
    if not reached.any():
        return False
    error = se3_log(se3_inverse(prior.T_world_imu) @ true_poses[0])
    off = float(mahalanobis_squared(error[None], prior.cov[None, :6, :6])[0])
    return off < float(chi2_bound(POSE_DOF, 1.0 - OTHER_WORLD))


def stated_errors(evaluation: Evaluation) -> StatedErrors:
    """Return the errors of every pose that has a covariance and a true pose.

    Raises Unavailable where there is none, where the truth is not independent of the measurements, or where a
    stated covariance is not positive definite.
    """
    truth, cov = evaluation.sequence.truth, evaluation.estimate.cov
    if truth is None:
        raise Unavailable("the sequence has no ground truth")
    if not truth.independent:
        raise Unavailable("the truth comes from the instrument that measured the motion, so agreement proves nothing")
    if cov is None:
        raise Unavailable("the estimator states no covariance")
    return with_covariances(body_errors(evaluation), cov)


def with_covariances(errors: BodyErrors, cov: Array) -> StatedErrors:
    """Return the errors whose pose has a covariance, of those (N, d, d) of all; raises as :func:`stated_errors`."""
    of_pose = cov[errors.rows, :POSE_DOF, :POSE_DOF]
    stated = np.asarray(np.isfinite(np.stack([of_pose[:, :3, :3], of_pose[:, 3:, 3:]])).all(axis=(0, 2, 3)))
    if not stated.any():
        raise Unavailable("no pose with a true one has a finite covariance")
    apart = np.where(np.isfinite(of_pose[stated]), of_pose[stated], 0.0)
    indefinite = int((np.linalg.eigvalsh(apart)[:, 0] <= 0.0).sum())
    if indefinite:
        raise Unavailable(f"the covariance of {indefinite} of {len(apart)} poses is not positive definite")
    return StatedErrors(errors.select(stated), cov[errors.rows[stated]])


def nees_over_time(evaluation: Evaluation) -> Nees:
    """Return the NEES of every pose; raises as :func:`stated_errors`, and where a pose's blocks are stated apart."""
    nees = nees_of(stated_errors(evaluation))
    if not nees.is_coupled:
        raise Unavailable(UNCOUPLED)
    return nees


def nees_of(stated: StatedErrors) -> Nees:
    errors, pose_cov = stated.errors, stated.cov[:, :POSE_DOF, :POSE_DOF]
    xi = se3_log(errors.T_estimate_truth)
    return Nees(
        errors.t_ns,
        mahalanobis_squared(xi, pose_cov) / POSE_DOF,
        mahalanobis_squared(xi[:, :3], pose_cov[:, :3, :3]) / 3.0,
        mahalanobis_squared(xi[:, 3:], pose_cov[:, 3:, 3:]) / 3.0,
        errors.placed,
        xi,
    )


def layout_of(stated: StatedErrors) -> Layout:
    """Return the layout of the stated covariance; raise Unavailable if it is that of the pose alone."""
    layout = _LAYOUTS.get(stated.cov.shape[-1])
    if layout is None:
        raise Unavailable("the covariance is that of the pose alone")
    return layout


def state_errors(evaluation: Evaluation, stated: StatedErrors) -> Array:
    """Return the errors (n, d) of the whole state. Raises Unavailable if a block or its truth is missing."""
    layout = layout_of(stated)
    errors = np.zeros((len(stated.cov), layout.size))
    errors[:, POSE] = se3_log(stated.errors.T_estimate_truth)
    biases = bias_errors(evaluation, stated)
    errors[:, layout.gyro_bias] = biases[:, 3:]
    if layout.accel_bias is not None:
        errors[:, layout.accel_bias] = biases[:, :3]
    if layout.velocity is not None:
        errors[:, layout.velocity] = velocity_errors(evaluation, stated)
    return errors


def velocity_errors(evaluation: Evaluation, stated: StatedErrors) -> Array:
    """Return the errors (n, 3) m/s of the velocity. Raises Unavailable where there is none, or no true one."""
    estimated, true = evaluation.estimate.v_world, _true(evaluation, "v_world", stated)
    if estimated is None:
        raise Unavailable("the estimator gives no velocity")
    errors = stated.errors
    own_poses = evaluation.estimate.T_world_imu[errors.rows]
    return _turned(errors.T_world_imu, true) - _turned(own_poses, estimated[errors.rows])


def bias_errors(evaluation: Evaluation, stated: StatedErrors) -> Array:
    """Return the errors (n, 6) of the biases [accel, gyro]. Raises Unavailable where there is none, or no true one."""
    estimated, true = evaluation.estimate.bias, _true(evaluation, "bias", stated)
    if estimated is None:
        raise Unavailable("the estimator gives no bias")
    return np.asarray(true - estimated[stated.errors.rows])


def _turned(T_world_imu: Array, vectors_world: Array) -> Array:
    """Return vectors (n, 3) of the world in the body frames of poses (n, 4, 4)."""
    return np.asarray((vectors_world[:, None] @ T_world_imu[:, :3, :3])[:, 0])


def _true(evaluation: Evaluation, name: str, stated: StatedErrors) -> Array:
    """Return the true velocity (n, 3) or biases (n, 6) at the estimates' stamps, interpolated linearly between its own.

    Both change little within a frame, and stamps lie between two of the truth's only by rounding.
    """
    truth = evaluation.sequence.truth
    values = None if truth is None else getattr(truth, name)
    if truth is None or values is None:
        raise Unavailable(f"the ground truth has no {'velocity' if name == 'v_world' else 'biases'}")
    seconds, at_s = (1e-9 * (t_ns - truth.t_ns[0]) for t_ns in (truth.t_ns, stated.errors.t_ns))
    return np.column_stack([np.interp(at_s, seconds, column) for column in values.T])
