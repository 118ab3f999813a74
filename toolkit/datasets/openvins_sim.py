"""Exports of the OpenVINS simulator: a folder with calib.json and imu, features and truth_cam as csv or csv.gz.

What OpenVINS itself made of the recording may lie beside them as est.txt.

World z is up; accelerations are specific force; T_imu_cam takes the camera to the IMU, and quaternions (w first) take
the IMU to the world: so read, the truth reprojects the next frame to 1.2 px with 1 px noise, and not to 8 px or more.
Source: Geneva, Eckenhoff, Lee, Yang & Huang, "OpenVINS" (ICRA 2020).
"""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from toolkit.datasets.io.fields import Fields, check_frame_count, read_fields, rectified_observations, stamps_ns
from toolkit.datasets.io.tables import columns_of_file, find_table, headings_of
from toolkit.datasets.trajectories import openvins
from toolkit.datasets.trajectories.formats import checked_poses
from toolkit.errors import DataError
from toolkit.estimate import Trajectory
from toolkit.files.reading import read_input
from toolkit.geometry import IntArray, se3, se3_inverse
from toolkit.measurements import ImuNoise, StereoRig
from toolkit.motion_samples import ImuSamples
from toolkit.sequence import Observations, Provenance, Sequence, Truth

CITES = ("geneva2020openvins",)
_RETURNING, _OFFSET = "simulated by OpenVINS; feature ids return after gaps", "t_cam_to_imu_offset"
_CALIBRATION, _IMU, _FEATURES, _TRUTH = "calib.json", "imu.csv", "features.csv", "truth_cam.csv"
_IMU_COLUMNS = ("timestamp", "ax", "ay", "az", "gx", "gy", "gz")
_FEATURE_COLUMNS = ("timestamp", "frame", "feature_id", "uL", "vL", "uR", "vR", "in_left", "in_right")
_TRUTH_COLUMNS = (
    *("timestamp", "px", "py", "pz", "qx", "qy", "qz", "qw"),
    *("vx", "vy", "vz", "bax", "bay", "baz", "bgx", "bgy", "bgz"),
)
_ESTIMATE = "est.txt"
_ESTIMATE_KIND = "it is OpenVINS' own estimate, one state a line: export it again, or remove it to compare without it"
_NOISE_KEYS = ("accel_noise_density", "gyro_noise_density", "accel_random_walk", "gyro_random_walk")
_CAMERA_KEYS = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")
_REQUIRED = (
    *(f"{camera}.{key}" for camera in ("cam0", "cam1") for key in (*_CAMERA_KEYS, "T_imu_cam")),
    *(f"imu.{key}" for key in _NOISE_KEYS),
    *("pixel_noise_sigma", "gravity_world"),
)
# How far the right camera may be from a pure shift along x of the left one to count as rectified.
_RECTIFIED_TOLERANCE = 1e-6


def recognises(path: Path) -> bool:
    """Say whether the path is a folder whose calibration or feature table is of this kind."""
    features = find_table(path, _FEATURES)
    if features is not None and "feature_id" in headings_of(features):
        return True
    try:
        return b'"cam0"' in read_input(path / _CALIBRATION)
    except DataError:
        return False


def load(path: Path) -> Sequence:
    """Read an export, with its truth where it has one; frames outside the IMU's time are dropped.

    Raises DataError where files or columns are missing, damaged or not numeric, or the pair is not rectified.
    """
    imu_path, features_path = _tables(path)
    calibration = read_fields(path / _CALIBRATION)  # JSON is YAML
    calibration.require(*_REQUIRED)
    imu = columns_of_file(imu_path).numbers(*_IMU_COLUMNS)
    motion = ImuSamples(stamps_ns(imu_path, "timestamp", imu[:, 0]), imu[:, 1:4], imu[:, 4:7])
    frames_t_ns, sightings = _frames(features_path, motion.t_ns)
    check_frame_count(path, frames_t_ns.size)
    return Sequence(
        name=path.resolve().name,
        rig=_rig(calibration),
        noise=ImuNoise(**{key: calibration.number(f"imu.{key}") for key in _NOISE_KEYS}),
        frames_t_ns=frames_t_ns,
        observations=sightings,
        motion=motion,
        provenance=Provenance("openvins-sim", str(path), (_RETURNING, *_unused(calibration))),
        truth=_truth(path),
        gravity_world=calibration.constant("gravity_world", 3),
    )


