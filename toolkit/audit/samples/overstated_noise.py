"""An IMU whose stated noise is far more than its samples can have: estimators then hardly use the sensor.

White noise of density s gives samples, dt apart, a standard deviation of s / sqrt(dt), and a random walk of density w
changes them by w sqrt(T) within a time T. Motion adds to both. Samples that scatter or change by much less contradict
the stated noise. A stated noise that is too small shows in residuals and is not judged here. Source: Woodman, "An
introduction to inertial navigation" (2007), section 4.
"""

from collections.abc import Iterator

import numpy as np

from toolkit.audit.fault import Evidence, Fault, Symptom
from toolkit.geometry import Array
from toolkit.measured_motion import ImuNoise, ImuSamples
from toolkit.models.noise import white_sigma
from toolkit.resampling import NS_PER_S

# Limit of the stated white noise over that of the samples. It is often stated several times too large on purpose, for
# vibration and errors of scale. Sound recordings at hand have 8 at most (accelerometer, 5 s of MH_01), with the factor
# that this toolkit puts on EuRoC's noise; chosen with them in view.
MOST_WHITE = 40.0
# Limit of the stated random walk over the change of the samples, to which motion adds far more than the walk. A true
# walk exceeds it less than once in ten thousand, by the chi-square of twelve changes (three axes, four quarters of a
# recording).
MOST_WALK = 3.0
LEAST_SAMPLES = 100
_SENSORS = {"accel": (slice(0, 3), "m/s^2"), "gyro": (slice(3, 6), "rad/s")}


def check(evidence: Evidence) -> Symptom | None:
    """Compare the scatter of an IMU's samples, and their change over time, with those of the stated noise."""
    motion, noise = evidence.sequence.motion, evidence.sequence.noise
    if not (isinstance(motion, ImuSamples) and isinstance(noise, ImuNoise)):
        return None
    finite = np.isfinite(motion.values).all(axis=1)
    t_ns, values = motion.t_ns[finite], motion.values[finite]
    if t_ns.size < LEAST_SAMPLES or (np.diff(t_ns) <= 0).any():
        return None
    findings = list(_refuted(t_ns / NS_PER_S - t_ns[0] / NS_PER_S, values, noise))
    if not findings:
        return None
    return Symptom.warning(
        count=len(findings),
        detail="; ".join(findings),
        treatment=(
            "estimators given this noise hardly use the IMU: check it (imu0/sensor.yaml, imu.yaml); it is a "
            "density, the standard deviation at one sample a second"
        ),
    )


def _refuted(t_s: Array, values: Array, noise: ImuNoise) -> Iterator[str]:
    """Yield a description of each stated density that samples (S, 6) at times (S,) contradict, with both figures."""
    step_s = float(np.median(np.diff(t_s)))
    lag_s = 0.25 * float(t_s[-1] - t_s[0])
    for name, (columns, unit) in _SENSORS.items():
        stated = getattr(noise, f"{name}_noise_density") / np.sqrt(step_s)
        found = float(white_sigma(values[:, columns]).max())
        error = found / np.sqrt(len(values))
        if stated > MOST_WHITE * found and found > 0.0:
            yield (
                f"by {name}_noise_density samples scatter by {stated:.3g} {unit}, and measured are {found:.2g} "
                f"+- {error:.1g}"
            )
        stated = getattr(noise, f"{name}_random_walk") * np.sqrt(lag_s)
        found = _moved(t_s, values[:, columns], lag_s)
        if stated > MOST_WALK * found > 0.0:
            yield (
                f"by {name}_random_walk they drift by {stated:.3g} {unit} in {lag_s:.3g} s, and measured are "
                f"{found:.3g}"
            )


def _moved(t_s: Array, values: Array, lag_s: float) -> float:
    """Return the change of samples (S, 3) within a time, motion included: the root mean square over all axes."""
    begin = np.flatnonzero(t_s <= t_s[-1] - lag_s)
    end = np.minimum(np.searchsorted(t_s, t_s[begin] + lag_s), t_s.size - 1)
    return float(np.sqrt(np.mean((values[end] - values[begin]) ** 2)))


FAULT = Fault(
    "overstated-noise",
    "an IMU whose stated noise is far larger than that of its samples",
    check,
    after=("units", "saturated-samples", "stuck-samples"),
)
