"""Says when a run has lost its way, without truth: its trajectory contradicts the measured motion, or it hears nothing.

The correction a consistent filter makes at a frame has the covariance it takes away: what it had before, less what
it has after. In a steady state that is what the motion noise adds in a frame; a filter that learns its heading or a
bias after a long drive may take away, and so jump by, much more, if its own covariances say so. Steps far outside
that are rare in a filter that works and common in one that has lost its way.
"""

from collections.abc import Iterator, Mapping
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy.special import chdtri

from toolkit.estimate import Trajectory
from toolkit.geometry import Array, se3_adjoint, se3_inverse, se3_log
from toolkit.models import imu, twist
from toolkit.sequence import ImuNoise, Packet, Sequence, TwistMotion, TwistNoise

# A windowed filter puts corrections off and then makes several frames' worth at once: five times the motion noise.
_LUMP_FRAMES = 5
# A step beyond this squared distance happens once in a million consistent steps.
FAR_STEP = float(chdtri(6, 1e-6))
# Mismatches and poor noise figures make some steps far in healthy runs too: up to one in seven where frames are stale
# and tracks slip, by estimators that end within 2 m of each other after 1.3 km. A sixth of all is no accident.
MOST_FAR_STEPS = 1.0 / 6.0
# The gate passes 95 % of sound measurements, and still 65 % where tracks slip all the time. A filter that is sure of
# a wrong pose hears next to nothing, and from then on: so much must pass in the whole run and in its last quarter.
LEAST_ACCEPTED, _FEWEST_TESTED = 0.3, 200
# What a correction may do beyond the noise of an IMU, whose velocity and biases it corrects as well:
# rad/s of turn rate and m/s of velocity.
_IMU_SLACK = np.repeat([0.02, 0.2], 3)


def contradiction(trajectory: Trajectory, sequence: Sequence) -> str | None:
    """Return why the trajectory cannot be right, or None. Its stamps must be the sequence's frames."""
    if not np.isfinite(trajectory.T_world_imu).all():
        first = int(np.flatnonzero(~np.isfinite(trajectory.T_world_imu).all(axis=(1, 2)))[0])
        return f"its poses are not numbers from estimate {first} on"
    far = np.fromiter((d > FAR_STEP for d in _step_distances(trajectory, sequence)), dtype=bool)
    if far.size == 0 or far.mean() <= MOST_FAR_STEPS:
        return None
    return (
        f"{100.0 * far.mean():.0f} % of its steps contradict the measured motion by more than chance allows "
        f"(at most {100.0 * MOST_FAR_STEPS:.0f} % do in a run that works)"
    )


def deafness(info: Mapping[str, Array]) -> str | None:
    """Return why an estimator with these diagnostics of N frames has lost its way, or None."""
    if not info.keys() >= {"gate_tested", "gate_accepted"}:
        return None
    tested, accepted = np.nan_to_num(info["gate_tested"]), np.nan_to_num(info["gate_accepted"])
    for part, words in ((slice(None), "all it saw"), (slice(3 * tested.size // 4, None), "what it saw in the end")):
        heard, asked = accepted[part].sum(), tested[part].sum()
        if asked >= _FEWEST_TESTED and heard < LEAST_ACCEPTED * asked:
            return (
                f"{100.0 * heard / asked:.0f} % of {words} passed its own gate: it is sure of a wrong pose "
                f"(at least {100.0 * LEAST_ACCEPTED:.0f} % pass in a run that works)"
            )
    return None


def _step_distances(trajectory: Trajectory, sequence: Sequence) -> Iterator[float]:
    """Yield the squared Mahalanobis distance of each step between neighbouring frames from the measured motion."""
    row_of = {int(t_ns): row for row, t_ns in enumerate(trajectory.t_ns)}
    for before, packet in pairwise(sequence.packets()):
        start, end = row_of.get(before.frame.t_ns), row_of.get(packet.frame.t_ns)
        if start is None or end is None:
            continue
        deviation, cov = _deviation(trajectory, start, end, packet, sequence)
        yield float(deviation @ np.linalg.solve(cov, deviation))


def _deviation(trajectory: Trajectory, start: int, end: int, packet: Packet, sequence: Sequence) -> tuple[Array, Array]:
    """Return the step's deviation (6,) from the measured motion, in the tangent of its end, and its covariance."""
    if isinstance(packet.motion, TwistMotion) and isinstance(sequence.noise, TwistNoise):
        predicted = _twist_prediction(trajectory, start, packet.motion, sequence.noise)
    else:
        predicted = _imu_prediction(trajectory, start, packet, sequence)
    cov = _LUMP_FRAMES * predicted.cov
    if trajectory.cov is not None:
        cov = cov + _taken_away(trajectory.cov[start], trajectory.cov[end], predicted)
    return se3_log(se3_inverse(predicted.T_world_imu) @ trajectory.T_world_imu[end]), cov


class _Predicted(NamedTuple):
    """Where the measured motion leads, what of the state's error (d,) reaches the pose (6, d), and its own noise."""

    T_world_imu: Array
    transition: Array
    cov: Array


def _taken_away(cov_start: Array, cov_end: Array, predicted: _Predicted) -> Array:
    """Return the pose covariance (6, 6) that the correction at the end of a step took away, where it took any."""
    if cov_start.shape[0] != predicted.transition.shape[1]:
        return np.zeros((6, 6))
    taken = predicted.transition @ cov_start @ predicted.transition.T + predicted.cov - cov_end[:6, :6]
    if not np.isfinite(taken).all():
        return np.zeros((6, 6))
    size, axes = np.linalg.eigh(taken)
    return np.asarray((axes * np.maximum(size, 0.0)) @ axes.T)


def _twist_prediction(trajectory: Trajectory, start: int, motion: TwistMotion, noise: TwistNoise) -> _Predicted:
    bias = np.zeros(3) if trajectory.bias is None else trajectory.bias[start, 3:]
    step = twist.integrate(motion, bias, noise)
    transition = np.hstack([se3_adjoint(se3_inverse(step.T_start_end)), step.d_step_d_bias])
    return _Predicted(trajectory.T_world_imu[start] @ step.T_start_end, transition, step.cov)


def _imu_prediction(trajectory: Trajectory, start: int, packet: Packet, sequence: Sequence) -> _Predicted:
    assert packet.motion is not None and not isinstance(packet.motion, TwistMotion)
    assert isinstance(sequence.noise, ImuNoise)
    bias = np.zeros(6) if trajectory.bias is None else trajectory.bias[start]
    params = imu.preintegration_params(sequence.noise, sequence.gravity_world)
    preintegration = imu.preintegrate(packet.motion, bias, params)
    slack = (_IMU_SLACK * float(packet.motion.dt_s.sum())) ** 2
    if trajectory.v_world is None:  # without a velocity only the rotation can be compared
        slack[3:] = 1e12
    v_world = np.zeros(3) if trajectory.v_world is None else trajectory.v_world[start]
    step = imu.predict(preintegration, trajectory.T_world_imu[start], v_world, bias)
    return _Predicted(step.T_world_imu, step.transition[:6], step.cov[:6, :6] + np.diag(slack))
