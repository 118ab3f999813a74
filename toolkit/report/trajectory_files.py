"""Trajectories as TUM files and landmarks as CSV, exact to the nanosecond and 15 digits."""

from pathlib import Path

from toolkit.datasets.trajectories import tum
from toolkit.estimate import Landmarks, Trajectory


def write_tum(trajectory: Trajectory, path: Path) -> None:
    """Write a trajectory as a TUM file."""
    path.write_text(tum.text(trajectory), encoding="utf-8")


def write_landmarks(landmarks: Landmarks, path: Path) -> None:
    """Write landmarks as CSV, one a row: track id and position in the world in metres."""
    rows = zip(landmarks.track_ids.tolist(), landmarks.points_world.tolist(), strict=True)
    lines = [f"{track_id},{x:.15g},{y:.15g},{z:.15g}" for track_id, (x, y, z) in rows]
    path.write_text("\n".join(["track_id,x_m,y_m,z_m", *lines]) + "\n", encoding="utf-8")
