"""Faults of the motion samples: gaps, stuck, saturated or coarse values, wrong units, biases, noise, a standstill."""

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from toolkit.errors import DataError
from toolkit.geometry import Array, BoolArray, IntArray
from toolkit.measurements import NS_PER_S, TwistNoise
from toolkit.motion_samples import TwistSamples
from toolkit.sequence import Observations, Sequence, Truth
from toolkit.simulation.faults.parts import ns, span_s, with_pixels


def motion_gap(sequence: Sequence, dose: float = 0.5, seed: int = 0) -> Sequence:
    """Lose the motion samples of a span whose length is the dose (s): a full buffer, a loose cable."""
    begin_s, end_s = span_s(sequence, dose, seed)
    t_s = sequence.elapsed_s(sequence.motion.t_ns)
    return _with_samples(sequence, (t_s <= begin_s) | (t_s >= end_s))


def stuck_motion(sequence: Sequence, dose: float = 0.5, seed: int = 0) -> Sequence:
    """Repeat the last motion sample for the dose (s): a driver that hangs."""
    begin_s, end_s = span_s(sequence, dose, seed)
    t_s, values = sequence.elapsed_s(sequence.motion.t_ns), sequence.motion.values.copy()
    stuck = (t_s > begin_s) & (t_s < end_s)
    values[stuck] = values[max(int(np.argmax(stuck)) - 1, 0)]
    return _with_values(sequence, values)


def saturated_motion(sequence: Sequence, dose: float = 0.5, seed: int = 0) -> Sequence:
    """Clip the motion samples at this share of the largest on each axis: a sensor whose range is too small."""
    values = sequence.motion.values
    largest = dose * np.abs(values).max(axis=0, initial=0.0)
    return _with_values(sequence, np.clip(values, -largest, largest))


