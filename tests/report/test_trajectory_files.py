"""TUM and CSV files lose nothing."""

from pathlib import Path

import numpy as np

from toolkit.datasets.trajectories import tum
from toolkit.estimate import Trajectory
from toolkit.experiment.comparison import Comparison
from toolkit.geometry import rotation_from_quaternion, se3, so3_exp


def test_a_tum_file_loses_nothing() -> None:
    rng = np.random.default_rng(5)
    t_ns = 1_600_000_000_000_000_000 + np.cumsum(rng.integers(1, 10**9, 200))
    poses = se3(so3_exp(rng.normal(size=(200, 3))), 1e3 * rng.normal(size=(200, 3)))
    lines = tum.text(Trajectory(t_ns, poses)).splitlines()[1:]
    stamps = [int(line.split()[0].replace(".", "")) for line in lines]
    values = np.array([line.split()[1:] for line in lines], dtype=float)
    assert stamps == t_ns.tolist()
    # 15 significant digits of positions of some km: 1e-11 m; a quaternion's 1e-15 grows a little in the rotation.
    np.testing.assert_allclose(values[:, :3], poses[:, :3, 3], rtol=1e-14)
    np.testing.assert_allclose(rotation_from_quaternion(values[:, 3:]), poses[:, :3, :3], atol=1e-14)


def test_the_landmarks_of_a_run_directory_lose_nothing(comparison: Comparison, run_directory: Path) -> None:
    for run in comparison.runs[:3]:
        read = np.loadtxt(run_directory / f"landmarks/{run.estimator}.csv", delimiter=",", skiprows=1)
        np.testing.assert_array_equal(read[:, 0], run.landmarks.track_ids)
        np.testing.assert_allclose(read[:, 1:], run.landmarks.points_world, rtol=1e-14)
