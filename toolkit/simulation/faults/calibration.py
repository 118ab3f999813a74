"""Faults of the calibration: fields nobody filled in, in another unit, inverted, or off by a little."""

from dataclasses import replace
from typing import Any

import numpy as np

from toolkit.geometry import se3, se3_inverse, so3_exp
from toolkit.sequence import Sequence
from toolkit.simulation.faults.parts import with_pixels


def zero_intrinsics(sequence: Sequence, dose: float = 0.0, seed: int = 0) -> Sequence:
    """Set every intrinsic to the dose: a K nobody filled in."""
    return _with_rig(sequence, fx_px=dose, fy_px=dose, cx_px=dose, cy_px=dose)


def identity_intrinsics(sequence: Sequence, dose: float = 1.0, seed: int = 0) -> Sequence:
    """Set the focal lengths to the dose and the centre to zero: K left at the identity."""
    return _with_rig(sequence, fx_px=dose, fy_px=dose, cx_px=0.0, cy_px=0.0)


def transposed_intrinsics(sequence: Sequence, dose: float = 0.0, seed: int = 0) -> Sequence:
    """Set the principal point to the dose: the elements that are read from a transposed K."""
    return _with_rig(sequence, cx_px=dose, cy_px=dose)


def negative_focal(sequence: Sequence, dose: float = -1.0, seed: int = 0) -> Sequence:
    """Multiply the focal lengths by the dose: axes of a camera that looks backwards."""
    return _with_rig(sequence, fx_px=dose * sequence.rig.fx_px, fy_px=dose * sequence.rig.fy_px)


def wrong_focal_length(sequence: Sequence, dose: float = 1.05, seed: int = 0) -> Sequence:
    """Multiply both focal lengths by the dose: a data sheet instead of a calibration, another zoom."""
    return _with_rig(sequence, fx_px=dose * sequence.rig.fx_px, fy_px=dose * sequence.rig.fy_px)


def wrong_aspect(sequence: Sequence, dose: float = 1.05, seed: int = 0) -> Sequence:
    """Multiply fx alone by the dose: images that were resized in one direction."""
    return _with_rig(sequence, fx_px=dose * sequence.rig.fx_px)


def shifted_centre(sequence: Sequence, dose: float = 15.0, seed: int = 0) -> Sequence:
    """Shift the stated principal point by the dose (px) in a random direction: the middle of the image used instead."""
    angle = np.random.default_rng(seed).uniform(0.0, 2.0 * np.pi)
    cx_px, cy_px = sequence.rig.cx_px + dose * np.cos(angle), sequence.rig.cy_px + dose * np.sin(angle)
    return _with_rig(sequence, cx_px=float(cx_px), cy_px=float(cy_px))


def skewed_pixels(sequence: Sequence, dose: float = 50.0, seed: int = 0) -> Sequence:
    """Give the images a skew of the dose (px), which a K may state but no rectified pair has."""
    rig, uv_px = sequence.rig, sequence.observations.uv_px
    shift_px = dose * (uv_px[:, 2:] - rig.cy_px) / rig.fy_px
    return with_pixels(sequence, uv_px + shift_px * np.array([1.0, 1.0, 0.0]))


def baseline_unit(sequence: Sequence, dose: float = 1000.0, seed: int = 0) -> Sequence:
    """Multiply the baseline by the dose: 1000 for millimetres."""
    return _with_rig(sequence, baseline_m=dose * sequence.rig.baseline_m)


def extrinsic_unit(sequence: Sequence, dose: float = 1000.0, seed: int = 0) -> Sequence:
    """Multiply the camera's position in the IMU frame by the dose: 1000 for millimetres, -1 for a sign mixed up."""
    T_imu_cam = sequence.rig.T_imu_cam
    return _with_rig(sequence, T_imu_cam=se3(T_imu_cam[:3, :3], dose * T_imu_cam[:3, 3]))


def inverted_extrinsic(sequence: Sequence, dose: float = 1.0, seed: int = 0) -> Sequence:
    """Invert the extrinsic: IMU to camera written where camera to IMU is read. A dose of 0 leaves it."""
    return _with_rig(sequence, T_imu_cam=se3_inverse(sequence.rig.T_imu_cam)) if dose else sequence


def turned_camera(sequence: Sequence, dose: float = 0.05, seed: int = 0) -> Sequence:
    """Rotate the camera in its mount by the dose (rad) about a random axis: a knock, a calibration of another day."""
    axis = np.random.default_rng(seed).standard_normal(3)
    T_imu_cam = sequence.rig.T_imu_cam
    return _with_rig(sequence, T_imu_cam=T_imu_cam @ se3(so3_exp(dose * axis / np.linalg.norm(axis)), np.zeros(3)))


def displaced_camera(sequence: Sequence, dose: float = 0.3, seed: int = 0) -> Sequence:
    """State the camera's position wrong by the dose (m) in a random direction: a tape measure, a bracket moved."""
    axis, T_imu_cam = np.random.default_rng(seed).standard_normal(3), sequence.rig.T_imu_cam
    displaced = se3(T_imu_cam[:3, :3], T_imu_cam[:3, 3] + dose * axis / np.linalg.norm(axis))
    return _with_rig(sequence, T_imu_cam=displaced)


def _with_rig(sequence: Sequence, **fields: Any) -> Sequence:
    return replace(sequence, rig=replace(sequence.rig, **fields))
