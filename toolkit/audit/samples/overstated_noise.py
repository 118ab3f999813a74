"""An IMU's stated noise that its own samples are far too quiet for: estimators then hardly use the sensor.

White noise of a density s makes samples, dt apart, scatter by s / sqrt(dt), and a walk of density w moves them by
w sqrt(T) within a time T; motion only adds to both. Samples that scatter or move by much less refute the stated noise.
Too little stated noise shows elsewhere, in residuals; too much makes nothing worse than it looks.
Source: Woodman, "An introduction to inertial navigation" (2007), section 4.
"""

from collections.abc import Iterator

import numpy as np

from toolkit.audit.fault import Evidence, Fault, Symptom
from toolkit.geometry import Array
from toolkit.measured_motion import ImuNoise, ImuSamples
from toolkit.models.noise import white_sigma
from toolkit.resampling import NS_PER_S

# White noise is often stated several times too large on purpose, for vibration and errors of scale. Sound recordings at
# hand have 12 times at most, of our own factor of 8 for EuRoC; chosen with them in view.
MOST_WHITE = 40.0
# Motion is many times what a walk is. Of a true walk, this is chance less than once in ten thousand: chi-square of the
# twelve changes that three axes have over quarters of a recording.
MOST_WALK = 3.0
LEAST_SAMPLES = 100
_SENSORS = {"accel": (slice(0, 3), "m/s^2"), "gyro": (slice(3, 6), "rad/s")}


def check(evidence: Evidence) -> Symptom | None:
    """Hold the scatter of an IMU's samples, and how far they move, against what the stated noise makes of them."""
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
            "estimators told so hardly use the IMU: check its noise (imu0/sensor.yaml, imu.yaml), which is a density "
            "for one sample a second"
        ),
    )


def _refuted(t_s: Array, values: Array, noise: ImuNoise) -> Iterator[str]:
    """Yield each stated density that samples (S, 6) at times (S,) refute: what it makes them do, and what they do."""
    step_s = float(np.median(np.diff(t_s)))
    lag_s = 0.25 * float(t_s[-1] - t_s[0])
    for name, (columns, unit) in _SENSORS.items():
        stated = getattr(noise, f"{name}_noise_density") / np.sqrt(step_s)
        found = float(white_sigma(values[:, columns]).max())
        error = found / np.sqrt(len(values))
        if stated > MOST_WHITE * found and found > 0.0:
            yield (
                f"{name}_noise_density makes samples scatter by {stated:.3g} {unit}, and they do by {found:.2g} "
                f"+- {error:.1g}"
            )
        stated = getattr(noise, f"{name}_random_walk") * np.sqrt(lag_s)
        found = _moved(t_s, values[:, columns], lag_s)
        if stated > MOST_WALK * found > 0.0:
            yield f"{name}_random_walk moves them by {stated:.3g} {unit} in {lag_s:.3g} s, and they move by {found:.3g}"


def _moved(t_s: Array, values: Array, lag_s: float) -> float:
    """Return how much samples (S, 3) change within a time, motion and all: root mean square of all axes."""
    begin = np.flatnonzero(t_s <= t_s[-1] - lag_s)
    end = np.minimum(np.searchsorted(t_s, t_s[begin] + lag_s), t_s.size - 1)
    return float(np.sqrt(np.mean((values[end] - values[begin]) ** 2)))


FAULT = Fault(
    "overstated-noise",
    "an IMU whose stated noise is far more than its samples have",
    check,
    after=("units", "saturated-samples", "stuck-samples"),
)
