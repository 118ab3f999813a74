"""Faults of the motion samples: holes, stuck, saturated, spoilt or coarse values, wrong units, biases and noise."""

from dataclasses import replace
from typing import Any

import numpy as np

from toolkit.geometry import Array, BoolArray
from toolkit.sequence import Sequence
from toolkit.simulation.faults.parts import span_s, with_pixels


def motion_gap(sequence: Sequence, dose: float = 0.5, seed: int = 0) -> Sequence:
    """Lose the motion samples of so many seconds: a full buffer, a loose cable."""
    begin_s, end_s = span_s(sequence, dose, seed)
    t_s = sequence.elapsed_s(sequence.motion.t_ns)
    return _with_samples(sequence, (t_s <= begin_s) | (t_s >= end_s))


def stuck_motion(sequence: Sequence, dose: float = 0.5, seed: int = 0) -> Sequence:
    """Repeat the last motion sample for so many seconds: a driver that hangs."""
    begin_s, end_s = span_s(sequence, dose, seed)
    t_s, values = sequence.elapsed_s(sequence.motion.t_ns), sequence.motion.values.copy()
    stuck = (t_s > begin_s) & (t_s < end_s)
    values[stuck] = values[max(int(np.argmax(stuck)) - 1, 0)]
    return _with_values(sequence, values)


def saturated_motion(sequence: Sequence, dose: float = 0.5, seed: int = 0) -> Sequence:
    """Cut the motion samples off at this share of the largest on each axis: a sensor of too small a range."""
    values = sequence.motion.values
    largest = dose * np.abs(values).max(axis=0, initial=0.0)
    return _with_values(sequence, np.clip(values, -largest, largest))


def spike(sequence: Sequence, dose: float = 1e300, seed: int = 0) -> Sequence:
    """Give one motion sample the value of the dose on one axis: a flipped bit, a failed parse."""
    rng, values = np.random.default_rng(seed), sequence.motion.values.copy()
    values[rng.integers(len(values) // 4, 3 * len(values) // 4), rng.integers(6)] = dose
    return _with_values(sequence, values)


def disturbed_motion(sequence: Sequence, dose: float = 1.0, seed: int = 0) -> Sequence:
    """Add so many m/s, or m/s^2, along an axis drawn to a third of the motion samples: wheels that slip, vibration."""
    begin_s, end_s = span_s(sequence, sequence.duration_s / 3.0, seed)
    axis, t_s = np.random.default_rng(seed).standard_normal(3), sequence.elapsed_s(sequence.motion.t_ns)
    added = np.concatenate([dose * axis / np.linalg.norm(axis), np.zeros(3)])
    return _with_values(sequence, sequence.motion.values + ((t_s >= begin_s) & (t_s < end_s))[:, None] * added)


def nan_span(sequence: Sequence, dose: float = 0.25, seed: int = 0) -> Sequence:
    """Write NaN for all motion samples and sightings of so many seconds: a driver that gives up and comes back."""
    begin_s, end_s = span_s(sequence, dose, seed)
    values, uv_px = sequence.motion.values.copy(), sequence.observations.uv_px.copy()
    t_s, seen_s = sequence.elapsed_s(sequence.motion.t_ns), sequence.frames_s[sequence.observations.frame]
    values[(t_s > begin_s) & (t_s < end_s)] = np.nan
    uv_px[(seen_s > begin_s) & (seen_s < end_s)] = np.nan
    return _with_values(with_pixels(sequence, uv_px), values)


def linear_unit(sequence: Sequence, dose: float = 3.6, seed: int = 0) -> Sequence:
    """Multiply velocities, or accelerations, by the dose: 3.6 for km/h, 100 for cm/s, 0.102 for g."""
    return _with_values(sequence, sequence.motion.values * np.repeat([dose, 1.0], 3))


def changed_speed(sequence: Sequence, dose: float = 1.08, seed: int = 0) -> Sequence:
    """Multiply the velocities, or accelerations, of the second half by the dose: a tyre that loses air."""
    later = sequence.motion.t_ns > sequence.frames_t_ns[sequence.frame_count // 2]
    factor = np.where(later[:, None], np.repeat([dose, 1.0], 3), 1.0)
    return _with_values(sequence, factor * sequence.motion.values)


def thinned_motion(sequence: Sequence, dose: float = 10.0, seed: int = 0) -> Sequence:
    """Keep every so many-th motion sample: a log that was thinned out, a bus that is busy."""
    return _with_samples(sequence, np.arange(sequence.motion.t_ns.size) % int(dose) == 0)


def angular_unit(sequence: Sequence, dose: float = 180.0 / np.pi, seed: int = 0) -> Sequence:
    """Multiply angular velocities by the dose: 57.3 for degrees."""
    return _with_values(sequence, sequence.motion.values * np.repeat([1.0, dose], 3))


def gyro_axis_scale(sequence: Sequence, dose: float = 0.9, seed: int = 0) -> Sequence:
    """Multiply the rates about the axis that turns most by the dose: a channel of another sensitivity."""
    scale = np.ones(6)
    scale[3 + int(np.argmax(np.std(sequence.motion.values[:, 3:], axis=0)))] = dose
    return _with_values(sequence, sequence.motion.values * scale)


def coarse_samples(sequence: Sequence, dose: float = 0.1, seed: int = 0) -> Sequence:
    """Round motion samples to multiples of the dose: a converter of few bits, a log of few digits."""
    return _with_values(sequence, dose * np.round(sequence.motion.values / dose))


def gyro_bias(sequence: Sequence, dose: float = 0.01, seed: int = 0) -> Sequence:
    """Add a constant of the dose (rad/s), in a direction drawn, to every angular velocity: a warm gyro."""
    axis = np.random.default_rng(seed).standard_normal(3)
    bias = np.concatenate([np.zeros(3), dose * axis / np.linalg.norm(axis)])
    return _with_values(sequence, sequence.motion.values + bias)


def wrong_noise(sequence: Sequence, dose: float = 2.0, seed: int = 0) -> Sequence:
    """State the dose times the noise of tracks and motion, which stay as they are: a data sheet of another sensor."""
    rig = replace(sequence.rig, cov_uv_px2=sequence.rig.cov_uv_px2 * dose**2)
    return replace(sequence, rig=rig, noise=sequence.noise.scaled(dose))


def _with_values(sequence: Sequence, values: Array) -> Sequence:
    """Return the sequence with other values (S, 6) of its motion samples."""
    return replace(sequence, motion=sequence.motion.of(sequence.motion.t_ns, values))


def _with_samples(sequence: Sequence, kept: BoolArray) -> Sequence:
    arrays: dict[str, Any] = {k: x[kept] for k, x in vars(sequence.motion).items() if isinstance(x, np.ndarray)}
    return replace(sequence, motion=replace(sequence.motion, **arrays))
