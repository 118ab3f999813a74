"""Every setting of windows and outliers reaches the estimators it is for, and no other."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from toolkit import runner
from toolkit.answers import Run
from toolkit.registry import find, ladder
from toolkit.sequence import Sequence
from toolkit.settings import Noise, Outliers, Settings, Window
from toolkit.simulation import DRIVE, FLIGHT, simulate

WINDOWED = {"msckf", "msckf-fej", "msckf-slam", "fixed-lag", "sliding-window", "smart"}


@cache
def recording() -> Sequence:
    """Return a second and a half in which one sighting in a hundred is of another point."""
    camera = replace(DRIVE.camera, outlier_rate=0.01, max_tracks=40)
    return simulate(replace(DRIVE, duration_s=1.4, camera=camera), 6)


@cache
def answer(name: str, part: Window | Outliers = Window()) -> Run:  # noqa: B008 - frozen
    """Run an estimator over the recording, once for each choice."""
    settings = Settings(window=part) if isinstance(part, Window) else Settings(outliers=part)
    sequence = recording()
    run = runner.run(name, find(name).load(), sequence, sequence.prior, settings=settings)
    assert run.final is not None, run.log
    return run


def same(one: Run, other: Run) -> bool:
    poses, points = (one.final.T_world_imu, other.final.T_world_imu), (one.landmarks, other.landmarks)
    return np.array_equal(*poses) and np.array_equal(*(landmarks.points_world for landmarks in points))


@pytest.mark.parametrize(
    ("part", "moved", "unmoved"),
    [
        (Window(lag_s=0.5), WINDOWED, {"ekf-slam", "isam2"}),
        (Window(most_states=4), WINDOWED, {"ekf-slam", "isam2"}),
        (Window(landmarks=5), {"msckf-slam"}, {"msckf-fej"}),
        (
            Outliers(gate_probability=0.5),
            {"mapping", "ekf", "ekf-slam", "msckf", "fixed-lag", "smart", "isam2"},
            {"seed-ekf"},
        ),
        (Outliers(smoother_gate_factor=9.0), {"fixed-lag", "smart", "isam2"}, {"msckf", "batch"}),
        (Outliers(joint_huber=0.5), {"ekf-slam", "riekf", "iekf", "msckf", "msckf-slam"}, {"ekf", "fixed-lag"}),
        (Outliers(filter_huber=0.5), {"ekf"}, {"msckf", "fixed-lag", "seed-ekf"}),
        (Outliers(smoother_huber=0.5), {"fixed-lag", "smart", "isam2"}, {"ekf"}),
        (Outliers(batch_huber=0.3), {"batch"}, {"isam2"}),
        (Outliers(batch_cauchy=0.1), {"batch"}, {"isam2"}),
        (Outliers(batch_cut_probability=0.3), {"batch"}, {"isam2"}),
        (Outliers(batch_last_huber=0.5), {"batch"}, {"isam2"}),
    ],
)
def test_a_setting_moves_the_estimators_it_is_for_alone(part, moved, unmoved):
    assert {name for name in moved | unmoved if not same(answer(name), answer(name, part))} == moved


def test_without_long_lived_landmarks_msckf_slam_is_msckf_fej():
    assert same(answer("msckf-slam", Window(landmarks=0)), answer("msckf-fej"))


@pytest.mark.parametrize("outliers", [Outliers(batch_huber=0.2), Outliers(batch_cauchy=0.2)], ids=["huber", "cauchy"])
def test_the_losses_of_batch_decide_how_it_gets_there_and_hardly_where(outliers):
    """The last solve is without a loss; another way to it may leave a doubtful sighting out or in."""
    default, other = answer("batch"), answer("batch", outliers)
    assert not same(default, other)
    assert np.abs(default.final.positions - other.final.positions).max() < 0.02


@cache
def flown() -> Sequence:
    return simulate(replace(FLIGHT, duration_s=0.5, camera=replace(FLIGHT.camera, max_tracks=25)), 2)


@pytest.mark.parametrize("name", [one.name for one in ladder() if "biases" in one.ingredients()])
@pytest.mark.parametrize("sequence", [recording, flown], ids=["twists", "imu"])
def test_fixed_biases_stay_where_they_start(name, sequence):
    """Theirs is a thousandth of the start's standard deviation, for filter and smoother alike (2 s)."""
    prior = sequence().prior
    sigma = np.sqrt(np.diag(prior.cov))[12:]
    settings = Settings(noise=Noise(biases="fixed"))
    run = runner.run(name, find(name).load(), sequence(), prior, settings=settings)
    assert run.status == "ok", run.log
    assert (np.abs(run.final.bias[:, 3:] - prior.bias[3:]) < 0.01 * sigma).all()
    stated = np.sqrt(np.diagonal(run.final.cov, axis1=1, axis2=2))[:, -3:]
    assert (stated < 0.002 * sigma).all()
