"""A sweep: its ratios are paired by seed, runs that end badly count, and where estimators break. 2 s."""

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import msgspec
import numpy as np
import pytest

from toolkit.experiment.grid import Grid, Trial
from toolkit.experiment.pipeline import Plan
from toolkit.experiment.recording import Recording, found_where_planted, prepare
from toolkit.experiment.statistics import Interval
from toolkit.experiment.sweep import CLEAN, Axis, Point, Sweep, run_sweep
from toolkit.experiment.units import Outcome, Scored
from toolkit.metrics import Scores
from toolkit.registry import find
from toolkit.report.sweep import sweep_document, sweep_table
from toolkit.settings import SettingsError
from toolkit.settings.reading import settings_of

SEEDS = 6
FRAMES = "fault:dropped_frames"


def outcome(seed: int, ate_m: float | None, drift_m: np.ndarray | None = None) -> Outcome:
    """Return the outcome of a run with an error, or of one that failed."""
    if ate_m is None:
        return Outcome(seed, "ekf", "failed")
    values = {
        "ate_yaw_m": ate_m,
        "nees_pose_mean": 2.0 * ate_m,
        "heldout_reproj_median_px": 1.0,
        "frame_cpu_ms_mean": 1.0,
    }
    stretches = {} if drift_m is None else {"drift_m": drift_m, "heldout_px": np.full(40, 0.5)}
    scored = Scored(Scores(values, {}), np.full(5, 1.0), np.full(5, np.nan), **stretches)
    return Outcome(seed, "ekf", "ok", {"causal": scored, "final": scored})


@pytest.fixture
def plan() -> Plan:
    return Plan(("drive",), ("ekf",), settings=settings_of({"seeds": SEEDS}, "here"))


def sweep_of(plan: Plan, axis: Axis, outcomes: Mapping[Point, list[Outcome]]) -> Sweep:
    """Return a sweep with given outcomes."""
    prepared = prepare(Recording("drive", 0, duration_s=2.0))
    trials = {
        Trial.of("ekf", {}, {name.removeprefix("fault:"): value for name, value in point}): tuple(given)
        for point, given in outcomes.items()
    }
    return Sweep(Grid(plan, prepared, trials), (axis,), tuple(outcomes), {})


def over_doses(plan: Plan, axis: Axis, ratios: list[float | None], scatter: float = 0.0) -> Sweep:
    """Return a sweep whose error is the ratio times that of the clean recording, with some scatter by seed."""
    rng = np.random.default_rng(1)
    clean = rng.uniform(0.5, 2.0, SEEDS)
    outcomes = {CLEAN: [outcome(seed, clean[seed]) for seed in range(SEEDS)]}
    for point, ratio in zip(axis.points, ratios, strict=True):
        off = np.exp(scatter * rng.standard_normal(SEEDS))
        outcomes[point] = [outcome(k, None if ratio is None else ratio * clean[k] * off[k]) for k in range(SEEDS)]
    return sweep_of(plan, axis, outcomes)


def test_ratios_are_paired_by_seed(plan):
    axis = Axis.of(FRAMES, [0.1, 0.2], plan)
    effect = over_doses(plan, axis, [1.3, 2.0]).effects["ekf", axis.points[0]]
    assert effect.over_clean == pytest.approx((1.3, 1.3, 1.3))  # though clean errors scatter fourfold
    assert effect.nees is not None and effect.nees.high > 1.2 * effect.nees.low


def test_a_dose_whose_effect_is_unknown_is_not_one_that_an_estimator_survives(plan):
    axis = Axis.of(FRAMES, [0.2, 0.4], plan)
    document = sweep_document(over_doses(plan, axis, [1.0, 1.5]))
    unknown = [
        msgspec.structs.replace(one, over_clean=one.over_clean if one.at.get(FRAMES) != 0.4 else None)
        for one in document.effects
    ]
    told = [sweep_table(one).rows[-1] for one in (document, msgspec.structs.replace(document, effects=tuple(unknown)))]
    assert [row[1] for row in told] == ["breaks at"] * 2
    assert [row[-1] for row in told] == [">0.400", "-"]


def test_an_estimator_breaks_where_it_passes_three_times_clean(plan):
    axis = Axis.of(FRAMES, [0.2, 0.4, 0.8], plan)
    (exact,) = over_doses(plan, axis, [1.0, 1.5, 6.0]).breaking
    assert exact.dose == pytest.approx(0.4 + 0.4 * math.log(2.0) / math.log(4.0))  # by the logarithm of the error
    assert (exact.low, exact.high) == pytest.approx((exact.dose, exact.dose))
    (scattered,) = over_doses(plan, axis, [1.0, 1.5, 6.0], scatter=0.3).breaking
    assert scattered.low is not None and scattered.dose is not None and scattered.high is not None
    assert 0.2 < scattered.low < scattered.dose < scattered.high <= 0.8
    (never,) = over_doses(plan, axis, [1.0, 1.1, 1.2]).breaking
    assert (never.dose, never.low, never.high, never.tried) == (None, None, None, 0.8)


