"""Ratios of one motion by two sources, the units that they show, and samples converted to SI."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from toolkit.audit.parts.intervals import Intervals
from toolkit.audit.parts.robust import Scalar, median_error
from toolkit.geometry import Array, IntArray
from toolkit.measured_motion import ImuSamples, TwistNoise, TwistSamples
from toolkit.models.noise import white_sigma
from toolkit.resampling import NS_PER_S
from toolkit.sequence import Sequence

# Noise that is this share of the samples' own scatter, or more, was estimated from them and is in their unit.
FROM_SCATTER = 0.5


def in_other_unit(ratio: Scalar, factors: Mapping[str, float], within_factor: float, sigmas: float) -> str | None:
    """Return the only unit whose factor a ratio matches; None where none does, several do, or the ratio may be 1."""
    if not ratio.value > 0.0 or abs(ratio.value - 1.0) < sigmas * ratio.error:
        return None
    apart = {unit: abs(np.log(ratio.value / factor)) for unit, factor in factors.items()}
    near = [unit for unit in apart if apart[unit] < np.log(within_factor)]
    return near[0] if len(near) == 1 else None


def rotation_ratio(intervals: Intervals) -> Scalar:
    """Return the ratio of the samples' rates of rotation to the camera's, in whatever axes, and its standard error.

    The scale of the similarity between the rates about their medians (Umeyama 1991, eqs. 39-42); the noise of the
    samples does not shift it.
    """
    measured, seen = (w - np.median(w, axis=0) for w in (intervals.w_radps, intervals.w_cam_radps))
    left, singular, right = np.linalg.svd(measured.T @ seen)
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(left @ right))])
    total = float(np.sum(seen**2))
    if not total > 0.0:
        return Scalar(1.0, np.inf)
    turned, scale = seen @ (left * signs @ right).T, float(singular @ signs) / total
    moment = np.sum(turned * (measured - scale * turned), axis=1)
    return Scalar(scale, float(np.sqrt(np.sum(moment**2))) / total)


def speed_ratio(intervals: Intervals | None) -> Scalar | None:
    """Return the ratio of the samples' speeds to the camera's; None where the samples have none."""
    if intervals is None or intervals.v_mps is None:
        return None
    return ratio_of_speeds(intervals.v_mps, intervals.v_cam_mps)


def ratio_of_speeds(one: Array, other: Array) -> Scalar | None:
    """Return the median ratio of the norms of (M, 3) and (M, 3), over the faster half, where noise counts least."""
    speed = np.linalg.norm(other, axis=1)
    fast = (speed > 0.0) & (speed >= np.median(speed)) if speed.size else np.zeros(0, dtype=bool)
    if fast.sum() < 2:
        return None
    ratio = (np.linalg.norm(one[fast], axis=1) / speed[fast])[:, None]
    return Scalar(float(np.median(ratio)), float(median_error(ratio)[0]))


def force_ratio(sequence: Sequence) -> Scalar | None:
    """Return the ratio of specific forces to gravity, about which the median of their norms lies; None for twists."""
    if not isinstance(sequence.motion, ImuSamples) or not sequence.motion.t_ns.size:
        return None
    ratio = np.linalg.norm(sequence.motion.accel_mps2, axis=1)[:, None] / np.linalg.norm(sequence.gravity_world)
    return Scalar(float(np.median(ratio)), float(median_error(ratio)[0]))


def linear_scaled(sequence: Sequence, linear: float, angular: float = 1.0) -> Sequence:
    """Return the sequence with its motion samples multiplied, linear and angular ones.

    Noise that the file did not state, but a loader estimated from the scatter of the samples, is in their unit and
    is scaled as well.
    """
    motion, noise = sequence.motion, sequence.noise
    scaled = motion.of(motion.t_ns, motion.values * np.repeat([linear, angular], 3))
    if not (isinstance(motion, TwistSamples) and isinstance(noise, TwistNoise)):
        return replace(sequence, motion=scaled)
    velocity, gyro_noise = noise.velocity_noise_density, noise.gyro_noise_density
    if linear != 1.0 and is_from_scatter(velocity, motion.v_mps, motion.t_ns):
        velocity = linear * velocity
    if angular != 1.0 and is_from_scatter(gyro_noise, motion.w_radps, motion.t_ns):
        gyro_noise = angular * gyro_noise
    return replace(
        sequence,
        motion=scaled,
        noise=replace(noise, velocity_noise_density=velocity, gyro_noise_density=gyro_noise),
    )


def is_from_scatter(density: Array, values: Array, t_ns: IntArray) -> bool:
    """Say whether a density (3,) of white noise is what a loader makes of the scatter of the samples (S, 3)."""
    root_dt = np.sqrt(np.median(np.diff(t_ns)) / NS_PER_S)
    return bool((density > FROM_SCATTER * white_sigma(values) * root_dt).all())
