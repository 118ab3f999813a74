"""TUM and CSV files lose nothing."""

from pathlib import Path

import numpy as np

from toolkit.estimate import Landmarks, Trajectory
from toolkit.geometry import rotation_from_quaternion, se3, so3_exp
from toolkit.report.trajectory_files import write_landmarks, write_tum


def test_tum_round_trip(tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    t_ns = 1_600_000_000_000_000_000 + np.cumsum(rng.integers(1, 10**9, 200))
    poses = se3(so3_exp(rng.normal(size=(200, 3))), 1e3 * rng.normal(size=(200, 3)))
    write_tum(Trajectory(t_ns, poses), tmp_path / "a.tum")

    lines = (tmp_path / "a.tum").read_text().splitlines()[1:]
    stamps = [int(line.split()[0].replace(".", "")) for line in lines]
    values = np.array([line.split()[1:] for line in lines], dtype=float)
    assert stamps == t_ns.tolist()
    # 15 significant digits of positions of some km: 1e-11 m; a quaternion's 1e-15 grows a little in the rotation.
    np.testing.assert_allclose(values[:, :3], poses[:, :3, 3], rtol=1e-14)
    np.testing.assert_allclose(rotation_from_quaternion(values[:, 3:]), poses[:, :3, :3], atol=1e-14)


def test_landmarks_round_trip(tmp_path: Path) -> None:
    points = np.random.default_rng(1).normal(size=(7, 3))
    write_landmarks(Landmarks(np.arange(7) * 3, points), tmp_path / "l.csv")
    read = np.loadtxt(tmp_path / "l.csv", delimiter=",", skiprows=1)
    np.testing.assert_array_equal(read[:, 0], np.arange(7) * 3)
    np.testing.assert_allclose(read[:, 1:], points, rtol=1e-14)
