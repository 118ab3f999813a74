"""What the gate fails for, and what it lets pass."""

from dataclasses import replace

import numpy as np
import pytest
from msgspec import structs

from tests.gate.conftest import SEEDS, as_another_trajectory, as_measured, checked, edited, planted
from toolkit.gate.baseline import COVERAGE


def findings(check):
    return [(v.sequence, v.estimator, v.metric, v.finding) for v in check.failing]


def with_series(measured, estimator, **changes):
    return replace(measured, runs=measured.runs | {estimator: structs.replace(measured.runs[estimator], **changes)})


def with_values(measured, estimator, key, values):
    return with_series(measured, estimator, causal=measured.runs[estimator].causal | {key: values})


def test_identical_results_pass_and_every_difference_is_zero(baseline):
    check = checked(baseline, as_measured(baseline))
    assert check.passed
    assert check.tests == 3 * 5  # estimators times metrics, on the simulated sequence
    assert {v.finding for v in check.verdicts} == {"same"}
    assert {v.change_percent for v in check.verdicts} <= {0.0, None}
    assert {v.p for v in check.verdicts} == {1.0, None}
    (note,) = check.notes
    assert note.startswith("data/drive_small: the time of one, two, three is not checked")


@pytest.mark.parametrize("metric", ["ate_se3_m", "ate_yaw_m", "heldout_reproj_median_px"])
def test_a_planted_regression_fails_and_nothing_else_does(baseline, metric):
    simulated, recorded = as_measured(baseline)
    check = checked(baseline, [edited(simulated, planted(5.0, 1, metric=metric)), recorded])
    assert findings(check) == [("flight", "two", metric, "regressed")]
    assert check.failing[0].p < 0.05
    assert check.failing[0].change_percent == pytest.approx(5.0, abs=2.0)


def test_a_change_within_the_margin_has_moved_and_is_no_worse_however_certain(baseline):
    simulated, recorded = as_measured(baseline)
    findings = {
        (factor, accepted): {v.finding for v in check.verdicts if v.metric == "ate_se3_m" and v.sequence == "flight"}
        for factor in (1.0 + 1e-7, 0.996, 1.004, 1.006)
        for accepted in (False, True)
        for check in [
            checked(baseline, [edited(simulated, lambda _n, _k, v, f=factor: v * f), recorded], accept_better=accepted)
        ]
    }
    assert findings == {
        (1.0 + 1e-7, False): {"same"},
        (1.0 + 1e-7, True): {"same"},
        (0.996, False): {"moved"},
        (0.996, True): {"better"},
        (1.004, False): {"moved"},
        (1.004, True): {"worse"},
        (1.006, False): {"regressed"},
        (1.006, True): {"regressed"},
    }


def test_a_change_under_a_few_seeds_is_chance(baseline):
    simulated, recorded = as_measured(baseline)
    flipped = np.where(np.arange(24) < 3, 1.02, 1.0)  # as a gate that decides otherwise after another rounding
    assert checked(baseline, [edited(simulated, lambda _n, _k, v: v * flipped), recorded]).passed


@pytest.mark.parametrize("accepted", [False, True])
@pytest.mark.parametrize(
    ("edit", "changed"),
    [
        (("ate_se3_m", "ate_yaw_m", "rpe_100m_percent"), ("ate_se3_m", "ate_yaw_m", "rpe_100m_percent")),
        (("heldout_reproj_median_px",), ("heldout_reproj_median_px",)),
        (("nees_pose_mean",), ()),  # the covariance may have moved
        (("ate_se3_m", "ate_yaw_m", "rpe_100m_percent", "heldout_reproj_median_px", "nees_pose_mean"), ()),
    ],
)
def test_a_metric_that_moves_while_the_poses_do_not_is_another_metric(baseline, edit, changed, accepted):
    now = [edited(one, lambda n, k, v: 0.9 * v if n == "two" and k in edit else v) for one in as_measured(baseline)]
    check = checked(baseline, now, accept_better=accepted)
    found = {v.metric for v in check.verdicts if v.finding == "changed metric"}
    assert found == set(changed)
    assert not (found and check.passed)


def test_noise_alone_raises_an_alarm_no_more_often_than_stated(baseline):
    simulated, recorded = as_measured(baseline)
    checks = 300
    alarms = sum(
        not checked(baseline, [edited(simulated, planted(0.0, seed)), recorded]).passed for seed in range(checks)
    )
    # 15 are promised at most; three standard deviations above that.
    assert alarms <= 15 + 3.0 * np.sqrt(15.0)


