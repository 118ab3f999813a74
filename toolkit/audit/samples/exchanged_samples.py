"""Velocities and rates of rotation in each other's columns; with an IMU, specific forces and rates.

In SI units the speed of a vehicle exceeds its rate of rotation by far, and specific force is gravity on average. Where
the sizes of the samples contradict the camera's motion and gravity by far, and agree once the columns are exchanged,
the columns were exchanged.
"""

from dataclasses import replace

import numpy as np

from toolkit.audit.fault import Evidence, Fault, Symptom
from toolkit.audit.parts.ratios import force_ratio, is_from_scatter, rotation_ratio, speed_ratio
from toolkit.measured_motion import TwistNoise, TwistSamples
from toolkit.sequence import Sequence

# As given a size is wrong by more than the first factor; exchanged, both are right within the second, as in sound
# recordings.
LEAST_FACTOR, MOST_FACTOR = 3.0, 1.25
_OTHER_WAY = [3, 4, 5, 0, 1, 2]


def check(evidence: Evidence) -> Symptom | None:
    """Exchange linear and angular columns where this alone makes both agree with camera and gravity."""
    sequence = evidence.sequence
    if evidence.intervals is None or not _is_off(evidence):
        return None
    exchanged = _exchanged(sequence)
    if not _fits(evidence.after(exchanged)):
        return None
    names = ("velocities", "rates of rotation")
    if sequence.motion_kind == "imu":
        names = ("accelerations", "rates of rotation")
    return Symptom(
        count=len(sequence.motion.values),
        detail=f"{names[0]} and {names[1]} are exchanged: {_sizes(sequence)}, which are plausible the other way round",
        treatment="exchanged back",
        remedy=exchanged,
    )


def _exchanged(sequence: Sequence) -> Sequence:
    """Return the sequence with linear and angular columns exchanged, and the noise if it was estimated from them."""
    motion, noise = sequence.motion, sequence.noise
    exchanged = replace(sequence, motion=motion.of(motion.t_ns, motion.values[:, _OTHER_WAY]))
    if not (isinstance(motion, TwistSamples) and isinstance(noise, TwistNoise)):
        return exchanged
    velocity, gyro = noise.velocity_noise_density, noise.gyro_noise_density
    if not (
        is_from_scatter(velocity, motion.v_mps, motion.t_ns) and is_from_scatter(gyro, motion.w_radps, motion.t_ns)
    ):
        return exchanged
    return replace(exchanged, noise=replace(noise, velocity_noise_density=gyro, gyro_noise_density=velocity))


def _is_off(evidence: Evidence) -> bool:
    speed, force = speed_ratio(evidence.intervals), force_ratio(evidence.sequence)
    ratio = speed if force is None else force
    return ratio is not None and not 1.0 / LEAST_FACTOR < ratio.value < LEAST_FACTOR


def _fits(evidence: Evidence) -> bool:
    if evidence.intervals is None:
        return False
    sizes = (speed_ratio(evidence.intervals), force_ratio(evidence.sequence))
    fit = all(1.0 / MOST_FACTOR < size.value < MOST_FACTOR for size in sizes if size is not None)
    return fit and rotation_ratio(evidence.intervals).value < MOST_FACTOR  # the camera's noise lowers this one


def _sizes(sequence: Sequence) -> str:
    """Return the median sizes of linear and angular columns as text."""
    first, second = (float(np.median(np.linalg.norm(half, axis=1))) for half in np.split(sequence.motion.values, 2, 1))
    unit = "m/s^2" if sequence.motion_kind == "imu" else "m/s"
    return f"{first:.2g} {unit} and {second:.2g} rad/s (medians)"


FAULT = Fault(
    "exchanged-samples",
    "velocities, or accelerations, exchanged with rates of rotation",
    check,
    after=("intrinsics", "swapped-coordinates", "no-disparity", "outside-motion"),
)
