"""Calibration of a day of KITTI raw: calib_cam_to_cam, calib_velo_to_cam and calib_imu_to_velo."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from toolkit.datasets.io.fields import Fields, rigid
from toolkit.errors import DataError
from toolkit.frontend import Camera, RectifiedPair, already_rectified, rectified
from toolkit.geometry import Array, se3, se3_inverse
from toolkit.inputs import is_regular, read_text_input

_FILES = {"calib_cam_to_cam.txt": "", "calib_velo_to_cam.txt": "velo_to_cam.", "calib_imu_to_velo.txt": "imu_to_velo."}


@dataclass(frozen=True, eq=False)
class PairMounting:
    """A pair for the front end, where its left camera is mounted, as it was before rectification, and how one knows."""

    pair: RectifiedPair
    T_imu_left: Array
    source: str


def day_of(root: Path) -> Fields:
    """Read the three files of a drive's day, in its folder or the one above it.

    Raises DataError where one is missing or not made of names and numbers.
    """
    folder = next((f for f in (root, root.parent) if is_regular(f / "calib_cam_to_cam.txt")), root.parent)
    arrays: dict[str, np.ndarray] = {}
    for name, prefix in _FILES.items():
        text = read_text_input(folder / name, "KITTI's calibration is text")
        for line in text.splitlines():
            key, colon, rest = line.partition(":")
            if not colon:
                continue
            try:
                arrays[prefix + key.strip()] = np.array([float(word) for word in rest.split()])
            except ValueError:
                continue  # a date
    return Fields(folder / "calib_cam_to_cam.txt", arrays)


def mounting(day: Fields, sides: tuple[str, str], size_px: tuple[int, int]) -> PairMounting:
    """Return the pair of two cameras, as "00" and "01", whose images have a size: the rectified one, or the sensor's.

    Raises DataError where a value is missing or impossible, or images have neither size.
    """
    names = [f"{what}_{side}" for side in sides for what in ("S", "K", "D", "R", "T", "S_rect", "P_rect")]
    day.require(*names, "R_rect_00", *(f"{p}{key}" for p in list(_FILES.values())[1:] for key in ("R", "T")))
    T_velo_imu, T_cam0_velo = _motion(day, "imu_to_velo."), _motion(day, "velo_to_cam.")
    T_cam0_imu = T_cam0_velo @ T_velo_imu
    rectified_px, raw_px = (_size(day, f"{key}_{sides[0]}") for key in ("S_rect", "S"))
    if size_px == rectified_px:
        T_rect_cam0 = se3(day.constant("R_rect_00", 9).reshape(3, 3), np.zeros(3))
        return _already(day, sides, size_px, rigid(day.path, "R_rect_00", T_rect_cam0) @ T_cam0_imu)
    if size_px != raw_px:
        raise DataError(f"{day.path}: images of {size_px} px are neither rectified, {rectified_px}, nor raw, {raw_px}")
    cameras = [_camera(day, side) for side in sides]
    T_left_cam0, T_right_cam0 = (_motion(day, "", f"_{side}") for side in sides)
    pair = rectified(cameras[0], cameras[1], T_right_cam0 @ se3_inverse(T_left_cam0))
    return PairMounting(pair, se3_inverse(T_left_cam0 @ T_cam0_imu), "raw images, rectified with the day's calibration")


def _already(day: Fields, sides: tuple[str, str], size_px: tuple[int, int], T_rect_imu: Array) -> PairMounting:
    left, right = (day.constant(f"P_rect_{side}", 12).reshape(3, 4) for side in sides)
    fx, fy, cx, cy = (float(x) for x in (left[0, 0], left[1, 1], left[0, 2], left[1, 2]))
    baseline_m = float((left[0, 3] - right[0, 3]) / fx) if fx > 0.0 else 0.0
    if not (fy > 0.0 and baseline_m > 0.0):
        raise DataError(
            f"{day.path}: P_rect_{sides[0]} and P_rect_{sides[1]} are not those of a left and a right camera"
        )
    T_left_rect = se3(np.eye(3), np.linalg.inv(left[:, :3]) @ left[:, 3])
    pair = already_rectified((fx, fy, cx, cy), baseline_m, size_px)
    return PairMounting(pair, se3_inverse(T_left_rect @ T_rect_imu), "images rectified as the data set has them")


def _camera(day: Fields, side: str) -> Camera:
    K = day.constant(f"K_{side}", 9).reshape(3, 3)
    pinhole = (float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2]))
    if not (pinhole[0] > 0.0 and pinhole[1] > 0.0):
        raise DataError(f"{day.path}: K_{side} has no positive focal lengths")
    return Camera(pinhole, "radtan", day.constant(f"D_{side}", 5), _size(day, f"S_{side}"))


def _size(day: Fields, key: str) -> tuple[int, int]:
    width, height = day.constant(key, 2)
    return int(width), int(height)


def _motion(day: Fields, prefix: str, suffix: str = "") -> Array:
    """Return the rigid motion (4, 4) of an R and a T."""
    rotation = day.constant(f"{prefix}R{suffix}", 9).reshape(3, 3)
    return rigid(day.path, f"{prefix}R{suffix}", se3(rotation, day.constant(f"{prefix}T{suffix}", 3)))