def spike(sequence: Sequence, dose: float = 1e300, seed: int = 0) -> Sequence:
    """Set one motion sample to the dose on one axis: a flipped bit, a failed parse."""
    rng, values = np.random.default_rng(seed), sequence.motion.values.copy()
    values[rng.integers(len(values) // 4, 3 * len(values) // 4), rng.integers(6)] = dose
    return _with_values(sequence, values)


def disturbed_motion(sequence: Sequence, dose: float = 1.0, seed: int = 0) -> Sequence:
    """Add the dose (m/s, or m/s^2) along a random axis to a third of the motion samples: slipping wheels, vibration."""
    begin_s, end_s = span_s(sequence, sequence.duration_s / 3.0, seed)
    axis, t_s = np.random.default_rng(seed).standard_normal(3), sequence.elapsed_s(sequence.motion.t_ns)
    added = np.concatenate([dose * axis / np.linalg.norm(axis), np.zeros(3)])
    return _with_values(sequence, sequence.motion.values + ((t_s >= begin_s) & (t_s < end_s))[:, None] * added)


def nan_span(sequence: Sequence, dose: float = 0.25, seed: int = 0) -> Sequence:
    """Write NaN to all motion samples and sightings of a span of the dose (s): a driver that fails and recovers."""
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
    """Keep one motion sample in as many as the dose: a log that was thinned out, a bus that is busy."""
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
    """Add a constant of the dose (rad/s) in a random direction to every angular velocity: a warm gyro."""
    axis = np.random.default_rng(seed).standard_normal(3)
    bias = np.concatenate([np.zeros(3), dose * axis / np.linalg.norm(axis)])
    return _with_values(sequence, sequence.motion.values + bias)


def wrong_noise(sequence: Sequence, dose: float = 2.0, seed: int = 0) -> Sequence:
    """State the dose times the noise of tracks and motion, whose errors stay: a data sheet of another sensor."""
    rig = replace(sequence.rig, cov_uv_px2=sequence.rig.cov_uv_px2 * dose**2)
    return replace(sequence, rig=rig, noise=sequence.noise.scaled(dose))


def _with_values(sequence: Sequence, values: Array) -> Sequence:
    """Return the sequence with other values (S, 6) of its motion samples."""
    return replace(sequence, motion=sequence.motion.of(sequence.motion.t_ns, values))


def _with_samples(sequence: Sequence, kept: BoolArray) -> Sequence:
    arrays: dict[str, Any] = {k: x[kept] for k, x in vars(sequence.motion).items() if isinstance(x, np.ndarray)}
    return replace(sequence, motion=replace(sequence.motion, **arrays))


def standstill(sequence: Sequence, dose: float = 10.0, seed: int = 0) -> Sequence:
    """Stop at a frame for the dose (s) and continue from there: a red light. For twists, whose motion may just stop.

    The tracks of that frame are seen again in every one, with the noise of the rig. Raises DataError where the motion
    is an IMU's: braking would need accelerations nobody measured; simulate a scene that halts.
    """
    motion, noise = sequence.motion, sequence.noise
    if not (isinstance(motion, TwistSamples) and isinstance(noise, TwistNoise)):
        raise DataError(
            f"{sequence.name}: a standstill can be planted between twists only; simulate a scene that halts"
        )
    rng, period_ns = np.random.default_rng(seed), int(np.median(np.diff(sequence.frames_t_ns)))
    halt = int(np.searchsorted(sequence.frames_s, span_s(sequence, 0.0, seed)[0]))
    pause = _Pause(sequence.frames_t_ns[halt], period_ns, round(ns(dose) / period_ns))
    t_ns, rows = pause.inserted(motion.t_ns)
    density = np.concatenate([noise.velocity_noise_density, noise.gyro_noise_density])
    still = rng.standard_normal((t_ns.size, 6)) * density / np.sqrt(period_ns / NS_PER_S)
    values = np.where(pause.within(t_ns)[:, None], still, motion.values[rows])
    return replace(
        sequence,
        frames_t_ns=pause.inserted(sequence.frames_t_ns)[0],
        observations=_seen_standing(sequence, halt, pause.stamps, rng),
        motion=replace(motion, t_ns=t_ns, v_mps=values[:, :3], w_radps=values[:, 3:]),
        truth=None if sequence.truth is None else _truth_standing(sequence.truth, pause),
    )


class _Pause(NamedTuple):
    """Stamps, a period apart, inserted before the stamp ``at_ns``; later stamps are delayed by the whole pause."""

    at_ns: int
    period_ns: int
    stamps: int

    def inserted(self, t_ns: IntArray) -> tuple[IntArray, IntArray]:
        """Return the stamps (N + stamps,) and the row of ``t_ns`` (N,) that each one repeats."""
        at = int(np.searchsorted(t_ns, self.at_ns))
        rows = np.concatenate([np.arange(at), np.full(self.stamps, min(at, t_ns.size - 1)), np.arange(at, t_ns.size)])
        extra_ns = self.at_ns + self.period_ns * np.arange(self.stamps)
        return np.concatenate([t_ns[:at], extra_ns, t_ns[at:] + self.stamps * self.period_ns]), rows

    def within(self, t_ns: IntArray) -> BoolArray:
        """Say which stamps (N,) are in the pause."""
        return np.asarray((t_ns >= self.at_ns) & (t_ns < self.at_ns + self.stamps * self.period_ns))


def _seen_standing(sequence: Sequence, halt: int, count: int, rng: np.random.Generator) -> Observations:
    seen = sequence.observations
    here = np.flatnonzero(seen.frame == halt)
    standing = seen.select(np.tile(here, count))
    noise_px = rng.standard_normal((len(standing), 3)) @ np.linalg.cholesky(sequence.rig.cov_uv_px2).T
    return Observations.sorted(
        np.concatenate([seen.frame + count * (seen.frame >= halt), np.repeat(halt + np.arange(count), here.size)]),
        np.concatenate([seen.track_id, standing.track_id]),
        np.concatenate([seen.uv_px, standing.uv_px + noise_px]),
    )


def _truth_standing(truth: Truth, pause: _Pause) -> Truth:
    t_ns, rows = pause.inserted(truth.t_ns)
    moves = ~pause.within(t_ns)[:, None]
    return replace(
        truth,
        t_ns=t_ns,
        T_world_imu=truth.T_world_imu[rows],
        v_world=None if truth.v_world is None else truth.v_world[rows] * moves,
        bias=None if truth.bias is None else truth.bias[rows],
    )
