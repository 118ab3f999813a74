"""The window at its one end: the newest state alone is a joint Kalman filter, and of `sliding-window` `iekf` (4 s).

Where the problem is linear it is the batch: test_linear_problems.py. At its other end, with all states in it, it
is the batch everywhere: test_infinite_lag.py.
"""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from filters import iekf, sliding_window
from tests.filters.conftest import short
from toolkit import runner
from toolkit.errors import EstimatorError
from toolkit.models.stereo_adjustment import lower_factor
from toolkit.settings import POLICIES, Settings, Window
from toolkit.simulation import DRIVE, FLIGHT, simulate

ONE_STATE = Window(most_states=1)


@pytest.fixture(scope="module")
def flown():
    """Return a function that runs estimators over a flight of full noise, without gates and losses."""
    sequence = short(FLIGHT, 1.0, 20, 3)

    @cache
    def run(build, **options):
        settings = Settings(outliers=POLICIES["none"], window=ONE_STATE, estimators={"one": options})
        return runner.run("one", build, sequence, sequence.prior, settings=settings).causal

    return run


def test_in_flight_the_newest_state_alone_with_invariant_marginals_is_the_iterated_filter(flown):
    """Held equal but for the velocity's coordinates, to second order. The filter stops at 1e-4 standard deviations."""
    filtered, smoothed = flown(iekf.build), flown(sliding_window.build)
    sigma = np.sqrt(np.diagonal(filtered.cov, axis1=1, axis2=2))
    assert np.abs(smoothed.positions - filtered.positions).max() < 1e-3 * sigma[:, 3:6].max()
    np.testing.assert_allclose(np.sqrt(np.diagonal(smoothed.cov, axis1=1, axis2=2)), sigma, rtol=1e-3)


def test_marginals_at_the_latest_estimates_gain_information_that_nothing_measured(flown):
    """Of the attitude, whose heading no camera observes; and without cross-covariances of the position as well."""
    sound, latest = (flown(sliding_window.build, marginals=kind).cov[-1] for kind in ("invariant", "latest"))
    decoupled = flown(sliding_window.build, cross_covariances=False).cov[-1]
    assert np.linalg.det(latest[:3, :3]) < 0.5 * np.linalg.det(sound[:3, :3])
    assert np.trace(decoupled[3:6, 3:6]) < 0.1 * np.trace(sound[3:6, 3:6])


@pytest.mark.parametrize(("most_steps", "told"), [(10, 0), (1, 1)])
def test_only_a_window_that_was_not_solved_to_its_minimum_is_told_once(most_steps, told, monkeypatch):
    """Under the default loss, whose weights change with every step."""
    monkeypatch.setattr(sliding_window, "_MOST_STEPS", most_steps)
    sequence = simulate(replace(DRIVE, duration_s=0.6), 0)
    done = runner.run("sliding-window", sliding_window.build, sequence, sequence.prior)
    assert done.status == "ok"
    assert sum("longer than two standard deviations" in line for line in done.log) == told


def test_a_gaussian_that_is_not_determined_cannot_lose_its_cross_covariances_and_says_so():
    with pytest.raises(EstimatorError, match=r"does not determine .* set cross_covariances to true"):
        sliding_window.without_cross_covariances(np.diag([1.0, 1.0, 0.0]), np.zeros(3), size=1)


def test_a_window_that_does_not_determine_its_states_says_so(monkeypatch):
    def refusing(matrix):
        raise np.linalg.LinAlgError("5-th leading minor")

    monkeypatch.setattr(sliding_window, "lower_factor", refusing)
    sequence = short(FLIGHT, 0.2, 20, 3)
    done = runner.run("sliding-window", sliding_window.build, sequence, sequence.prior)
    assert done.status == "failed"
    assert any("the window does not determine its states (5-th leading minor)" in line for line in done.log)


@pytest.mark.parametrize("damaged", ["information", "vector"])
def test_a_gaussian_with_nan_ends_the_run(damaged, monkeypatch):
    """LAPACK raises for neither: one is without a root, the other without a step that lowers the error."""
    keep = sliding_window.whole

    def with_nan(information, vector, size):
        parts = {"information": information.copy(), "vector": vector.copy()}
        parts[damaged].flat[0] = np.nan
        return keep(**parts, size=size)

    monkeypatch.setattr(sliding_window, "whole", with_nan)
    sequence = short(FLIGHT, 0.3, 20, 3)
    done = runner.run("one", sliding_window.build, sequence, sequence.prior, settings=Settings(window=ONE_STATE))
    assert done.status == "failed"
    assert "not a number" in done.log[0]


def test_a_factor_of_nan_is_none():
    with pytest.raises(np.linalg.LinAlgError, match="not finite"):
        lower_factor(np.array([[1.0, np.nan], [np.nan, 1.0]]))
