"""OpenVINS: its states ``t qx qy qz qw x y z ...``, or the recording of its poses ``t x y z qx qy qz qw P...``.

Between blanks, seconds and metres. The states' quaternion is JPL's q_GtoI, scalar last, of the rotation from the world
to the IMU: the same four numbers as Hamilton's of the IMU to the world, which the recording has. Velocity, gyro and
accelerometer bias follow in the states, then the calibration; what follows the pose is not read. The recording has two
covariances without what couples them, their upper triangles row by row: of the orientation, whose error is a small turn
of the IMU frame, and of the position in the world. Geneva, Eckenhoff, Lee, Yang & Huang, "OpenVINS" (ICRA 2020).
"""

from pathlib import Path

import numpy as np

from toolkit.datasets.io.fields import stamps_ns
from toolkit.datasets.trajectories.poses import OtherOrder, PosesFile, StatedApart, checked_poses, finite, rows_text
from toolkit.datasets.trajectories.rows import Rows, read_rows, stamp_text
from toolkit.estimate import Trajectory
from toolkit.geometry import Array, quaternion_from_rotation
from toolkit.measurements import NS_PER_S

COLUMNS = "t qx qy qz qw x y z vx vy vz bgx bgy bgz bax bay baz"
RECORDED_COLUMNS = "t x y z qx qy qz qw Pr11 ... Pt33"
HEADER = "# timestamp(s) q_GtoI(x y z w, JPL) p_IinG v_IinG bg ba; nan is not known"
W_FIRST = OtherOrder(
    -1, "w first", "the quaternions look w first; OpenVINS' order is qx qy qz qw: move the scalar behind the others"
)
_STATE_WIDTH, _RECORDED_WIDTH = 17, 20
_STATE_POSE, _RECORDED_POSE = [5, 6, 7, 1, 2, 3, 4], [1, 2, 3, 4, 5, 6, 7]


def recognises(rows: Rows) -> bool:
    """Say whether rows have the shape of one of the two."""
    return not rows.commas and rows.width >= _STATE_WIDTH


def parse(rows: Rows) -> PosesFile:
    """Return the poses of rows.

    Raises DataError, naming the line and the likely cause, where they are not a table of numbers, time does not
    increase or is not in seconds, or quaternions are not of unit length.
    """
    recorded = rows.width == _RECORDED_WIDTH
    columns, pose = (RECORDED_COLUMNS, _RECORDED_POSE) if recorded else (COLUMNS, _STATE_POSE)
    table = rows.numbers(max(rows.width, _STATE_WIDTH), columns)
    stamps_ns(rows.path, "time", table[:, 0])  # names a wrong unit
    t_ns = rows.stamps(NS_PER_S)
    T_world_imu = checked_poses(rows.path, rows.line_numbers, t_ns, table[:, pose])
    stated = StatedApart(_symmetric(table[:, 8:14]), _symmetric(table[:, 14:20])) if recorded else None
    return PosesFile(rows.path, "OpenVINS", t_ns, T_world_imu, W_FIRST, stated)


def _symmetric(upper: Array) -> Array:
    """Return the matrices (N, 3, 3) of upper triangles (N, 6) row by row."""
    return upper[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3)


def read(path: Path, kind: str) -> Trajectory:
    """Read a file; ``kind`` describes it in the error where that fails. Raises DataError as :func:`parse` does."""
    poses = parse(read_rows(path, kind))
    assert poses.t_ns is not None
    return Trajectory(poses.t_ns, poses.T_world_imu)


def text(trajectory: Trajectory) -> str:
    """Return a trajectory as the text of a file of states; poses that are not finite are left out.

    Velocity and biases that the trajectory does not have are nan.
    """
    kept = finite(trajectory)
    unknown = np.full((len(kept), 3), np.nan)
    v_world = unknown if kept.v_world is None else kept.v_world
    accel, gyro = (unknown, unknown) if kept.bias is None else (kept.bias[:, :3], kept.bias[:, 3:])
    quaternions = quaternion_from_rotation(kept.T_world_imu[:, :3, :3])
    values = np.hstack([quaternions, kept.positions, v_world, gyro, accel]).tolist()
    return rows_text(HEADER, zip(map(stamp_text, kept.t_ns.tolist()), values, strict=True), " ")
