"""KITTI odometry 00, frames 14-153: real stereo tracks and the real 100 Hz IMU that ship inside the gtsam wheel.

The tracks (``VO_stereo_factors00``) and the IMU (``KittiEquivBiasedImu``) come from two examples of GTSAM and are
joined here: both are drive 2011_10_03_drive_0027. The data are KITTI's (Geiger, Lenz, Stiller & Urtasun, IJRR 2013).
"""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from toolkit.datasets.io.fields import stamps_ns
from toolkit.errors import DataError
from toolkit.geometry import Array, IntArray, se3_inverse
from toolkit.measurements import ImuNoise, StereoRig
from toolkit.models.noise import pixel_covariance
from toolkit.motion_samples import ImuSamples
from toolkit.sequence import ONE_ROW_FOR_BOTH, Observations, Provenance, Sequence

CITES = ("geiger2013kitti", "gtsam")
# The first IMU sample is followed by a gap of 1.92 s, which covers frames 0 to 13.
FIRST_FRAME = 14
# Seconds of day of frame 0 and the camera's period, found by aligning the yaw rates of tracks and IMU (+-5 ms).
_FRAME_0_S = 46535.000
_FRAME_PERIOD_S = 0.10366
# KITTI raw calibration 2011_10_03 (calib_imu_to_velo, calib_velo_to_cam, R_rect_00): IMU -> rectified left camera.
_T_CAM_IMU = np.array(
    [
        [0.001196690, -0.999976583, 0.006738035, -0.325410533],
        [-0.009241244, -0.006748810, -0.999934524, 0.754049777],
        [0.999956583, 0.001134343, -0.009249104, -1.094932791],
        [0.0, 0.0, 0.0, 1.0],
    ]
)
_FACTS = (
    "KITTI odometry 00, frames 14-153, from the gtsam wheel: real stereo tracks, real 100 Hz IMU",
    "the tracks carry a scale error of -1.6 %, which stereo alone cannot see; "
    "stereo bundle adjustment ends with about 2.2 % drift",
    "camera and IMU clocks were aligned by yaw rate to +-5 ms",
    ONE_ROW_FOR_BOTH,
)


def make(seed: int) -> Sequence:
    """Return the sequence, without truth; the data are real and the seed changes nothing.

    Raises DataError where the gtsam wheel lacks the files.
    """
    del seed
    tracks = _table("VO_stereo_factors00")
    tracks = tracks[tracks[:, 0] >= FIRST_FRAME]
    frame_number, frame = np.unique(tracks[:, 0].astype(np.int64), return_inverse=True)
    stamps_s = _FRAME_0_S + _FRAME_PERIOD_S * frame_number.astype(np.float64)
    frames_t_ns = stamps_ns(_path("VO_stereo_factors00"), "frame", stamps_s)
    return Sequence(
        name="kitti00",
        rig=_rig(),
        noise=_imu_noise(),
        frames_t_ns=frames_t_ns,
        observations=Observations.sorted(frame, tracks[:, 1].astype(np.int64), tracks[:, 2:5]),
        motion=_imu_around(frames_t_ns),
        provenance=Provenance("kitti00", "gtsam wheel: VO_stereo_factors00, KittiEquivBiasedImu", _FACTS),
    )


BUILT_IN = {"kitti00": make}


def _rig() -> StereoRig:
    fx_px, fy_px, _skew, cx_px, cy_px, baseline_m = _table("VO_calibration00")[0]
    return StereoRig(fx_px, fy_px, cx_px, cy_px, baseline_m, se3_inverse(_T_CAM_IMU), pixel_covariance(1))


def _imu_around(frames_t_ns: IntArray) -> ImuSamples:
    """Return the samples from the last before the first frame to the first after the last."""
    samples = _table("KittiEquivBiasedImu", header_lines=1)
    t_ns = stamps_ns(_path("KittiEquivBiasedImu"), "Time", samples[:, 0])
    begin = np.searchsorted(t_ns, frames_t_ns[0], side="right") - 1
    end = np.searchsorted(t_ns, frames_t_ns[-1], side="left") + 1
    rows = slice(begin, end)
    return ImuSamples(t_ns[rows], samples[rows, 2:5], samples[rows, 5:8])


def _imu_noise() -> ImuNoise:
    """Read the sigmas shipped beside the samples: continuous densities, for as those of one 10 ms sample they would lie
    below what the samples' second differences show (0.0018-0.0033 m/s^2/sqrt(Hz), 0.4e-4-1.6e-4 rad/s/sqrt(Hz)).
    """
    header, values = _path("KittiEquivBiasedImu_metadata").read_text(encoding="ascii").splitlines()[:2]
    stated: Mapping[str, float] = dict(zip(header.split(), map(float, values.split()), strict=True))
    return ImuNoise(
        accel_noise_density=stated["AccelerometerSigma"],
        gyro_noise_density=stated["GyroscopeSigma"],
        accel_random_walk=stated["AccelerometerBiasSigma"],
        gyro_random_walk=stated["GyroscopeBiasSigma"],
    )


def _path(name: str) -> Path:
    import gtsam

    try:
        return Path(gtsam.findExampleDataFile(name))  # type: ignore[no-untyped-call]
    except RuntimeError as error:
        raise DataError(f"kitti00: the gtsam wheel has no example file {name}; install gtsam>=4.3 from PyPI") from error


def _table(name: str, header_lines: int = 0) -> Array:
    table: Array = np.loadtxt(_path(name), skiprows=header_lines, ndmin=2)
    return table
