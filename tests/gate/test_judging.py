"""What the gate fails for, and what it lets pass."""

from dataclasses import replace

import numpy as np
import pytest

from toolkit.gate.baseline import COVERAGE


def findings(check):
    return [(v.sequence, v.estimator, v.metric, v.finding) for v in check.failures]


def with_series(measured, estimator, **changes):
    return replace(measured, runs=measured.runs | {estimator: replace(measured.runs[estimator], **changes)})


def with_values(measured, estimator, key, values):
    outputs = {"causal": measured.runs[estimator].outputs["causal"] | {key: values}}
    return with_series(measured, estimator, outputs=outputs)


def test_identical_results_pass_and_every_difference_is_zero(baseline, gate):
    check = gate.judged(baseline, gate.as_measured(baseline))
    assert check.passed
    assert check.tests == 3 * 4  # estimators times metrics, on the simulated sequence
    assert {v.finding for v in check.verdicts} == {"same"}
    assert {v.change_percent for v in check.verdicts} <= {0.0, None}
    assert {v.p for v in check.verdicts} == {1.0, None}
    assert check.notes == ()


@pytest.mark.parametrize("metric", ["ate_se3_m", "ate_yaw_m", "heldout_reproj_median_px"])
def test_a_planted_regression_fails_and_nothing_else_does(baseline, gate, metric):
    simulated, recorded = gate.as_measured(baseline)
    check = gate.judged(baseline, [gate.edited(simulated, gate.planted(5.0, 1, metric=metric)), recorded])
    assert findings(check) == [("flight", "two", metric, "regressed")]
    assert check.failures[0].p < 0.05
    assert check.failures[0].change_percent == pytest.approx(5.0, abs=2.0)


def test_an_improvement_is_shown_and_passes(baseline, gate):
    simulated, recorded = gate.as_measured(baseline)
    check = gate.judged(baseline, [gate.edited(simulated, gate.planted(-10.0, 1)), recorded])
    assert check.passed
    assert [(v.estimator, v.metric) for v in check.verdicts if v.finding == "better"] == [("two", "ate_se3_m")]


def test_a_change_within_the_margin_passes_however_certain(baseline, gate):
    simulated, recorded = gate.as_measured(baseline)
    for factor, passes in ((1.004, True), (1.006, False)):
        check = gate.judged(baseline, [gate.edited(simulated, lambda _n, _k, v, f=factor: v * f), recorded])
        ate = [v for v in check.verdicts if v.metric == "ate_se3_m" and v.sequence == "flight"]
        assert all(v.finding == ("same" if passes else "regressed") for v in ate)


def test_noise_alone_raises_an_alarm_no_more_often_than_stated(baseline, gate):
    simulated, recorded = gate.as_measured(baseline)
    checks = 300
    alarms = sum(
        not gate.judged(baseline, [gate.edited(simulated, gate.planted(0.0, seed)), recorded]).passed
        for seed in range(checks)
    )
    # 15 are promised at most; three standard deviations above that.
    assert alarms <= 15 + 3.0 * np.sqrt(15.0)


@pytest.mark.parametrize(
    ("was", "now", "fails"),
    [
        (4.0, 4.4, True),  # too sure of itself, and more so
        (4.0, 3.6, False),  # nearer to honest
        (0.30, 0.27, True),  # timid, and more so
        (0.30, 0.33, False),
        (0.95, 1.05, False),  # within the band of 24 runs
        (1.0, 1.6, True),  # out of it
        (0.4, 1.1, False),  # into it
        (3.0, 0.2, True),  # through it, and farther out than before
        (3.0, 0.6, False),  # through it, and nearer
    ],
)
def test_consistency_is_worse_farther_from_its_band_on_either_side(baseline, gate, was, now, fails):
    simulated, recorded = gate.as_measured(baseline)
    rng = np.random.default_rng(9)
    scatter = np.exp(0.1 * rng.standard_normal(len(gate.seeds)))
    before = with_values(simulated, "two", "nees_pose_mean", tuple((was * scatter).tolist()))
    moved = now * scatter * np.exp(0.02 * rng.standard_normal(scatter.size))
    after = with_values(simulated, "two", "nees_pose_mean", tuple(moved.tolist()))
    of_then = replace(baseline, cases=((baseline.cases[0][0], before), baseline.cases[1]))
    check = gate.judged(of_then, [after, recorded])
    assert findings(check) == ([("flight", "two", "nees_pose_mean", "regressed")] if fails else [])


@pytest.mark.parametrize(
    ("metric", "factor", "finding"),
    [
        ("ate_se3_m", 1.0 + 1e-8, "same"),
        ("ate_se3_m", 1.0 + 1e-4, "worse"),
        ("ate_se3_m", 1.0 - 1e-4, "better"),
        ("ate_se3_m", 1.049, "worse"),
        ("ate_se3_m", 1.051, "regressed"),
        ("heldout_reproj_median_px", 1.021, "regressed"),
        ("nis_mean", 1.0 / 1.11, "regressed"),  # the made-up values are below 1: less is farther from it
        ("nis_mean", 1.11, "better"),
    ],
)
def test_a_recording_shows_any_change_and_fails_beyond_its_bound(baseline, gate, metric, factor, finding):
    simulated, recorded = gate.as_measured(baseline)
    changed = gate.edited(recorded, lambda n, key, v: v * factor if (n, key) == ("two", metric) else v)
    check = gate.judged(baseline, [simulated, changed])
    one = next(v for v in check.verdicts if (v.sequence, v.estimator, v.metric) == ("data/drive_small", "two", metric))
    assert one.finding == finding
    assert check.passed == (finding != "regressed")