def test_a_run_that_ends_badly_is_infinitely_bad(plan):
    axis = Axis.of(FRAMES, [0.2, 0.4], plan)
    sweep = over_doses(plan, axis, [1.1, None])
    assert sweep.effects["ekf", axis.points[1]].over_clean == Interval(math.inf, math.inf, math.inf)
    assert sweep.breaking[0].dose == pytest.approx(0.3)  # between the doses that were run, no more is known
    assert (sweep.breaking[0].low, sweep.breaking[0].high) == pytest.approx((0.2, 0.4))
    outcomes = dict(sweep.grid.outcomes)
    trial = list(outcomes)[1]
    outcomes[trial] = (outcome(0, None), *outcomes[trial][1:])
    one_bad = replace(sweep, grid=replace(sweep.grid, outcomes=outcomes)).effects["ekf", axis.points[0]]
    assert one_bad.over_clean == pytest.approx((1.1, 1.1, math.inf))
    assert (one_bad.ok, one_bad.runs) == (SEEDS - 1, SEEDS)


def test_doses_on_both_sides_of_the_clean_one_break_apart(plan):
    axis = Axis.of("fault:wrong_noise", [4.0, 0.25, 1.0, 0.5, 2.0], plan)
    assert (axis.clean, axis.values) == (1.0, (0.25, 0.5, 2.0, 4.0))
    below, above = over_doses(plan, axis, [9.0, 1.0, 1.0, 1.0]).breaking
    assert below.dose == pytest.approx(0.5 * 0.5**0.5)  # a factor by its logarithm
    assert (below.tried, above.tried, above.dose) == (0.25, 4.0, None)


def test_a_recording_without_seeds_is_compared_over_its_stretches(plan):
    once = replace(plan, settings=settings_of({}, "here"))
    axis, rng = Axis.of(FRAMES, [0.2], once), np.random.default_rng(2)
    clean = np.abs(rng.standard_normal(40))
    worse = 2.0 * clean * np.exp(0.2 * rng.standard_normal(40))
    worse[3] = np.nan
    outcomes = {CLEAN: [outcome(0, 1.0, clean)], axis.points[0]: [outcome(0, 7.0, worse)]}
    ratio = sweep_of(once, axis, outcomes).effects["ekf", axis.points[0]].over_clean
    assert 1.7 < ratio.low < 2.0 < ratio.high < 2.4
    outcomes[axis.points[0]] = [outcome(0, None)]
    assert sweep_of(once, axis, outcomes).effects["ekf", axis.points[0]].over_clean == Interval(*[math.inf] * 3)


def test_the_audit_names_what_was_planted_and_nothing_of_the_clean_recording():
    recording = Recording("drive", 1, duration_s=12.0, faults=(("camera_clock", 0.05),))
    assert found_where_planted(recording) == ("time-offset",)
    assert found_where_planted(replace(recording, faults=())) == ()


@pytest.fixture
def short(two_seconds: None, plan: Plan) -> Plan:
    settings = settings_of({"seeds": 2}, "here")
    return replace(plan, estimators=("dead-reckoning",), settings=settings, max_frames=12, workers=1)


def test_two_axes_are_crossed_or_each_is_varied_by_itself(short, tmp_path):
    over: dict[str, list[Any]] = {FRAMES: [0.5], "noise.motion_scale": [2.0, 4.0]}
    crossed = run_sweep(short, over, crossed=True, directory=tmp_path)
    assert len(crossed.points) == 2 * 3
    both = (*crossed.axes[0].points[0], *crossed.axes[1].points[1])
    assert both in crossed.points
    each = run_sweep(short, over, crossed=False, directory=tmp_path)
    assert len(each.points) == 1 + 1 + 2
    for point in each.points:
        assert each.effects["dead-reckoning", point] == crossed.effects["dead-reckoning", point]
    rows = [row for row in crossed.records() if row["metric"] == "ate_none_m" and row["output"] == "final"]
    assert len(rows) == len(crossed.points) * 2
    assert {(row[FRAMES], row["noise.motion_scale"]) for row in rows} == {
        (lost, scale) for lost in (0.0, 0.5) for scale in ("auto", 2.0, 4.0)
    }


def test_functions_of_ones_own_are_swept_beside_what_is_named(short):
    mixed = replace(short, own={"mine": find("dead-reckoning").load()})
    swept = run_sweep(mixed, {FRAMES: [0.5]}, crossed=True)
    assert swept.estimators == ("dead-reckoning", "mine")
    one, same = (swept.effects[name, swept.points[1]] for name in swept.estimators)
    assert (one.over_clean, one.nees) == (same.over_clean, same.nees)


# What an advice mends is in tests/cli/test_advice.py.
@pytest.mark.parametrize(
    ("over", "what"),
    [
        ({"fault:fog": [1.0]}, "fog"),
        ({FRAMES: [0.0]}, "no value to vary it over"),
        ({"window.lag": [1.0]}, "no setting window.lag"),
        ({"seeds": [3]}, "seeds: a sweep sets it itself, or no run depends on it"),
    ],
)
def test_what_cannot_be_swept_is_told_in_a_line(short, over, what):
    with pytest.raises(SettingsError, match=what):
        run_sweep(short, over, crossed=True)
