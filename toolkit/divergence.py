"""Says whether a run has diverged, without truth: it contradicts the measured motion, or its gate has collapsed.

The correction that a consistent filter makes at a frame has, as its covariance, the covariance before it less the
covariance after it. In a steady state this difference is what the motion noise adds in a frame. It is much larger where
a filter learns its heading or a bias after a long drive, and then a large jump is consistent. Corrections far outside
this covariance are rare in a filter that works and common in one that has diverged.
"""

from collections.abc import Mapping

import numpy as np
from scipy.special import chdtri

from toolkit.estimate import FARTHEST_M, Trajectory
from toolkit.geometry import Array, IntArray, se3_inverse, se3_log
from toolkit.measurements import NS_PER_S
from toolkit.models.corrections import predicted_steps
from toolkit.models.gating import mahalanobis_squared
from toolkit.models.state import POSE
from toolkit.motion_samples import TwistSamples
from toolkit.sequence import Sequence

# A windowed filter corrects by several frames' tracks at once: five times the motion noise of one frame.
_LUMP_FRAMES = 5
# A step beyond this squared distance happens once in a million consistent steps.
FAR_STEP = float(chdtri(6, 1e-6))
# Where the next three are from is told in docs/estimators.md, "How a status is decided". Mismatches and poor noise
# figures make some steps far in healthy runs too. A filter whose covariance does not cover its error rejects nearly all
# measurements, and from then on: the second share must pass in the whole run and in its last quarter. A track that is
# tested as a whole passes only if all of its sightings are sound: this share of them may be outliers.
MOST_FAR_STEPS, LEAST_ACCEPTED, _MOST_OUTLIERS = 1.0 / 6.0, 0.3, 0.2
_FEWEST_TESTED = 200
# What a correction may do beyond the noise of the motion where it corrects a velocity and biases as well:
# rad/s of turn rate and m/s of velocity.
_VELOCITY_SLACK = np.repeat([0.02, 0.2], 3)

# No trajectory goes farther from its first pose than this many times the path that odometry measured (at a quarter
# more, vision and odometry disagree already). Beside an IMU, which measures no path, the limit is this speed (m/s)
# times the time since. The last number (m) allows for a correction of the first poses.
MOST_WAYS, MOST_MPS, _NO_TRAVEL_M = 2.0, 1000.0, 10.0

# Covariances are linearised anew at every frame, so their difference shows what a correction took away only down to
# this share of a standard deviation: 0.2 m for a position that is uncertain by 20 m.
_RESOLUTION = 0.01


def contradiction(trajectory: Trajectory, sequence: Sequence) -> str | None:
    """Return why the trajectory cannot be right, or None. Its stamps must be the sequence's frames."""
    if not np.isfinite(trajectory.T_world_imu).all():
        first = int(np.flatnonzero(~np.isfinite(trajectory.T_world_imu).all(axis=(1, 2)))[0])
        return f"its poses are not numbers from estimate {first} on"
    if (reason := _out_of_reach(trajectory, sequence)) is not None:
        return reason
    far = _step_distances(trajectory, sequence) > FAR_STEP
    if far.size == 0 or far.mean() <= MOST_FAR_STEPS:
        return None
    return (
        f"{100.0 * far.mean():.0f} % of its steps contradict the measured motion "
        f"(at most {100.0 * MOST_FAR_STEPS:.0f} % do in a run that works)"
    )


def _out_of_reach(trajectory: Trajectory, sequence: Sequence) -> str | None:
    """Return the first pose that is farther away than the measured motion allows, or None.

    Only this test finds a single leap after which all steps agree with the measured ones again.
    """
    position, t_ns = trajectory.T_world_imu[:, :3, 3], trajectory.t_ns
    if t_ns.size == 0:
        return None
    beyond = np.abs(position).max(axis=1) > FARTHEST_M
    if beyond.any():
        return f"its position is farther away than the Moon from estimate {int(np.argmax(beyond))} on"
    gone_m, reach_m = np.linalg.norm(position - position[0], axis=1), _reach_m(t_ns, sequence)
    beyond = gone_m > reach_m
    if not beyond.any():
        return None
    k = int(np.argmax(beyond))
    return (
        f"at estimate {k} it is {gone_m[k]:.3g} m from its first, and the measured motion covers {reach_m[k]:.3g} m "
        "at most"
    )


