"""KITTI: one pose a frame, the first three rows of its 4x4 matrix row by row between blanks, in metres; no stamps.

Geiger, Lenz & Urtasun, "Are we ready for autonomous driving? The KITTI vision benchmark suite" (CVPR 2012). KITTI's
own poses are the left camera's; here, as in every file of this package, they are the IMU's.
"""

import numpy as np

from toolkit.datasets.trajectories.poses import TOO_FAR, UNIT_TOLERANCE, PosesFile, rows_text
from toolkit.datasets.trajectories.rows import Rows
from toolkit.errors import DataError
from toolkit.estimate import FARTHEST_M, Trajectory
from toolkit.geometry import quaternion_from_rotation, rotation_from_quaternion, se3

COLUMNS = "r11 r12 r13 x r21 r22 r23 y r31 r32 r33 z"
_WIDTH = 12


def recognises(rows: Rows) -> bool:
    """Say whether rows have the shape of this format."""
    return not rows.commas and rows.width == _WIDTH


def parse(rows: Rows) -> PosesFile:
    """Return the poses of rows, without stamps.

    Raises DataError, naming the line, where they are not a table of twelve finite numbers a line, or a matrix is
    not a rotation.
    """
    matrices = rows.numbers(_WIDTH, COLUMNS).reshape(-1, 3, 4)
    rotations = matrices[:, :, :3]
    off = np.abs(np.swapaxes(rotations, 1, 2) @ rotations - np.eye(3)).max(axis=(1, 2))
    checks = (
        (np.isfinite(matrices).all(axis=(1, 2)), "holds a value that is not finite; write a pose for every frame"),
        (np.abs(matrices[:, :, 3]).max(axis=1, initial=0.0) < FARTHEST_M, TOO_FAR),
        (off < UNIT_TOLERANCE, f"does not hold a rotation; expected {COLUMNS}"),
        (np.linalg.det(rotations) > 0.0, "holds a reflection, not a rotation: the sign of an axis is wrong"),
    )
    for passed, complaint in checks:
        if not passed.all():
            raise DataError(f"{rows.path}: line {rows.line_numbers[int(np.argmin(passed))]} {complaint}")
    # Through quaternions, as in the other formats, so that printed digits leave a rotation.
    R_world_imu = rotation_from_quaternion(quaternion_from_rotation(rotations))
    return PosesFile(rows.path, "KITTI", None, se3(R_world_imu, matrices[:, :, 3]), None)


def text(trajectory: Trajectory) -> str:
    """Return a trajectory, one pose for every frame, as the text of a file.

    Raises DataError where a pose is not finite: rows are frames, so none can be left out.
    """
    poses = trajectory.T_world_imu
    bad = np.flatnonzero(~np.isfinite(poses).all(axis=(1, 2)))
    if bad.size:
        raise DataError(f"pose {bad[0]} is not finite, and KITTI's rows are frames; choose a format with stamps")
    return rows_text("", (("", row) for row in poses[:, :3].reshape(-1, _WIDTH).tolist()), " ")
