"""The first frames adjusted together: poses, velocities, biases and landmarks, with the factors the smoothers use.

Tracks that do not fit are left out. The covariance of the result is that of the graph of the others, scaled by how much
more than stated these tracks scatter.
"""

from dataclasses import dataclass

import gtsam
import numpy as np

from toolkit.estimate import Estimate
from toolkit.geometry import Array, IntArray
from toolkit.initialization.first_guess import FirstGuess
from toolkit.measurements import ImuNoise, Motion, StereoFrame
from toolkit.models import stereo
from toolkit.models.factors import B, L, StereoFactors, X, joint_cov
from toolkit.models.gating import FEWEST_SIGHTINGS, MISMATCHED_TRACK_FACTOR, MOST_MISMATCHED, chi2_bound
from toolkit.models.motion import motion_model
from toolkit.models.state import Increment, MotionModel
from toolkit.sequence import Sequence

# Standard deviations: of the pose that fixes the gauge (rad, m), and of biases before any measurement (m/s^2, rad/s).
GAUGE_SIGMA, ACCEL_BIAS_SIGMA, GYRO_BIAS_SIGMA = 1e-4, 0.05, 0.02
# Standard deviation of a turn rate that is not measured (rad/s).
TURN_SIGMA = 2.0
# The estimators read the window's measurements again, so that in the start they have a ninth of their weight.
INFLATION = 9.0
# The start's own, whatever the estimators use: Huber's threshold is the median norm of a sound whitened residual.
_HUBER = 1.5
_PROBABILITY = 0.95
# Rounds in which tracks that do not fit are left out.
_ROUNDS = 4
# Tracks that scatter by more than this many of their stated sigmas are not explained by these motions at all.
_MOST_SIGMAS = 5.0


class NoSoundStartError(Exception):
    """The adjustment has no solution that can be believed; the message says why, as the end of a sentence."""


@dataclass(frozen=True, eq=False)
class AdjustedStart:
    """The first state, its covariance as an Estimate has it, and from how many frames."""

    first: Estimate
    cov: Array


def adjusted(frames: list[StereoFrame], motions: list[Motion], guess: FirstGuess, sequence: Sequence) -> AdjustedStart:
    """Adjust the first frames from a guess and return the state at the first.

    Raises NoSoundStartError where the graph is indeterminate, or most tracks do not fit the solution.
    """
    model = motion_model(sequence.noise, sequence.gravity_world)
    increments = [model.integrate(motion, guess.bias) for motion in motions]
    problem = _Problem(model, increments, sequence, guess)
    all_tracks = _tracks(frames).size
    values = problem.states()
    for _ in range(_ROUNDS):
        graph, values = problem.optimum(frames, values)
        scale2, mismatched = _fit(frames, values, sequence)
        if scale2 > _MOST_SIGMAS**2:
            raise NoSoundStartError(f"the tracks scatter by {np.sqrt(scale2):.0f} of their sigmas about any motion")
        frames = [frame.select(~np.isin(frame.track_ids, mismatched)) for frame in frames]
        if _tracks(frames).size < (1.0 - MOST_MISMATCHED) * all_tracks:
            raise NoSoundStartError("most tracks of the first frames do not fit the motion of the others")
        if mismatched.size == 0:
            break
    first = model.read(values, 0, frames[0].t_ns)
    try:
        cov = joint_cov(gtsam.Marginals(graph, values), model.keys(0))
    except RuntimeError as refusal:
        raise _unless_indeterminate(refusal) from refusal
    return AdjustedStart(first, max(scale2, 1.0) * INFLATION * model.estimate_cov(cov, first.T_world_imu[:3, :3]))


