"""Trajectories as TUM files (``t x y z qx qy qz qw``) and landmarks as CSV, exact to the nanosecond and 15 digits."""

import math
from pathlib import Path

from toolkit.cutting import NS_PER_S
from toolkit.estimate import Landmarks, Trajectory
from toolkit.geometry import quaternion_from_rotation

TUM_HEADER = "# t_s x_m y_m z_m qx qy qz qw: the IMU in the world; quaternions are Hamilton, scalar last"


def stamp_text(t_ns: int) -> str:
    """Write nanoseconds as seconds with nine decimals; goes through integers, for a double holds only 16 digits."""
    sign, (seconds, rest_ns) = "-" if t_ns < 0 else "", divmod(abs(t_ns), NS_PER_S)
    return f"{sign}{seconds}.{rest_ns:09d}"


def tum_text(trajectory: Trajectory) -> str:
    """Return a trajectory as the text of a TUM file; poses that are not finite are left out, as readers reject them."""
    quaternions = quaternion_from_rotation(trajectory.T_world_imu[:, :3, :3])
    lines = [TUM_HEADER]
    for t_ns, position, quaternion in zip(
        trajectory.t_ns.tolist(), trajectory.positions.tolist(), quaternions.tolist(), strict=True
    ):
        values = (*position, *quaternion)
        if all(map(math.isfinite, values)):
            lines.append(" ".join((stamp_text(t_ns), *(f"{value:.15g}" for value in values))))
    return "\n".join(lines) + "\n"


def write_tum(trajectory: Trajectory, path: Path) -> None:
    """Write a trajectory as a TUM file."""
    path.write_text(tum_text(trajectory), encoding="utf-8")


def write_landmarks(landmarks: Landmarks, path: Path) -> None:
    """Write landmarks as CSV, one a row: track id and position in the world in metres."""
    rows = zip(landmarks.track_ids.tolist(), landmarks.points_world.tolist(), strict=True)
    lines = [f"{track_id},{x:.15g},{y:.15g},{z:.15g}" for track_id, (x, y, z) in rows]
    path.write_text("\n".join(["track_id,x_m,y_m,z_m", *lines]) + "\n", encoding="utf-8")