def _reach_m(t_ns: IntArray, sequence: Sequence) -> Array:
    """Return how far away the stamps' poses (N,) can be from the first."""
    motion, since_s = sequence.motion, (t_ns - t_ns[0]) / NS_PER_S
    if not isinstance(motion, TwistSamples):
        return np.asarray(_NO_TRAVEL_M + MOST_MPS * since_s)
    speed_mps = np.linalg.norm(motion.values[:, :3], axis=1)
    pieces_m = 0.5 * (speed_mps[1:] + speed_mps[:-1]) * np.diff(motion.t_ns) / NS_PER_S
    way_m = np.interp(t_ns, motion.t_ns, np.append(0.0, np.cumsum(pieces_m)))
    return np.asarray(_NO_TRAVEL_M + MOST_WAYS * (way_m - way_m[0]))


def gate_collapse(info: Mapping[str, Array]) -> str | None:
    """Return why an estimator with these diagnostics (N,), by name, of N frames has diverged, or None.

    Its gate has collapsed where it rejects nearly all measurements: the covariance no longer covers the error.
    """
    if not info.keys() >= {"gate_tested", "gate_accepted"}:
        return None
    tested, accepted = np.nan_to_num(info["gate_tested"]), np.nan_to_num(info["gate_accepted"])
    least = LEAST_ACCEPTED
    if "nis_dof" in info and accepted.any():
        # Of tracks as long as the accepted ones are on average.
        sightings = float(np.nansum(info["nis_dof"]) / (3.0 * accepted.sum()))
        least = min(least, float((1.0 - _MOST_OUTLIERS) ** sightings))
    for part, part_name in (
        (slice(None), "its measurements"),
        (slice(3 * tested.size // 4, None), "its last quarter's"),
    ):
        passed, count = accepted[part].sum(), tested[part].sum()
        if count >= _FEWEST_TESTED and passed < least * count:
            return (
                f"{100.0 * passed / count:.0f} % of {part_name} passed its own gate: its covariance does not cover its "
                f"error (at least {100.0 * least:.0f} % pass in a run that works)"
            )
    return None


def _step_distances(trajectory: Trajectory, sequence: Sequence) -> Array:
    """Return the squared Mahalanobis distances (S,) of steps between neighbouring frames from the measured motion."""
    steps = predicted_steps(trajectory, sequence)
    if steps is None:
        return np.empty(0)
    transition, noise = steps.predictions.transition[:, POSE], steps.predictions.noise[:, POSE, POSE]
    if steps.beliefs.layout.velocity is not None:
        slack = (_VELOCITY_SLACK * steps.dt_s[:, None]) ** 2
        if trajectory.v_world is None:  # without a velocity only the rotation can be compared
            slack[:, 3:] = 1e12
        noise = noise + slack[:, None] * np.eye(6)
    # In the tangent of the step's end.
    deviation = se3_log(se3_inverse(steps.predictions.T_world_imu) @ trajectory.T_world_imu[steps.end])
    cov = _LUMP_FRAMES * noise
    if trajectory.cov is not None:
        cov = cov + _taken_away(trajectory.cov[steps.start], trajectory.cov[steps.end], transition, noise)
        cov = cov + _RESOLUTION**2 * _finite(trajectory.cov[steps.end][:, POSE, POSE])
    return mahalanobis_squared(deviation, cov)


def _taken_away(cov_start: Array, cov_end: Array, transition: Array, noise: Array) -> Array:
    """Return the pose covariance (S, 6, 6) that the correction at the end of each step took away, where it took any.

    ``transition`` (S, 6, d) maps the error of the state to the error of the next pose; ``noise`` (S, 6, 6) is the
    covariance that a step adds.
    """
    if cov_start.shape[-1] != transition.shape[-1]:
        return np.zeros_like(noise)
    taken = transition @ cov_start @ np.swapaxes(transition, 1, 2) + noise - cov_end[:, :6, :6]
    size, axes = np.linalg.eigh(_finite(taken))
    return np.asarray((axes * np.maximum(size, 0.0)[:, None, :]) @ np.swapaxes(axes, 1, 2))


def _finite(covs: Array) -> Array:
    return np.where(np.isfinite(covs).all(axis=(1, 2), keepdims=True), covs, 0.0)
