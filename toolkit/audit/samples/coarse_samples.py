"""Motion samples that come in steps, because a converter has few bits or a log few digits.

Rounding to steps of s adds errors of s / sqrt(12) to each sample (Bennett, "Spectra of quantized signals", 1948). While
a vehicle moves uniformly they stay the same for seconds, so they are not white noise. Rounded values repeat, and
different ones are at least a step apart; without rounding, noise makes nearly all values different.
"""

from typing import NamedTuple

import numpy as np

from toolkit.audit.fault import Evidence, Fault, Symptom
from toolkit.geometry import Array
from toolkit.measured_motion import ImuNoise, MotionNoise, TwistNoise
from toolkit.resampling import NS_PER_S

# Fewer samples, or fewer different values, are not judged.
LEAST_SAMPLES, LEAST_VALUES = 100, 5
# Rounding is reported from this share of the stated standard deviation of a sample on, as for pixels.
MOST_SHARE = 0.5
_SENSORS = {
    "twist": (("velocities", "m/s"), ("rates of rotation", "rad/s")),
    "imu": (("accelerometer", "m/s^2"), ("gyro", "rad/s")),
}


class _Coarse(NamedTuple):
    """The step of a sensor's axis, and the stated standard deviation of a sample, in its unit."""

    step: float
    stated: float

    @property
    def rounding(self) -> float:
        return self.step / float(np.sqrt(12.0))


def check(evidence: Evidence) -> Symptom | None:
    """Report the steps of the samples where the rounding is more than MOST_SHARE of the stated noise."""
    sequence = evidence.sequence
    if sequence.motion_kind == "none" or sequence.motion.t_ns.size < LEAST_SAMPLES:
        return None
    step_s = float(np.median(np.diff(sequence.motion.t_ns))) / NS_PER_S
    if not step_s > 0.0:
        return None
    values, stated = sequence.motion.values, _stated(sequence.noise) / np.sqrt(step_s)
    found = list[str]()
    for columns, (name, unit) in zip((slice(0, 3), slice(3, 6)), _SENSORS[sequence.motion_kind], strict=True):
        axes = [_Coarse(*one) for one in zip(map(_step, values[:, columns].T), stated[columns].tolist(), strict=True)]
        worst = max(axes, key=lambda one: one.rounding / one.stated)
        if worst.rounding > MOST_SHARE * worst.stated:
            found.append(
                f"{name} come in steps of {worst.step:.3g} {unit}, which adds errors of {worst.rounding:.2g} to the "
                f"{worst.stated:.2g} {unit} stated for a sample"
            )
    if not found:
        return None
    return Symptom.warning(
        count=len(found),
        detail="; ".join(found),
        treatment="write all the digits that the sensor has, or state noise that includes the rounding",
    )


def _stated(noise: MotionNoise) -> Array:
    """Return the stated densities (6,) of linear and angular samples."""
    if isinstance(noise, TwistNoise):
        return np.concatenate([noise.velocity_noise_density, noise.gyro_noise_density])
    assert isinstance(noise, ImuNoise)
    return np.repeat([noise.accel_noise_density, noise.gyro_noise_density], 3)


def _step(column: Array) -> float:
    """Return the least distance of two different values (S,); 0 where few or most of the values are different."""
    distinct = np.unique(column[np.isfinite(column)])
    if not LEAST_VALUES <= distinct.size < column.size // 2:
        return 0.0
    return float(np.diff(distinct).min())


FAULT = Fault(
    "coarse-samples",
    "quantised motion samples, whose rounding is a considerable part of the stated noise",
    check,
    after=("units", "stuck-samples", "implausible", "saturated-samples"),
)