@pytest.mark.parametrize(
    ("was", "now", "finding"),
    [
        (4.0, 4.4, "regressed"),  # overconfident, and more so
        (4.0, 3.6, "better"),  # nearer to honest
        (0.30, 0.27, "regressed"),  # timid, and more so
        (0.30, 0.33, "better"),
        (0.95, 1.05, "worse"),  # within the band of 24 runs
        (1.05, 0.95, "better"),
        (1.0, 1.6, "regressed"),  # out of it
        (0.4, 1.1, "better"),  # into it
        (3.0, 0.2, "regressed"),  # through it, and farther out than before
        (3.0, 0.6, "better"),  # through it, and nearer
    ],
)
def test_consistency_is_worse_farther_from_its_band_and_a_move_either_way_fails_unless_accepted(
    baseline, was, now, finding
):
    simulated, recorded = as_measured(baseline)
    rng = np.random.default_rng(9)
    scatter = np.exp(0.1 * rng.standard_normal(len(SEEDS)))
    before = with_values(simulated, "two", "nees_pose_mean", tuple((was * scatter).tolist()))
    moved = now * scatter * np.exp(0.02 * rng.standard_normal(scatter.size))
    after = with_values(simulated, "two", "nees_pose_mean", tuple(moved.tolist()))
    of_then = replace(baseline, cases=((baseline.cases[0][0], before), baseline.cases[1]))
    for accepted, expected in ((True, finding), (False, "regressed" if finding == "regressed" else "moved")):
        found = checked(of_then, [after, recorded], accept_better=accepted).verdicts
        assert [v.finding for v in found if v.finding != "same"] == [expected]


@pytest.mark.parametrize(
    ("metric", "factor", "finding", "accepted"),
    [
        ("ate_se3_m", 1.0 + 1e-8, "same", "same"),  # as another processor rounds
        ("ate_se3_m", 1.0 + 1e-4, "worse", "worse"),
        ("ate_se3_m", 1.0 - 1e-4, "better", "better"),
        ("ate_se3_m", 1.049, "worse", "worse"),
        ("ate_se3_m", 1.051, "regressed", "regressed"),
        ("ate_se3_m", 0.94, "moved", "better"),
        ("heldout_reproj_median_px", 1.021, "regressed", "regressed"),
        ("nis_mean", 1.0 / 1.11, "regressed", "regressed"),  # the made-up values are below 1: less is farther from it
        ("nis_mean", 1.09, "better", "better"),
        ("nis_mean", 1.11, "moved", "better"),
    ],
)
@pytest.mark.parametrize("accept_better", [False, True])
def test_a_recording_shows_any_change_and_fails_beyond_its_bound(
    baseline, metric, factor, finding, accepted, accept_better
):
    simulated, recorded = as_measured(baseline)
    finding = accepted if accept_better else finding
    moved = recorded if finding == "same" else as_another_trajectory(recorded)
    changed = edited(moved, lambda n, key, v: v * factor if (n, key) == ("two", metric) else v)
    check = checked(baseline, [simulated, changed], accept_better=accept_better)
    one = next(v for v in check.verdicts if (v.sequence, v.estimator, v.metric) == ("data/drive_small", "two", metric))
    assert one.finding == finding
    assert check.passed == (finding not in ("regressed", "moved"))


@pytest.mark.parametrize("status", ["diverged", "failed"])
def test_a_run_that_ended_well_and_no_longer_does_fails(baseline, status):
    simulated, recorded = as_measured(baseline)
    changed = with_series(simulated, "two", status=("ok", status, *("ok",) * 22))
    changed = replace(changed, why={"two": "left the road"})
    check = checked(baseline, [changed, recorded])
    assert findings(check) == [("flight", "two", "status", "regressed")]
    assert check.failing[0].words == f"{status} under seed 1: left the road"


def test_a_run_that_ends_well_now_fails_unless_it_is_accepted(baseline):
    simulated, recorded = as_measured(baseline)
    before = with_series(simulated, "two", status=("failed", *("ok",) * 23))
    of_then = replace(baseline, cases=((baseline.cases[0][0], before), baseline.cases[1]))
    assert findings(checked(of_then, [simulated, recorded])) == [("flight", "two", "status", "moved")]
    check = checked(of_then, [simulated, recorded], accept_better=True)
    assert check.passed
    assert "flight: two ends better in 1 runs than before" in check.notes


def test_frames_that_got_lost_fail_however_good_the_rest(baseline):
    simulated, recorded = as_measured(baseline)
    lost = with_values(simulated, "two", COVERAGE, (97.0, *(100.0,) * 23))
    assert findings(checked(baseline, [lost, recorded])) == [("flight", "two", COVERAGE, "regressed")]


def test_measurements_rounded_by_another_processor_are_compared_and_noted(baseline):
    simulated, recorded = as_measured(baseline)
    check = checked(baseline, [replace(simulated, hashes=("other", *simulated.hashes[1:])), recorded])
    assert check.passed
    assert "last bits" in check.notes[0]


@pytest.mark.parametrize(("factor", "finding"), [(1.25, "same"), (1.4, "regressed"), (0.6, "better")])
def test_speed_is_checked_by_its_ratio_to_the_reference(baseline, factor, finding):
    simulated, recorded = as_measured(baseline)
    slower = with_series(simulated, "two", speed=tuple(factor * s for s in simulated.runs["two"].speed))
    check = checked(baseline, [slower, recorded])
    one = next(v for v in check.verdicts if (v.estimator, v.metric) == ("two", "speed"))
    assert (one.finding, check.passed) == (finding, finding != "regressed")
    assert checked(baseline, [slower, recorded], speed=False).passed
