"""What every estimator reads: the calibrated rig, and packets of sightings and measured motion with their noise.

Time is in whole nanoseconds (``t_ns``). The motion of an interval is of one of three kinds: measured body twists, the
samples of an IMU, or none. All values are immutable; their arrays are read-only.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal, Self, get_args

import numpy as np

from toolkit.arrays import check_rigid, freeze_arrays, rotation_defect
from toolkit.geometry import (
    Array,
    BoolArray,
    IntArray,
    quaternion_from_rotation,
    read_only,
    rotation_from_quaternion,
    se3,
    se3_inverse,
)

NS_PER_S = 1_000_000_000
GRAVITY_WORLD = (0.0, 0.0, -9.81)
# How far a rotation may be from orthonormal: written with three decimals, and as a product of doubles.
_MOST_ROTATION_DEFECT, _ORTHONORMAL = 5e-3, 1e-14


@dataclass(frozen=True, eq=False)
class StereoRig:
    """A rectified stereo pair fixed to the IMU; one measurement is (uL, uR, v) in pixels, uR NaN if only left saw.

    ``T_imu_cam`` (4, 4) takes left-camera coordinates (x right, y down, z forward) to the IMU frame;
    ``cov_uv_px2`` (3, 3) is the measurement covariance. Where a file has vL and vR, v is their mean and its
    variance is half of theirs. ``track_weight`` in (0, 1] is the share of its stated information that a sighting
    carries, because errors along its track and of its neighbours are correlated (:mod:`toolkit.noise`): an update
    divides the covariance by it. Whether a sighting is an outlier is decided by the stated covariance.
    """

    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float
    baseline_m: float
    T_imu_cam: Array
    cov_uv_px2: Array
    track_weight: float = 1.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "T_imu_cam", _orthonormal(np.asarray(self.T_imu_cam, dtype=float)))
        freeze_arrays(self, T_imu_cam=(4, 4), cov_uv_px2=(3, 3))

    @cached_property
    def T_cam_imu(self) -> Array:
        """The inverse of the extrinsic (4, 4)."""
        inverse: Array = read_only(se3_inverse(self.T_imu_cam))
        return inverse

    @cached_property
    def whitener(self) -> Array:
        """W (3, 3) with W cov W^T = 1: a residual (..., 3) px becomes one of unit variance by ``residual @ W.T``."""
        root: Array = read_only(np.linalg.inv(np.linalg.cholesky(self.cov_uv_px2)))
        return root


def _orthonormal(T_imu_cam: Array) -> Array:
    """Return an extrinsic with its rotation made orthonormal: files write it with few decimals.

    Raises DataError where it is no rigid motion at all.
    """
    if T_imu_cam.shape != (4, 4):
        return T_imu_cam
    check_rigid("T_imu_cam", T_imu_cam, _MOST_ROTATION_DEFECT)
    if rotation_defect(T_imu_cam) < _ORTHONORMAL:
        return T_imu_cam
    return se3(rotation_from_quaternion(quaternion_from_rotation(T_imu_cam[:3, :3])), T_imu_cam[:3, 3])


def is_left_only(uv_px: Array) -> BoolArray:
    """Say which sightings (uL, uR, v) (..., 3) px lack the right image: their uR is NaN."""
    return np.asarray(np.isnan(uv_px[..., 1]))


def is_measured(uv_px: Array) -> BoolArray:
    """Say which sightings (..., 3) px are finite, but for the uR of those by the left image alone."""
    finite = np.isfinite(uv_px)
    return np.asarray(finite[..., 0] & finite[..., 2] & (finite[..., 1] | is_left_only(uv_px)))


@dataclass(frozen=True, eq=False)
class StereoFrame:
    """What the camera saw at one instant: stamp, track ids (N,), measurements (uL, uR, v) (N, 3) px."""

    t_ns: int
    track_ids: IntArray
    uvs_px: Array

    def select(self, rows: BoolArray | IntArray) -> "StereoFrame":
        """Return the frame with the sightings of a mask (N,) or an index (M,) only."""
        return StereoFrame(self.t_ns, self.track_ids[rows], self.uvs_px[rows])


@dataclass(frozen=True, eq=False)
class _Densities:
    """Continuous densities; names of white ones end in ``_density``, of walks of biases in ``_random_walk``."""

    def scaled(self, factor: float) -> Self:
        """Return the noise with its white densities scaled; the random walks stay."""
        return self._multiplied("_density", factor)

    def with_biases_held(self, share: float) -> Self:
        """Return the noise with a share of the random walks."""
        return self._multiplied("_random_walk", share)

    def _multiplied(self, kind: str, factor: float) -> Self:
        return replace(self, **{name: factor * value for name, value in vars(self).items() if name.endswith(kind)})


@dataclass(frozen=True, eq=False)
class TwistNoise(_Densities):
    """Continuous white-noise densities of a measured body twist, per axis (3,), and of the gyro bias' walk.

    Units: m/s/sqrt(Hz), rad/s/sqrt(Hz), rad/s^2/sqrt(Hz).
    """

    velocity_noise_density: Array
    gyro_noise_density: Array
    gyro_random_walk: Array

    def __post_init__(self) -> None:
        freeze_arrays(self, velocity_noise_density=(3,), gyro_noise_density=(3,), gyro_random_walk=(3,))


@dataclass(frozen=True)
class ImuNoise(_Densities):
    """Continuous noise densities of an IMU, with Kalibr's names.

    Units: m/s^2/sqrt(Hz), rad/s/sqrt(Hz), m/s^3/sqrt(Hz), rad/s^2/sqrt(Hz).
    """

    accel_noise_density: float
    gyro_noise_density: float
    accel_random_walk: float
    gyro_random_walk: float


@dataclass(frozen=True, eq=False)
class TwistChangeNoise(_Densities):
    """Densities of the white noise on the change of an unmeasured twist, per axis (3,), in the IMU frame.

    Units: m/s^2/sqrt(Hz) of the velocity, rad/s^2/sqrt(Hz) of the turn rate.
    """

    velocity_change_density: Array
    turn_change_density: Array

    def __post_init__(self) -> None:
        freeze_arrays(self, velocity_change_density=(3,), turn_change_density=(3,))


MotionNoise = TwistNoise | ImuNoise | TwistChangeNoise
MotionKind = Literal["twist", "imu", "none"]
MOTION_KINDS: tuple[MotionKind, ...] = get_args(MotionKind)


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


@dataclass(frozen=True, eq=False)
class Packet:
    """Everything between two frames plus the frame; ``motion`` is None in the first packet."""

    index: int
    motion: Motion | None
    frame: StereoFrame


@dataclass(frozen=True, eq=False)
class Prior:
    """The state every estimator starts from, at the first frame.

    ``bias`` (6,) is [accel, gyro]. ``cov`` (15, 15) is in GTSAM's tangent order and side: rotation and
    position (both body frame), velocity (body frame), accelerometer bias, gyro bias. ``source`` says where
    it came from.
    """

    T_world_imu: Array
    v_world: Array
    bias: Array
    cov: Array
    source: str

    def __post_init__(self) -> None:
        freeze_arrays(self, T_world_imu=(4, 4), v_world=(3,), bias=(6,), cov=(15, 15))

    def with_biases_held(self, share: float) -> Self:
        """Return the prior with the biases' standard deviations reduced to a share."""
        scale = np.repeat([1.0, share], [9, 6])
        return replace(self, cov=self.cov * np.outer(scale, scale))
