"""By how much the camera's axes are turned against those of the samples, where the extrinsic is nearly right."""

from typing import NamedTuple

import numpy as np

from toolkit.audit.parts.intervals import Intervals
from toolkit.audit.parts.robust import CAUCHY_SIGMAS, ITERATIONS, spread
from toolkit.geometry import Array, skew

# Axes about which the turn is known worse than this many times the best one are not judged: about its own direction a
# velocity says nothing, and slip feigns something.
MOST_ERROR_RATIO = 4.0


class Turn(NamedTuple):
    """Small rotations (m,) rad about m axes that can be judged, and their standard errors (m,) rad."""

    rad: Array
    error_rad: Array


def turn_of_camera(intervals: Intervals, T_imu_cam: Array) -> Turn:
    """Return the turn that brings the camera's motion onto the measured one, by velocities, or else by rotations."""
    R_imu_cam, p_imu_cam = T_imu_cam[:3, :3], T_imu_cam[:3, 3]
    seen_radps = intervals.w_cam_radps @ R_imu_cam.T
    w_radps = intervals.w_radps - np.median(intervals.w_radps - seen_radps, axis=0)
    if intervals.v_mps is None:
        return _turn(w_radps, seen_radps)
    return _turn(intervals.v_mps + np.cross(w_radps, p_imu_cam), intervals.v_cam_mps @ R_imu_cam.T)


def _turn(measured: Array, seen: Array) -> Turn:
    """Solve measured = seen + turn x seen, both (M, 3), with Cauchy weights; errors robust to unequal scatter."""
    jacobian, turn_rad = -skew(seen), np.zeros(3)
    information, moments = np.eye(3), np.zeros((len(seen), 3))
    for _ in range(ITERATIONS):
        residual = measured - seen - jacobian @ turn_rad
        scale = np.maximum(spread(residual), 1e-9)
        weight = 1.0 / (1.0 + (residual / scale) ** 2 / CAUCHY_SIGMAS**2) / scale**2
        information = np.einsum("nij,ni,nik->jk", jacobian, weight, jacobian)
        information += 1e-9 * np.trace(information) * np.eye(3) + 1e-12 * np.eye(3)
        turn_rad = np.linalg.solve(information, np.einsum("nij,ni->j", jacobian, weight * (measured - seen)))
        moments = np.einsum("nij,ni->nj", jacobian, weight * residual)
    inverse = np.linalg.inv(information)
    axes = np.linalg.eigh(information).eigenvectors.T
    error_rad = np.sqrt(np.einsum("ij,jk,ik->i", axes, inverse @ (moments.T @ moments) @ inverse, axes))
    judged = error_rad <= MOST_ERROR_RATIO * error_rad.min()
    return Turn((axes @ turn_rad)[judged], error_rad[judged])