def references(path: Path) -> dict[str, Trajectory]:
    """Read what OpenVINS estimated, where the export holds it.

    Raises DataError, naming the line, where it is damaged.
    """
    estimate = path / _ESTIMATE
    if not estimate.exists():
        return {}
    return {f"openvins ({_ESTIMATE})": openvins.read(estimate, _ESTIMATE_KIND)}


def _tables(folder: Path) -> tuple[Path, Path]:
    imu, features = find_table(folder, _IMU), find_table(folder, _FEATURES)
    if imu is None or features is None or not (folder / _CALIBRATION).is_file():
        there = {_CALIBRATION: (folder / _CALIBRATION).is_file(), _IMU: imu, _FEATURES: features}
        missing = ", ".join(name for name, found in there.items() if not found)
        raise DataError(f"{folder}: missing {missing} (tables may be gzipped); copy the whole export")
    return imu, features


def _unused(calibration: Fields) -> Iterator[str]:
    """Yield that the clocks differ by what a calibration states, where it does: of which table is not in the export."""
    offset_s = calibration.number(_OFFSET) if _OFFSET in calibration else 0.0
    if offset_s:
        yield f"not used of {calibration.path.name}: {_OFFSET}, {1e3 * offset_s:+.3f} ms; the stamps are as they stand"


def _rig(calibration: Fields) -> StereoRig:
    left, right = ([calibration.number(f"{camera}.{key}") for key in _CAMERA_KEYS] for camera in ("cam0", "cam1"))
    T_imu_cam = calibration.rigid("cam0.T_imu_cam")
    T_left_right = se3_inverse(T_imu_cam) @ calibration.rigid("cam1.T_imu_cam")
    baseline_m = float(T_left_right[0, 3])
    shift = se3(np.eye(3), np.array([baseline_m, 0.0, 0.0]))
    rectified = left == right and not any(left[4:]) and np.allclose(T_left_right, shift, atol=_RECTIFIED_TOLERANCE)
    if not rectified or baseline_m <= 0.0:
        raise DataError(f"{calibration.path}: cam0 and cam1 are not a rectified pair; export rectified features")
    variance_px2 = calibration.positive("pixel_noise_sigma") ** 2
    # v is the mean of two rows measured independently, so its variance is half.
    fx_px, fy_px, cx_px, cy_px = left[:4]
    cov_uv_px2 = variance_px2 * np.diag([1.0, 1.0, 0.5])
    return StereoRig(fx_px, fy_px, cx_px, cy_px, baseline_m, T_imu_cam, cov_uv_px2)


def _frames(path: Path, imu_t_ns: IntArray) -> tuple[IntArray, Observations]:
    """Return the stamps (K,) of the frames within the IMU's time, and their sightings in both cameras."""
    columns = columns_of_file(path)
    table = columns.numbers(*_FEATURE_COLUMNS)
    row_t_ns = stamps_ns(path, "timestamp", table[:, 0])
    unnamed = np.flatnonzero(~np.isfinite(table[:, 1:3]).all(axis=1))
    if unnamed.size:
        raise DataError(f"{path}: {columns.at(unnamed[0])} has no frame or feature_id; remove the row")
    inside = (row_t_ns >= imu_t_ns.min()) & (row_t_ns <= imu_t_ns.max())
    stereo = (table[:, 7:9] == 1.0).all(axis=1)
    number, first_row = np.unique(table[inside, 1], return_index=True)
    kept = inside & stereo
    frame = np.searchsorted(number, table[kept, 1])
    track_id = table[kept, 2].astype(np.int64)
    return row_t_ns[inside][first_row], rectified_observations(path, frame, track_id, table[kept, 3:7])


def _truth(folder: Path) -> Truth | None:
    path = find_table(folder, _TRUTH)
    if path is None:
        return None
    columns = columns_of_file(path)
    table = columns.numbers(*_TRUTH_COLUMNS)
    t_ns = stamps_ns(path, "timestamp", table[:, 0])
    T_world_imu = checked_poses(path, list(columns.numbers_of_rows or ()), t_ns, table[:, 1:8])
    return Truth(t_ns, T_world_imu, table[:, 8:11], table[:, 11:17])
