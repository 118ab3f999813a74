"""Motion samples that come in steps: of a converter of few bits, or of a log of few digits.

Rounding to steps of s adds errors of s / sqrt(12) to each sample (Bennett, "Spectra of quantized signals", 1948); where
a vehicle goes evenly they are the same for seconds, which no white noise is. Values that come in steps repeat, and no
two of them are closer than one; of a sensor with noise nearly all are different.
"""

from typing import NamedTuple

import numpy as np

from toolkit.audit.fault import Evidence, Fault, Symptom
from toolkit.geometry import Array
from toolkit.measured_motion import ImuNoise, MotionNoise, TwistNoise
from toolkit.resampling import NS_PER_S

# Of fewer samples, or of fewer different values, nothing is said.
LEAST_SAMPLES, LEAST_VALUES = 100, 5
# Rounding counts from this share of the stated standard deviation of a sample on, as that of pixels does.
MOST_SHARE = 0.5
_SENSORS = {
    "twist": (("velocities", "m/s"), ("rates of rotation", "rad/s")),
    "imu": (("accelerometer", "m/s^2"), ("gyro", "rad/s")),
}


class _Coarse(NamedTuple):
    """The largest step of a sensor's axes beside the noise stated of one, in its unit."""

    step: float
    stated: float

    @property
    def rounding(self) -> float:
        return self.step / float(np.sqrt(12.0))


def check(evidence: Evidence) -> Symptom | None:
    """Tell the steps of the samples whose rounding is no little part of the stated noise."""
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
                f"{worst.stated:.2g} {unit} that are stated of a sample"
            )
    if not found:
        return None
    return Symptom.warning(
        count=len(found),
        detail="; ".join(found),
        treatment="write all the digits that the sensor has, or state noise that holds the rounding",
    )


def _stated(noise: MotionNoise) -> Array:
    """Return the stated densities (6,) of linear and angular samples."""
    if isinstance(noise, TwistNoise):
        return np.concatenate([noise.velocity_noise_density, noise.gyro_noise_density])
    assert isinstance(noise, ImuNoise)
    return np.repeat([noise.accel_noise_density, noise.gyro_noise_density], 3)


def _step(column: Array) -> float:
    """Return the least distance of two values (S,) that differ, 0 where these are few or most are different."""
    distinct = np.unique(column[np.isfinite(column)])
    if not LEAST_VALUES <= distinct.size < column.size // 2:
        return 0.0
    return float(np.diff(distinct).min())


FAULT = Fault(
    "coarse-samples",
    "motion samples that come in steps, whose rounding is no little part of the stated noise",
    check,
    after=("units", "stuck-samples", "implausible", "saturated-samples"),
)
