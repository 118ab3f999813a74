"""Calibration of EuRoC's sensor: read from the sensor.yaml files of a recording, or as published for all of them.

Camera 1 serves for the baseline only: the pair that is simulated is rectified, with the left camera as it is mounted.

The stated white noise is that of the sensor at rest. In flight, integrated over the 50 ms between frames and compared
with the truth that the tracks are simulated on, rotation and velocity scatter as densities of 1.5 to 2.8 times (gyro)
and 3 to 9 times (accelerometer) the stated ones on V1_01_easy and V2_01_easy: rotor vibration, scale and axis errors,
and the error of the truth. With the stated noise the smoother ends 0.14 m off on V2_01_easy, and the pose NEES of a
filter on V1_01_easy is 25. So every recording's white densities are multiplied by the same two numbers, near the upper
ends of those ranges; the walks stay as stated.
"""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from toolkit.datasets.io.fields import Fields, rigid
from toolkit.datasets.io.opencv_yaml import read_fields
from toolkit.errors import DataError
from toolkit.geometry import Array, se3_inverse
from toolkit.sequence import ImuNoise, StereoRig
from toolkit.simulation.scenarios import stereo_cov_px2

PIXEL_SIGMA_PX = 0.5
ACCEL_FACTOR, GYRO_FACTOR = 8.0, 3.0
_DENSITIES = {
    "accel_noise_density": "accelerometer_noise_density",
    "gyro_noise_density": "gyroscope_noise_density",
    "accel_random_walk": "accelerometer_random_walk",
    "gyro_random_walk": "gyroscope_random_walk",
}
# The sensor of all eleven recordings (Burri et al. 2016), to the digits of their sensor.yaml files.
_T_IMU_CAM0 = np.array(
    [
        [0.0148655429818, -0.999880929698, 0.00414029679422, -0.0216401454975],
        [0.999557249008, 0.0149672133247, 0.025715529948, -0.064676986768],
        [-0.0257744366974, 0.00375618835797, 0.999660727178, 0.00981073058949],
        [0.0, 0.0, 0.0, 1.0],
    ]
)
_CAM1_IN_IMU_M = np.array([-0.0198435579556, 0.0453689425024, 0.00786212447038])
_PINHOLE_PX = (458.654, 457.296, 367.215, 248.375)
_SIZE_PX = (752, 480)
_STATED_NOISE = ImuNoise(
    accel_noise_density=2e-3, gyro_noise_density=1.6968e-4, accel_random_walk=3e-3, gyro_random_walk=1.9393e-5
)


@dataclass(frozen=True, eq=False)
class Calibration:
    """The rectified rig, the image size, the IMU's noise in flight, and where all this is from."""

    rig: StereoRig
    size_px: tuple[int, int]
    noise: ImuNoise
    source: str


def published() -> Calibration:
    """Return the calibration that came with every recording of the set."""
    baseline_m = float(np.linalg.norm(_CAM1_IN_IMU_M - _T_IMU_CAM0[:3, 3]))
    rig = StereoRig(*_PINHOLE_PX, baseline_m, _T_IMU_CAM0, stereo_cov_px2(PIXEL_SIGMA_PX))
    source = "the folder has no sensor.yaml: calibration as published with all EuRoC recordings"
    return Calibration(rig, _SIZE_PX, _in_flight(_STATED_NOISE), source)


def read_calibration(mav0: Path) -> Calibration:
    """Read the sensor.yaml of both cameras and the IMU; extrinsics are made relative to the IMU.

    Raises DataError where one is missing, damaged or incomplete, or the right camera is not right of the left one.
    """
    left, right, imu = (read_fields(mav0 / sensor / "sensor.yaml") for sensor in ("cam0", "cam1", "imu0"))
    left.require("T_BS.data", "intrinsics", "resolution")
    imu.require(*_DENSITIES.values())
    T_imu_body = se3_inverse(extrinsic(imu))
    T_left_right = se3_inverse(extrinsic(left)) @ extrinsic(right)
    if T_left_right[0, 3] <= 0.0:
        raise DataError(f"{right.path}: cam1 is not to the right of cam0; exchange the two")
    fx_px, fy_px, cx_px, cy_px = left.constant("intrinsics", 4)
    width_px, height_px = left.constant("resolution", 2)
    rig = StereoRig(
        *(fx_px, fy_px, cx_px, cy_px, float(np.linalg.norm(T_left_right[:3, 3]))),
        T_imu_cam=T_imu_body @ extrinsic(left),
        cov_uv_px2=stereo_cov_px2(PIXEL_SIGMA_PX),
    )
    stated = ImuNoise(**{ours: imu.positive(theirs) for ours, theirs in _DENSITIES.items()})
    return Calibration(
        rig, (int(width_px), int(height_px)), _in_flight(stated), "calibration from the folder's sensor.yaml files"
    )


def extrinsic(sensor: Fields) -> Array:
    """Return T_body_sensor (4, 4) of a sensor.yaml."""
    sensor.require("T_BS.data")
    return rigid(sensor.path, "T_BS", sensor.constant("T_BS.data", 16).reshape(4, 4))


def _in_flight(stated: ImuNoise) -> ImuNoise:
    """Return what the densities stated for a sensor at rest become in flight (measured, see the module)."""
    return replace(
        stated,
        accel_noise_density=ACCEL_FACTOR * stated.accel_noise_density,
        gyro_noise_density=GYRO_FACTOR * stated.gyro_noise_density,
    )
