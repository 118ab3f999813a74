"""The measured motion of the IMU: the samples of a recording, their noise, and the motion of one interval.

There are three kinds: measured body twists, the samples of an IMU, and no measurement of the motion.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import ClassVar, Literal, Self, get_args

import numpy as np

from toolkit.arrays import freeze_arrays
from toolkit.geometry import Array, IntArray, read_only
from toolkit.resampling import NS_PER_S, Bridges, ImuPairing, Pairing, cut_at


@dataclass(frozen=True, eq=False)
class TwistNoise:
    """Continuous white-noise densities of a measured body twist, per axis (3,), and of the gyro bias' walk.

    Units: m/s/sqrt(Hz), rad/s/sqrt(Hz), rad/s^2/sqrt(Hz).
    """

    velocity_noise_density: Array
    gyro_noise_density: Array
    gyro_random_walk: Array

    def __post_init__(self) -> None:
        freeze_arrays(self, velocity_noise_density=(3,), gyro_noise_density=(3,), gyro_random_walk=(3,))

    def scaled(self, factor: float) -> Self:
        """Return the noise with its white densities scaled; the random walk stays."""
        velocity, gyro = factor * self.velocity_noise_density, factor * self.gyro_noise_density
        return replace(self, velocity_noise_density=velocity, gyro_noise_density=gyro)


@dataclass(frozen=True)
class ImuNoise:
    """Continuous noise densities of an IMU, with Kalibr's names.

    Units: m/s^2/sqrt(Hz), rad/s/sqrt(Hz), m/s^3/sqrt(Hz), rad/s^2/sqrt(Hz).
    """

    accel_noise_density: float
    gyro_noise_density: float
    accel_random_walk: float
    gyro_random_walk: float

    def scaled(self, factor: float) -> Self:
        """Return the noise with its white densities scaled; the random walks stay."""
        accel, gyro = factor * self.accel_noise_density, factor * self.gyro_noise_density
        return replace(self, accel_noise_density=accel, gyro_noise_density=gyro)


@dataclass(frozen=True, eq=False)
class TwistChangeNoise:
    """Densities of the white noise on the change of an unmeasured twist, per axis (3,), in the IMU frame.

    Units: m/s^2/sqrt(Hz) of the velocity, rad/s^2/sqrt(Hz) of the turn rate.
    """

    velocity_change_density: Array
    turn_change_density: Array

    def __post_init__(self) -> None:
        freeze_arrays(self, velocity_change_density=(3,), turn_change_density=(3,))

    def scaled(self, factor: float) -> Self:
        """Return the noise with its densities scaled."""
        velocity, turn = factor * self.velocity_change_density, factor * self.turn_change_density
        return replace(self, velocity_change_density=velocity, turn_change_density=turn)


MotionNoise = TwistNoise | ImuNoise | TwistChangeNoise


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
    sample for the time around its stamp (see :func:`toolkit.resampling.cut_at`).
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


@dataclass(frozen=True, eq=False)
class TwistMotion:
    """The twists of one interval: durations (n,) s, linear (n, 3) m/s and angular velocity (n, 3) rad/s."""

    dt_s: Array
    v_mps: Array
    w_radps: Array
    noise_scale: Array | None = None


@dataclass(frozen=True, eq=False)
class ImuMotion:
    """The IMU of one interval: durations (n,) s, mid-interval accel (n, 3) m/s^2 and gyro (n, 3) rad/s."""

    dt_s: Array
    accel_mps2: Array
    gyro_radps: Array
    noise_scale: Array | None = None


@dataclass(frozen=True, eq=False)
class UnmeasuredMotion:
    """An interval in which no motion was measured: its duration (1,) s."""

    dt_s: Array


Motion = TwistMotion | ImuMotion | UnmeasuredMotion


def noise_scale_of(motion: TwistMotion | ImuMotion) -> Array:
    """Return the factors (n, 2) on the noise of a motion's linear and angular samples."""
    return np.ones((motion.dt_s.size, 2)) if motion.noise_scale is None else motion.noise_scale


MotionKind = Literal["twist", "imu", "none"]
MOTION_KINDS: tuple[MotionKind, ...] = get_args(MotionKind)
_KINDS: tuple[tuple[type[MotionSamples], type[MotionNoise], MotionKind], ...] = (
    (TwistSamples, TwistNoise, "twist"),
    (ImuSamples, ImuNoise, "imu"),
    (NoSamples, TwistChangeNoise, "none"),
)


def kind_of(samples: MotionSamples) -> MotionKind:
    """Return the kind of motion samples."""
    return next(kind for one, _, kind in _KINDS if isinstance(samples, one))


def are_of_one_kind(samples: MotionSamples, noise: MotionNoise) -> bool:
    """Say whether a noise is that of samples of its kind."""
    return any(isinstance(samples, one) and isinstance(noise, other) for one, other, _ in _KINDS)


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
