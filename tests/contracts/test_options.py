"""Options that estimators declare with their values: each value is taken, and changes what the estimator answers (2 s).

What an estimator says that it has of what estimators differ in can be taken away as it says.
"""

from dataclasses import replace

import numpy as np
import pytest

from toolkit import runner
from toolkit.errors import EstimatorError
from toolkit.registry import discover, find
from toolkit.settings import DEFAULTS
from toolkit.settings.reading import settings_of
from toolkit.simulation import FLIGHT, simulate

OPTIONS = [(name, option) for name, entry in discover().items() for option, values in entry.options().items() if values]


@pytest.fixture(scope="module")
def sequence():
    # So short a window that states leave it.
    return simulate(replace(FLIGHT, duration_s=0.6), 0)


def answered(name, sequence, options):
    settings = settings_of({"window": {"lag_s": 0.2}, "estimators": {name: options}}, "here")
    find(name).check_options(settings)
    run = runner.run(name, find(name).load(), sequence, sequence.prior, settings=settings)
    assert run.status == "ok", run.log
    trajectory = run.final or run.causal
    return np.concatenate([trajectory.T_world_imu.ravel(), trajectory.cov.ravel()])


@pytest.mark.parametrize(("name", "option"), OPTIONS, ids=map("-".join, OPTIONS))
def test_the_first_value_of_an_option_is_its_default_and_every_other_changes_the_answer(name, option, sequence):
    first, *others = find(name).options()[option]
    usual = answered(name, sequence, {})
    np.testing.assert_array_equal(answered(name, sequence, {option: first}), usual)
    for value in others:
        assert np.abs(answered(name, sequence, {option: value}) - usual).max() > 1e-12


@pytest.mark.parametrize(
    ("name", "options", "expected"),
    [
        ("ekf-slam", {"linearisation": "frist"}, "option linearisation is 'frist'; it takes first or latest"),
        ("ekf", {"landmark_uncertainty": 3}, "option landmark_uncertainty is 3; it takes true or false"),
        ("ekf-slam", {"linearization": 1}, "has no option linearization; it has landmarks, linearisation"),
        ("batch", {"landmark_uncertainty": True}, "has no option landmark_uncertainty; it has none; ekf has it"),
    ],
)
def test_an_option_or_a_value_that_there_is_not_is_refused_with_those_there_are(name, options, expected):
    with pytest.raises(EstimatorError, match=expected):
        find(name).check_options(settings_of({"estimators": {name: options}}, "here"))


def test_what_takes_an_ingredient_away_is_a_setting_that_exists():
    for name, entry in discover().items():
        for settings in entry.ingredients().values():
            for key, value in settings.items():
                if key == "output":
                    assert value == "causal"
                elif "." in key:
                    section, _, own = key.partition(".")
                    assert hasattr(getattr(DEFAULTS, section), own), (name, key)
                else:
                    assert value in entry.options()[key][1:], (name, key)
