"""The window at its one end: the newest state alone is a joint Kalman filter, and of `sliding-window` `iekf` (4 s).

At its other end, with all states in it, it is the batch: test_infinite_lag.py.
"""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from filters import fixed_lag, iekf, sliding_window
from tests.filters.conftest import BatchAtTruth, assert_covariances_agree, linear, recorded, short
from toolkit import runner
from toolkit.errors import EstimatorError
from toolkit.settings import POLICIES, Settings, Window
from toolkit.simulation import DRIVE, FLIGHT, simulate

SCENARIOS = [linear(DRIVE, 2.0, tracks=20), linear(FLIGHT, 0.8, tracks=20)]
ONE_STATE = Window(most_states=1)


def last_answer(recording, build, options):
    """Return the causal answer of a window of one state at the last frame of a recording."""
    setup = replace(recording.setup, settings=Settings(window=ONE_STATE), options=options)
    estimator = build(setup)
    return [estimator.step(packet) for packet in recording.sequence.packets()][-1]


@pytest.mark.parametrize("scenario", SCENARIOS, ids=lambda s: s.name)
@pytest.mark.parametrize(
    ("build", "options"),
    [
        (fixed_lag.build, {}),
        *((sliding_window.build, {"marginals": kind}) for kind in sliding_window.OPTIONS["marginals"]),
    ],
    ids=["first", *sliding_window.OPTIONS["marginals"]],
)
def test_on_a_linear_problem_one_state_is_enough_to_answer_as_the_batch(scenario, build, options):
    """As a joint Kalman filter: wherever it linearises, forgetting loses nothing. Errors and bounds are as there."""
    recording = recorded(scenario, 1e-4)
    last = recording.sequence.frame_count - 1
    mean, _ = BatchAtTruth(recording, recording.track_ids).state(last)
    assert np.abs(recording.error_of(last_answer(recording, build, options), last) - mean).max() < 1e-8
    assert np.abs(mean).max() > 1e-6, "there was something to agree on"
    exact = recorded(scenario, 1e-7)
    _, cov = BatchAtTruth(exact, exact.track_ids).state(last)
    assert_covariances_agree(last_answer(exact, build, options).cov, cov, 1e-5)


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
    assert sum("longer than one standard deviation" in line for line in done.log) == told


def test_a_gaussian_that_is_not_determined_cannot_lose_its_cross_covariances_and_says_so():
    with pytest.raises(EstimatorError, match=r"does not determine .* set cross_covariances to true"):
        sliding_window.without_cross_covariances(np.diag([1.0, 1.0, 0.0]), np.zeros(3), size=1)
