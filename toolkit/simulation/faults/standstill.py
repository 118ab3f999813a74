"""A pause put into a recording: the vehicle stands, and everything goes on later."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from toolkit.errors import DataError
from toolkit.geometry import BoolArray, IntArray
from toolkit.measured_motion import TwistNoise, TwistSamples
from toolkit.resampling import NS_PER_S
from toolkit.sequence import Observations, Sequence, Truth
from toolkit.simulation.faults.parts import ns, span_s


def standstill(sequence: Sequence, dose: float = 10.0, seed: int = 0) -> Sequence:
    """Stop for so many seconds at a frame and go on from there: a red light. For twists, whose motion may just stop.

    The tracks of that frame are seen again in every one, with the noise of the rig. Raises DataError where the
    motion is an IMU's: braking would need accelerations nobody measured; simulate a scene that halts.
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
    """So many stamps, a period apart, put in before the stamp ``at_ns``; what follows is as much later."""

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
        """Say which stamps (N,) are of the pause."""
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