def test_a_missing_estimator_fails(baseline, gate):
    simulated, recorded = gate.as_measured(baseline)
    left = {name: one for name, one in simulated.runs.items() if name != "two"}
    gone = replace(simulated, runs=left, absent={"two": "no estimator is called two"})
    check = gate.judged(baseline, [gone, recorded])
    assert findings(check) == [("flight", "two", "estimator", "missing")]
    assert check.failures[0].words == "no estimator is called two"


def test_a_missing_sequence_fails(baseline, gate):
    simulated, recorded = gate.as_measured(baseline)
    check = gate.judged(baseline, [simulated, replace(recorded, runs={}, unreadable="no such file")])
    assert findings(check) == [("data/drive_small", "", "sequence", "missing")]


@pytest.mark.parametrize("gone", ["everywhere", "under one seed"])
def test_a_missing_metric_fails(baseline, gate, gone):
    simulated, recorded = gate.as_measured(baseline)
    values = dict(simulated.runs["two"].outputs["causal"])
    if gone == "everywhere":
        del values["ate_yaw_m"]
    else:
        values["ate_yaw_m"] = (None, *values["ate_yaw_m"][1:])
    check = gate.judged(baseline, [with_series(simulated, "two", outputs={"causal": values}), recorded])
    assert findings(check) == [("flight", "two", "ate_yaw_m", "missing")]


def test_a_missing_kind_of_output_fails(baseline, gate):
    simulated, recorded = gate.as_measured(baseline)
    final = {"final": simulated.runs["two"].outputs["causal"]}
    check = gate.judged(baseline, [with_series(simulated, "two", outputs=final), recorded])
    assert {f[:2] + f[3:] for f in findings(check)} == {("flight", "two", "missing")}


@pytest.mark.parametrize("status", ["diverged", "failed"])
def test_a_run_that_ended_well_and_no_longer_does_fails(baseline, gate, status):
    simulated, recorded = gate.as_measured(baseline)
    changed = with_series(simulated, "two", status=("ok", status, *("ok",) * 22), why="left the road")
    check = gate.judged(baseline, [changed, recorded])
    assert findings(check) == [("flight", "two", "status", "regressed")]
    assert check.failures[0].words == f"{status} under seed 1: left the road"


def test_a_run_that_ends_well_now_passes_and_is_noted(baseline, gate):
    simulated, recorded = gate.as_measured(baseline)
    before = with_series(simulated, "two", status=("failed", *("ok",) * 23))
    of_then = replace(baseline, cases=((baseline.cases[0][0], before), baseline.cases[1]))
    check = gate.judged(of_then, [simulated, recorded])
    assert check.passed
    assert check.notes == ("flight: two ends well in 1 runs in which it did not before",)


def test_frames_that_got_lost_fail_however_good_the_rest(baseline, gate):
    simulated, recorded = gate.as_measured(baseline)
    lost = with_values(simulated, "two", COVERAGE, (97.0, *(100.0,) * 23))
    assert findings(gate.judged(baseline, [lost, recorded])) == [("flight", "two", COVERAGE, "regressed")]


def test_other_measurements_are_not_compared(baseline, gate):
    simulated, recorded = gate.as_measured(baseline)
    other = replace(
        simulated,
        hashes=("other", *simulated.hashes[1:]),
        fingerprints=("other", *simulated.fingerprints[1:]),
    )
    check = gate.judged(baseline, [other, recorded])
    assert findings(check) == [("flight", "", "sequence", "missing")]
    assert "under seed 0" in check.failures[0].words


def test_measurements_rounded_by_another_processor_are_compared_and_noted(baseline, gate):
    simulated, recorded = gate.as_measured(baseline)
    check = gate.judged(baseline, [replace(simulated, hashes=("other", *simulated.hashes[1:])), recorded])
    assert check.passed
    assert "last bits" in check.notes[0]


@pytest.mark.parametrize(("factor", "finding"), [(1.25, "same"), (1.4, "regressed"), (0.6, "better")])
def test_speed_is_judged_by_its_ratio_to_the_reference(baseline, gate, factor, finding):
    simulated, recorded = gate.as_measured(baseline)
    slower = with_series(simulated, "two", speed=tuple(factor * s for s in simulated.runs["two"].speed))
    check = gate.judged(baseline, [slower, recorded])
    one = next(v for v in check.verdicts if (v.estimator, v.metric) == ("two", "speed"))
    assert (one.finding, check.passed) == (finding, finding != "regressed")
    assert gate.judged(baseline, [slower, recorded], speed=False).passed
