"""Argument types of kernels, as numba's types: rows (n,), matrices, stacks of matrices, all contiguous, and tuples."""

from typing import Any

from numba import types

Arrays = tuple[Any, ...]
ROW, MATRIX, STACK = types.float64[::1], types.float64[:, ::1], types.float64[:, :, ::1]
MASK = types.boolean[:, ::1]
# Poses (W, 4, 4), poses to linearise at (W, 4, 4), covariance of their errors (6 W, 6 W).
WINDOW = types.Tuple((STACK, STACK, MATRIX))
# fx, fy, cx, cy px and baseline m (5,); T_imu_cam (1, 4, 4); whitener (3, 3).
CAMERA = types.Tuple((ROW, STACK, MATRIX))
