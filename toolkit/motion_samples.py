"""The motion samples of a recording, and how they are cut at the frame times, once for all estimators."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import ClassVar, Literal, Self

import numpy as np

from toolkit.arrays import freeze_arrays
from toolkit.geometry import Array, IntArray, read_only
from toolkit.measurements import (
    NS_PER_S,
    ImuMotion,
    ImuNoise,
    Motion,
    MotionKind,
    MotionNoise,
    TwistChangeNoise,
    TwistMotion,
    TwistNoise,
    UnmeasuredMotion,
)

# Which sample describes the motion between two stamps: the one at its start, the one at its end, or their mean.
Pairing = Literal["start", "end", "mean"]
# How IMU samples describe the motion: the mean of two neighbours from stamp to stamp, or each sample for the time
# around it, half-way to its neighbours.
ImuPairing = Literal["mean", "middle"]


@dataclass(frozen=True, eq=False)
class _TwoVectors:
    """Samples of two vectors (S, 3) each, the fields that ``VECTORS`` names, at stamps (S,)."""

    VECTORS: ClassVar[tuple[str, str]]
    t_ns: IntArray

    def __post_init__(self) -> None:
        freeze_arrays(self, t_ns=(None,), **dict.fromkeys(self.VECTORS, (None, 3)))

    @property
    def values(self) -> Array:
        """Return the samples side by side (S, 6), linear and angular."""
        return np.hstack([getattr(self, name) for name in self.VECTORS])

    def of(self, t_ns: IntArray, values: Array) -> Self:
        """Return samples of the same kind with other stamps (S,) and values (S, 6)."""
        vectors = zip(self.VECTORS, (values[:, :3], values[:, 3:]), strict=True)
        return replace(self, t_ns=t_ns, **dict(vectors))


@dataclass(frozen=True, eq=False)
class TwistSamples(_TwoVectors):
    """Measured body twists: stamps (S,), linear velocity (S, 3) m/s, angular velocity (S, 3) rad/s, IMU frame.

    ``pairing`` says which sample describes the motion between two stamps: the one at its start, the one at
    its end, or the mean of both.
    """

    VECTORS = ("v_mps", "w_radps")
    v_mps: Array
    w_radps: Array
    pairing: Pairing = "start"


@dataclass(frozen=True, eq=False)
class ImuSamples(_TwoVectors):
    """Raw IMU samples: stamps (S,), specific force (S, 3) m/s^2, angular velocity (S, 3) rad/s, IMU frame.

    ``pairing`` says how samples describe the motion: the mean of two neighbours from one stamp to the next, or each
    sample for the time around its stamp (see :func:`cut_at`).
    """

    VECTORS = ("accel_mps2", "gyro_radps")
    accel_mps2: Array
    gyro_radps: Array
    pairing: ImuPairing = "mean"


@dataclass(frozen=True, eq=False)
class NoSamples:
    """No motion was measured: only the stamps (S,) of the frames, which it spans."""

    t_ns: IntArray

    def __post_init__(self) -> None:
        freeze_arrays(self, t_ns=(None,))

    @property
    def values(self) -> Array:
        """Return rows (S, 0) without a value."""
        return np.empty((self.t_ns.size, 0))

    def of(self, t_ns: IntArray, values: Array) -> Self:
        """Return the same kind with other stamps (S,); ``values`` is (S, 0)."""
        return replace(self, t_ns=t_ns)


MotionSamples = TwistSamples | ImuSamples | NoSamples
_KINDS: tuple[tuple[type[MotionSamples], type[MotionNoise], MotionKind], ...] = (
    (TwistSamples, TwistNoise, "twist"),
    (ImuSamples, ImuNoise, "imu"),
    (NoSamples, TwistChangeNoise, "none"),
)


def kind_of(samples: MotionSamples) -> MotionKind:
    return next(kind for one, _, kind in _KINDS if isinstance(samples, one))


def are_of_one_kind(samples: MotionSamples, noise: MotionNoise) -> bool:
    return any(isinstance(samples, one) and isinstance(noise, other) for one, other, _ in _KINDS)


@dataclass(frozen=True, eq=False)
class Bridges:
    """Spans (B,) without measured motion, in which samples were interpolated; these are noisier than the others.

    ``noise_scale`` (B, 2) multiplies the standard deviation of the white noise there, of linear and angular samples.
    """

    begin_t_ns: IntArray
    end_t_ns: IntArray
    noise_scale: Array

    def __post_init__(self) -> None:
        freeze_arrays(self, begin_t_ns=(None,), end_t_ns=(None,), noise_scale=(None, 2))

    def scale_over(self, begin_ns: int, dt_s: Array) -> Array | None:
        """Return the factors (n, 2) over successive pieces (n,) from a stamp on, or None where all was measured."""
        middle_t_ns = begin_ns + np.rint((np.cumsum(dt_s) - 0.5 * dt_s) * NS_PER_S).astype(np.int64)
        inside = (middle_t_ns[:, None] > self.begin_t_ns) & (middle_t_ns[:, None] < self.end_t_ns)  # (n, B)
        if not inside.any():
            return None
        scale: Array = read_only(np.where(inside[:, :, None], self.noise_scale, 1.0).max(axis=1))
        return scale


@dataclass(frozen=True, eq=False)
class GapTwists:
    """Twists of G intervals between frames, with stamps (G,) of both, that hold in the place of the samples there.

    ``v_mps`` (G, 3) and ``w_radps`` (G, 3) in the IMU frame; ``noise_scale`` (G, 2) multiplies the standard deviation
    of the stated white noise of velocity and turn rate.
    """

    begin_t_ns: IntArray
    end_t_ns: IntArray
    v_mps: Array
    w_radps: Array
    noise_scale: Array

    def __post_init__(self) -> None:
        freeze_arrays(
            self, begin_t_ns=(None,), end_t_ns=(None,), v_mps=(None, 3), w_radps=(None, 3), noise_scale=(None, 2)
        )

    def over(self, begin_ns: int, end_ns: int) -> TwistMotion | None:
        """Return the motion of an interval between two stamps, or None where the samples hold."""
        rows = np.flatnonzero((self.begin_t_ns == begin_ns) & (self.end_t_ns == end_ns))
        if not rows.size:
            return None
        dt_s = read_only([(end_ns - begin_ns) / NS_PER_S])
        return TwistMotion(dt_s, self.v_mps[rows], self.w_radps[rows], self.noise_scale[rows])


def motions_between(
    samples: MotionSamples, frames_t_ns: IntArray, bridges: Bridges | None, gaps: GapTwists | None = None
) -> Iterator[Motion]:
    """Yield the motion of each interval between frames (K,) ns, cut and interpolated at the frame times.

    Where ``gaps`` have a twist for an interval, it holds in the place of the samples.
    """
    if isinstance(samples, NoSamples):
        for dt_s in np.diff(frames_t_ns) / NS_PER_S:
            yield UnmeasuredMotion(read_only([dt_s]))
        return
    twist = isinstance(samples, TwistSamples)
    pieces = cut_at(frames_t_ns, samples.t_ns, samples.values, samples.pairing)
    ends = frames_t_ns.tolist()
    for begin_ns, end_ns, (dt_s, rows) in zip(ends[:-1], ends[1:], pieces, strict=True):
        improved = None if gaps is None else gaps.over(begin_ns, end_ns)
        if improved is not None:
            yield improved
            continue
        scale = None if bridges is None else bridges.scale_over(begin_ns, dt_s)
        part = (read_only(dt_s), read_only(rows[:, :3]), read_only(rows[:, 3:]), scale)
        yield TwistMotion(*part) if twist else ImuMotion(*part)


def cut_at(
    frames_t_ns: IntArray, t_ns: IntArray, values: Array, pairing: Pairing | ImuPairing
) -> Iterator[tuple[Array, Array]]:
    """Yield, for each interval between frames (K,), durations (n,) s and the values (n, d) that hold over them.

    The samples, stamps (S,) and values (S, d), must span the frames. An interval is divided at the samples
    inside it, with ``middle`` half-way between them; at the frames themselves ``mean`` interpolates linearly.

    The noise of the values equals that of the samples only where no sample contributes to two intervals. With the mean
    of neighbours, an interval of n samples has ``(n - 1/2) / n`` of the variance and a covariance of ``1 / 4 n`` with
    each neighbouring interval, which adds up to the whole variance over many intervals. With ``middle``, no sample is
    shared where the frames are half-way between samples.
    """
    ends = _half_way(t_ns) if pairing == "middle" else t_ns
    inside = ends[(ends > frames_t_ns[0]) & (ends < frames_t_ns[-1])]
    knots = np.union1d(inside, frames_t_ns)
    dt_s = np.diff(knots) / NS_PER_S
    rows = _paired(t_ns, values, knots, pairing)
    for begin, end in pairwise(np.searchsorted(knots, frames_t_ns)):
        yield dt_s[begin:end], rows[begin:end]


def _half_way(t_ns: IntArray) -> IntArray:
    return np.asarray(t_ns[:-1] + np.diff(t_ns) // 2)


def _paired(t_ns: IntArray, values: Array, knots: IntArray, pairing: Pairing | ImuPairing) -> Array:
    """Return the value (n, d) that describes each of the n intervals between knots."""
    if pairing == "middle":
        return values[np.searchsorted(_half_way(t_ns), knots[:-1], side="right")]
    if pairing == "start":
        return values[np.searchsorted(t_ns, knots[:-1], side="right") - 1]
    if pairing == "end":
        return values[np.searchsorted(t_ns, knots[1:], side="left")]
    relative_s, knots_s = (t_ns - knots[0]) / NS_PER_S, (knots - knots[0]) / NS_PER_S
    at_knots: Array = np.stack([np.interp(knots_s, relative_s, column) for column in values.T], axis=1)
    return 0.5 * (at_knots[:-1] + at_knots[1:])
