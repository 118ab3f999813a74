"""EuRoC: ``t,x,y,z,qw,qx,qy,qz`` between commas, whole nanoseconds and metres, Hamilton with the scalar first.

More columns may follow, as velocity and biases do in the data set's truth; they are not read. Burri et al., "The EuRoC
micro aerial vehicle datasets" (IJRR 2016).
"""

import numpy as np

from toolkit.datasets.io.fields import probable_unit_of_ns
from toolkit.datasets.trajectories.poses import OtherOrder, PosesFile, checked_poses, finite, rows_text
from toolkit.datasets.trajectories.rows import Rows
from toolkit.errors import DataError
from toolkit.estimate import Trajectory
from toolkit.geometry import quaternion_from_rotation

COLUMNS = "t,x,y,z,qw,qx,qy,qz"
HEADER = "#timestamp [ns],p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m],q_RS_w [],q_RS_x [],q_RS_y [],q_RS_z []"
W_LAST = OtherOrder(
    1, "w last", "the quaternions look w last; EuRoC's order is qw,qx,qy,qz: move the eighth column before the fifth"
)
_WIDTH = 8
_TO_XYZW = [0, 1, 2, 4, 5, 6, 3]


def recognises(rows: Rows) -> bool:
    """Say whether rows have the shape of this format."""
    return rows.commas and rows.width >= _WIDTH


def parse(rows: Rows) -> PosesFile:
    """Return the poses of rows.

    Raises DataError, naming the line and the likely cause, where they are not a table of numbers, time does not
    increase or is not in nanoseconds, or quaternions are not of unit length.
    """
    table = rows.numbers(rows.width, COLUMNS)
    t_ns = rows.stamps(1)
    unit = probable_unit_of_ns(table[:, 0])
    if unit is not None:
        hint = (
            "; a TUM file has blanks between its columns" if unit.startswith("seconds") and rows.width == _WIDTH else ""
        )
        raise DataError(f"{rows.path}: time must be in nanoseconds, but the stamps look like {unit}{hint}")
    T_world_imu = checked_poses(rows.path, rows.line_numbers, t_ns, table[:, 1:_WIDTH][:, _TO_XYZW])
    return PosesFile(rows.path, "EuRoC", t_ns, T_world_imu, W_LAST)


def text(trajectory: Trajectory) -> str:
    """Return a trajectory as the text of a file; poses that are not finite are left out."""
    kept = finite(trajectory)
    quaternions = np.roll(quaternion_from_rotation(kept.T_world_imu[:, :3, :3]), 1, axis=1)
    values = np.hstack([kept.positions, quaternions]).tolist()
    return rows_text(HEADER, zip(map(str, kept.t_ns.tolist()), values, strict=True), ",")