@dataclass(frozen=True, eq=False)
class _Problem:
    """The part of the adjustment that does not depend on the tracks that are used."""

    model: MotionModel
    increments: list[Increment]
    sequence: Sequence
    guess: FirstGuess

    def states(self) -> gtsam.Values:
        """Return the guessed states."""
        values, guess = gtsam.Values(), self.guess
        for k, (pose, velocity) in enumerate(zip(guess.T_world_imu, guess.v_world, strict=True)):
            self.model.insert(values, Estimate(0, pose, v_world=velocity, bias=guess.bias), k)
        return values

    def optimum(
        self, frames: list[StereoFrame], start: gtsam.Values
    ) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
        """Return the graph of some frames' sightings and its solution, found from states and, where known, points."""
        graph = gtsam.NonlinearFactorGraph()
        self._hold(graph)
        maker = StereoFactors(self.sequence.rig, _HUBER)
        values = gtsam.Values()
        for k, frame in enumerate(frames):
            pose = start.atPose3(X(k)).matrix()
            self.model.insert(values, self.model.read(start, k, frame.t_ns), k)
            points = stereo.triangulate_world(frame.uvs_px, pose, self.sequence.rig)
            for track_id, point in zip(frame.track_ids.tolist(), points, strict=True):
                if not values.exists(L(track_id)):
                    values.insert(L(track_id), start.atPoint3(L(track_id)) if start.exists(L(track_id)) else point)
            for factor in maker.of(frame, k):
                graph.add(factor)
            if k:
                graph.push_back(self.increments[k - 1].factors(k))
        optimizer = gtsam.LevenbergMarquardtOptimizer(graph, values)
        try:
            optimum = gtsam.Values(optimizer.optimize())
        except RuntimeError as refusal:
            raise _unless_indeterminate(refusal) from refusal
        if not np.isfinite(optimizer.error()):
            raise NoSoundStartError("the adjustment of the first frames has no finite error")
        return graph, optimum

    def _hold(self, graph: gtsam.NonlinearFactorGraph) -> None:
        if isinstance(self.sequence.noise, ImuNoise):
            _hold_gauge(graph, self.guess.T_world_imu[0, :3, :3])
        else:
            _hold_first_frame(graph)


def _unless_indeterminate(refusal: RuntimeError) -> Exception:
    if "Indeterminate" in str(refusal):
        return NoSoundStartError("the adjustment of the first frames has no sound solution")
    return refusal


def _tracks(frames: list[StereoFrame]) -> IntArray:
    return np.unique(np.concatenate([frame.track_ids for frame in frames]))


def _fit(frames: list[StereoFrame], values: gtsam.Values, sequence: Sequence) -> tuple[float, IntArray]:
    """Return the median ratio of the tracks' squared residuals to the stated noise, and the tracks that do not fit it.

    A track of n sightings has 3 n - 3 degrees of freedom, its landmark taken out.
    """
    whitener = sequence.rig.whitener
    ids, squares = [], []
    for k, frame in enumerate(frames):
        points = np.array([values.atPoint3(L(i)) for i in frame.track_ids.tolist()]).reshape(-1, 3)
        predicted = stereo.predict(points, values.atPose3(X(k)).matrix(), sequence.rig)
        ids.append(frame.track_ids)
        squares.append((((frame.uvs_px - predicted.uv_px) @ whitener.T) ** 2).sum(axis=1))
    tracks, row, sightings = np.unique(np.concatenate(ids), return_inverse=True, return_counts=True)
    chi2 = np.bincount(row, weights=np.concatenate(squares))
    decided = sightings >= FEWEST_SIGHTINGS
    freedom = 3 * (np.maximum(sightings, FEWEST_SIGHTINGS) - 1)
    scale2 = float(np.median((chi2 / freedom)[decided]))
    bound = MISMATCHED_TRACK_FACTOR * chi2_bound(freedom, _PROBABILITY) * max(scale2, 1.0)
    return scale2, tracks[decided & (chi2 > bound)]


def _hold_gauge(graph: gtsam.NonlinearFactorGraph, attitude: Array) -> None:
    """Pin heading and position, leave roll and pitch free, and add the priors of the biases."""
    tilt_free = attitude.T @ np.diag([1.0, 1.0, GAUGE_SIGMA**2]) @ attitude
    cov = np.block([[tilt_free, np.zeros((3, 3))], [np.zeros((3, 3)), GAUGE_SIGMA**2 * np.eye(3)]])
    pose = gtsam.Pose3(np.block([[attitude, np.zeros((3, 1))], [np.zeros((1, 3)), np.ones((1, 1))]]))
    graph.add(gtsam.PriorFactorPose3(X(0), pose, gtsam.noiseModel.Gaussian.Covariance(cov)))
    sigmas = np.repeat([ACCEL_BIAS_SIGMA, GYRO_BIAS_SIGMA], 3)
    graph.add(
        gtsam.PriorFactorConstantBias(B(0), gtsam.imuBias.ConstantBias(), gtsam.noiseModel.Diagonal.Sigmas(sigmas))
    )


def _hold_first_frame(graph: gtsam.NonlinearFactorGraph) -> None:
    """Pin the whole pose, which is the world, and say how large a turn rate may be."""
    graph.add(gtsam.PriorFactorPose3(X(0), gtsam.Pose3(), gtsam.noiseModel.Isotropic.Sigma(6, GAUGE_SIGMA)))
    graph.add(gtsam.PriorFactorVector(B(0), np.zeros(3), gtsam.noiseModel.Isotropic.Sigma(3, TURN_SIGMA)))
