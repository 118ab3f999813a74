"""The first frames adjusted together: poses, velocities and biases, by the motion model and the tracks' shared factors.

Tracks that do not fit are left out. The covariance of the result is that of the window of the others, scaled by how
much more than stated these tracks scatter.
"""

from dataclasses import dataclass, replace

import gtsam
import numpy as np

from toolkit.errors import EstimatorError
from toolkit.estimate import Estimate
from toolkit.geometry import Array, BoolArray
from toolkit.initialization.first_guess import FirstGuess
from toolkit.measurements import ImuNoise, Motion, StereoFrame
from toolkit.models.factors import B, X
from toolkit.models.gating import FEWEST_SIGHTINGS, MISMATCHED_TRACK_FACTOR, MOST_MISMATCHED, chi2_bound
from toolkit.models.motion import motion_model
from toolkit.models.stereo_adjustment import Ending, RobustCamera, StereoWindow, TrackedWindow, Vision, solve_window
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
_ENDING = Ending(step_sigmas=1e-2, relative_decrease=1e-9, iterations=50)


class NoSoundStartError(Exception):
    """The adjustment has no solution that can be believed; the message says why, as the end of a sentence."""


@dataclass(frozen=True, eq=False)
class AdjustedStart:
    """The first state and its covariance as an Estimate has it."""

    first: Estimate
    cov: Array


def adjusted(frames: list[StereoFrame], motions: list[Motion], guess: FirstGuess, sequence: Sequence) -> AdjustedStart:
    """Adjust the first frames from a guess and return the state at the first.

    Raises NoSoundStartError where the window is indeterminate, or most tracks do not fit the solution.
    """
    model, camera = motion_model(sequence.noise, sequence.gravity_world), RobustCamera.of(sequence.rig, _HUBER)
    factors = [model.integrate(motion, guess.bias).factors(k) for k, motion in enumerate(motions, start=1)]
    tracked = TrackedWindow.empty()
    for k, (frame, own) in enumerate(zip(frames, [_held(sequence, guess), *factors], strict=True)):
        estimate = Estimate(frame.t_ns, guess.T_world_imu[k], v_world=guess.v_world[k], bias=guess.bias)
        tracked = tracked.extended(model, estimate, own, frame, k, sequence.rig)
    all_tracks = tracked.track_ids.size
    for _ in range(_ROUNDS):
        try:
            solved = solve_window(tracked.window, camera, _ENDING)
            cov = solved.cov(0)
        except (EstimatorError, np.linalg.LinAlgError) as refusal:
            raise NoSoundStartError("the adjustment of the first frames has no sound solution") from refusal
        scale2, mismatched = _fit(solved.window, camera)
        if scale2 > _MOST_SIGMAS**2:
            raise NoSoundStartError(f"the tracks scatter by {np.sqrt(scale2):.0f} of their sigmas about any motion")
        fitting = ~mismatched[solved.window.sightings.point]
        tracked = replace(tracked, window=solved.window).with_sightings(fitting)
        if tracked.track_ids.size < (1.0 - MOST_MISMATCHED) * all_tracks:
            raise NoSoundStartError("most tracks of the first frames do not fit the motion of the others")
        if not mismatched.any():
            break
    first = model.read(solved.window.values, 0, frames[0].t_ns)
    return AdjustedStart(first, max(scale2, 1.0) * INFLATION * model.estimate_cov(cov, first.T_world_imu[:3, :3]))


def _fit(window: StereoWindow, camera: RobustCamera) -> tuple[float, BoolArray]:
    """Return the median ratio of the tracks' squared residuals to the stated noise, and which tracks (M,) do not fit.

    A track of n sightings has 3 n - 3 degrees of freedom, its landmark taken out.
    """
    seen = window.sightings
    squares = np.square(Vision.at(window.poses, window.points, seen, camera).whitened).sum(axis=1)
    sightings, chi2 = np.bincount(seen.point), np.bincount(seen.point, weights=squares)
    decided = sightings >= FEWEST_SIGHTINGS
    freedom = 3 * (np.maximum(sightings, FEWEST_SIGHTINGS) - 1)
    scale2 = float(np.median((chi2 / freedom)[decided]))
    bound = MISMATCHED_TRACK_FACTOR * chi2_bound(freedom, _PROBABILITY) * max(scale2, 1.0)
    return scale2, decided & (chi2 > bound)


def _held(sequence: Sequence, guess: FirstGuess) -> gtsam.NonlinearFactorGraph:
    """Return the priors of the first state: what fixes the gauge, and how large biases or a turn rate may be.

    With an IMU heading and position are pinned, roll and pitch are free; else the whole pose, which is the world.
    """
    graph = gtsam.NonlinearFactorGraph()
    if isinstance(sequence.noise, ImuNoise):
        attitude, cov = guess.T_world_imu[0, :3, :3], GAUGE_SIGMA**2 * np.eye(6)
        cov[:3, :3] = attitude.T @ np.diag([1.0, 1.0, GAUGE_SIGMA**2]) @ attitude
        pose = gtsam.Pose3(gtsam.Rot3(attitude), np.zeros(3))
        graph.add(gtsam.PriorFactorPose3(X(0), pose, gtsam.noiseModel.Gaussian.Covariance(cov)))
        sigmas = gtsam.noiseModel.Diagonal.Sigmas(np.repeat([ACCEL_BIAS_SIGMA, GYRO_BIAS_SIGMA], 3))
        graph.add(gtsam.PriorFactorConstantBias(B(0), gtsam.imuBias.ConstantBias(), sigmas))
    else:
        graph.add(gtsam.PriorFactorPose3(X(0), gtsam.Pose3(), gtsam.noiseModel.Isotropic.Sigma(6, GAUGE_SIGMA)))
        graph.add(gtsam.PriorFactorVector(B(0), np.zeros(3), gtsam.noiseModel.Isotropic.Sigma(3, TURN_SIGMA)))
    return graph
