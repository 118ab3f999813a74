"""TUM: ``t x y z qx qy qz qw`` between blanks, seconds and metres, Hamilton quaternions with the scalar last.

Sturm, Engelhard, Endres, Burgard & Cremers, "A benchmark for the evaluation of RGB-D SLAM systems" (IROS 2012).
"""

from pathlib import Path

import numpy as np

from toolkit.datasets.io.fields import stamps_ns
from toolkit.datasets.trajectories.poses import OtherOrder, PosesFile, checked_poses, finite, rows_text
from toolkit.datasets.trajectories.rows import Rows, read_rows, stamp_text
from toolkit.errors import DataError
from toolkit.estimate import Trajectory
from toolkit.geometry import quaternion_from_rotation
from toolkit.measurements import NS_PER_S

COLUMNS = "t x y z qx qy qz qw"
KIND = "a TUM file is text, one pose a line"
HEADER = "# t_s x_m y_m z_m qx qy qz qw: the IMU in the world; quaternions are Hamilton, scalar last"
W_FIRST = OtherOrder(
    -1, "w first", "the quaternions look w first; TUM order is qx qy qz qw: move the fifth column to the end"
)
_WIDTH = 8


def recognises(rows: Rows) -> bool:
    """Say whether rows have the shape of this format."""
    return not rows.commas and rows.width == _WIDTH


def parse(rows: Rows) -> PosesFile:
    """Return the poses of rows.

    Raises DataError, naming the line and the likely cause, where they are not a table of eight finite numbers a
    line, time does not increase or is not in seconds, or quaternions are not of unit length.
    """
    if rows.commas:
        raise DataError(f"{rows.path}: in a TUM file the columns ({COLUMNS}) are separated by blanks, not commas")
    table = rows.numbers(_WIDTH, COLUMNS)
    stamps_ns(rows.path, "time", table[:, 0])  # names a wrong unit
    t_ns = rows.stamps(NS_PER_S)
    T_world_imu = checked_poses(rows.path, rows.line_numbers, t_ns, table[:, 1:])
    return PosesFile(rows.path, "TUM", t_ns, T_world_imu, W_FIRST)


def read(path: Path, kind: str = KIND) -> Trajectory:
    """Read a file; ``kind`` describes it in the error where that fails. Raises DataError as :func:`parse` does."""
    poses = parse(read_rows(path, kind))
    assert poses.t_ns is not None
    return Trajectory(poses.t_ns, poses.T_world_imu)


def text(trajectory: Trajectory) -> str:
    """Return a trajectory as the text of a file; poses that are not finite are left out."""
    kept = finite(trajectory)
    values = np.hstack([kept.positions, quaternion_from_rotation(kept.T_world_imu[:, :3, :3])])
    stamps = (stamp_text(t_ns) for t_ns in kept.t_ns.tolist())
    return rows_text(HEADER, zip(stamps, values.tolist(), strict=True), " ")
