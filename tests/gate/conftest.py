"""A baseline made up for the tests, and ways to change what is measured against it."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from msgspec import structs

from toolkit.gate.baseline import COVERAGE, DEFAULT_BOUNDS, Baseline, Case, Measured, SeriesRecord, installed_releases
from toolkit.gate.checking import CaseVerdicts, CheckTerms, check_all, check_case
from toolkit.gate.verdict import Check

SEEDS = tuple(range(24))
ESTIMATORS = ("one", "two", "three")
SPREAD = 0.03

Edit = Callable[[str, str, np.ndarray], np.ndarray]


def series(rng: np.random.Generator, count: int, keys: tuple[str, ...]) -> SeriesRecord:
    values = {key: tuple(np.exp(rng.normal(-2.0, 0.4, count)).tolist()) for key in keys}
    if "nees_pose_mean" in keys:
        values["nees_pose_mean"] = tuple(np.exp(rng.normal(1.5, 0.3, count)).tolist())
    values[COVERAGE] = (100.0,) * count
    speed = tuple(rng.normal(5.0, 0.2, count).tolist())
    return SeriesRecord(status=("ok",) * count, speed=speed, causal=values)


@pytest.fixture
def baseline() -> Baseline:
    rng = np.random.default_rng(5)
    simulated = Case("flight", True, SEEDS, ESTIMATORS, 2.5)
    recorded = Case("data/drive_small", False, (0,), ESTIMATORS)
    measured = []
    for case, keys in ((simulated, DEFAULT_BOUNDS.simulated), (recorded, DEFAULT_BOUNDS.recorded)):
        runs = {name: series(rng, len(case.seeds), tuple(keys)) for name in ESTIMATORS}
        hashes = tuple(f"{case.source}-{seed:064d}" for seed in case.seeds)
        measured.append((case, Measured(hashes, tuple(f"{seed:016d}" for seed in case.seeds), runs)))
    return Baseline(installed_releases(), tuple(measured))


def edited(measured: Measured, edit: Edit) -> Measured:
    """Return what is measured with every metric's values changed by ``edit(estimator, metric, values)``."""
    runs = {
        name: structs.replace(
            one,
            **{
                output: {
                    key: tuple(edit(name, key, np.array(values)).tolist()) if key != COVERAGE else values
                    for key, values in metrics.items()
                }
                for output, metrics in one.outputs.items()
            },
        )
        for name, one in measured.runs.items()
    }
    return replace(measured, runs=runs)


def checked(baseline: Baseline, now: list[Measured], *, speed: bool = True, accept_better: bool = False) -> Check:
    """Judge measurements that were never made against a baseline."""
    every, terms = CaseVerdicts(), CheckTerms(speed, accept_better)
    for (case, before), after in zip(baseline.cases, now, strict=True):
        every.add(check_case(case, before, after, baseline.bounds, terms))
    return check_all(every, baseline, "made-up.json", 1.0, terms)


def as_measured(baseline: Baseline) -> list[Measured]:
    return [measured for _, measured in baseline.cases]


def planted(percent: float, seed: int, estimator: str = "two", metric: str = "ate_se3_m") -> Edit:
    """Return an edit: noise on everything, and one metric of one estimator worse by so many percent."""
    rng = np.random.default_rng(seed)

    def edit(name: str, key: str, values: np.ndarray) -> np.ndarray:
        factor = 1.0 + percent / 100.0 if (name, key) == (estimator, metric) else 1.0
        return np.asarray(values * factor * np.exp(rng.normal(0.0, SPREAD, values.size)))

    return edit


def as_another_trajectory(measured: Measured) -> Measured:
    """Return what is measured with every metric moved by a hundred-thousandth, as by poses that are not the same."""
    return edited(measured, lambda _name, _key, values: values * (1.0 + 1e-5))
