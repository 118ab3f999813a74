"""Every setting of windows and outliers reaches the estimators it is for, and no other."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from toolkit import runner
from toolkit.estimate import Run
from toolkit.estimator import find
from toolkit.settings import Outliers, Settings, Window
from toolkit.simulation import DRIVE, DRIVE_IMU, simulate

SCENARIOS = {"drive": DRIVE, "drive-imu": DRIVE_IMU}


@cache
def answer(name: str, part: Window | Outliers = Window(), scenario: str = "drive") -> Run:  # noqa: B008 - frozen
    """Run an estimator over three seconds in which one sighting in a hundred is of another point."""
    settings = Settings(window=part) if isinstance(part, Window) else Settings(outliers=part)
    of = SCENARIOS[scenario]
    camera = replace(of.camera, outlier_rate=0.01, max_tracks=40)
    sequence = simulate(replace(of, duration_s=3.0, camera=camera), 6)
    assert sequence.prior is not None
    run = runner.run(name, find(name).load(), sequence, sequence.prior, settings=settings)
    assert run.final is not None, run.log
    return run


def same(one: Run, other: Run) -> bool:
    return np.array_equal(one.final.T_world_imu, other.final.T_world_imu)


@pytest.mark.parametrize(
    ("part", "moved", "unmoved"),
    [
        (Window(lag_s=0.5), {"fixed-lag", "smart"}, {"msckf", "isam2"}),
        (Window(twist_clones=3), {"msckf", "msckf-fej", "msckf-slam"}, {"ekf-slam", "smart"}),
        (Window(imu_clones=3), set(), {"msckf", "msckf-fej", "msckf-slam"}),
        (Window(landmarks=5), {"msckf-slam"}, {"msckf-fej"}),
        (Outliers(gate_probability=0.5), {"ekf", "ekf-slam", "msckf"}, {"seed-ekf", "mapping"}),
        (Outliers(filter_huber=0.5), {"ekf"}, {"msckf", "fixed-lag", "seed-ekf"}),
        (Outliers(smoother_huber=0.5), {"fixed-lag", "smart", "isam2"}, {"ekf"}),
        (Outliers(batch_huber=0.3), {"batch"}, {"isam2"}),
        (Outliers(batch_cauchy=0.1), {"batch"}, {"isam2"}),
        (Outliers(batch_cut_probability=0.3), {"batch"}, {"isam2"}),
    ],
    ids=[
        "lag",
        "twist clones",
        "imu clones",
        "landmarks",
        "gate",
        "filter huber",
        "smoother huber",
        "batch huber",
        "batch cauchy",
        "batch cut",
    ],
)
def test_a_setting_moves_the_estimators_it_is_for_alone(part, moved, unmoved):
    assert {name for name in moved | unmoved if not same(answer(name), answer(name, part))} == moved


def test_the_clones_of_raw_imu_samples_are_a_setting_of_their_own():
    shorter = Window(imu_clones=3)
    assert not same(answer("msckf", scenario="drive-imu"), answer("msckf", shorter, "drive-imu"))


def test_without_long_lived_landmarks_msckf_slam_is_msckf_fej():
    assert same(answer("msckf-slam", Window(landmarks=0)), answer("msckf-fej"))


@pytest.mark.parametrize("outliers", [Outliers(batch_huber=0.2), Outliers(batch_cauchy=0.2)], ids=["huber", "cauchy"])
def test_the_losses_of_batch_decide_how_it_gets_there_and_hardly_where(outliers):
    """The last solve is without a loss; another way to it may leave a doubtful sighting out or in."""
    default, other = answer("batch"), answer("batch", outliers)
    assert not same(default, other)
    assert np.abs(default.final.positions - other.final.positions).max() < 0.02
