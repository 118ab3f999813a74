"""What the package promises about its answers, and the figures that are read off a run: NIS, gate and cost."""

import math
from dataclasses import replace

import numpy as np
import pytest

from tests.metrics.conftest import drive_poses, make_run, make_sequence
from toolkit import metrics
from toolkit.errors import VislamError
from toolkit.metrics import score_run
from toolkit.metrics.innovations import ACCEPTED, refuses_much
from toolkit.models.gating import chi2_bound, mean_below_bound
from toolkit.simulation import SCENARIOS, simulate


@pytest.fixture
def case():
    sequence = make_sequence(drive_poses(150), track_count=60)

    def scored(output="causal", poses=sequence.truth.T_world_imu, **changes):
        return score_run(make_run(sequence.frames_t_ns, poses, **changes), output, sequence)

    return scored


def test_nis_is_one_for_a_consistent_filter_and_weighted_by_its_degrees_of_freedom(case):
    dof = np.random.default_rng(0).integers(1, 200, 2000).astype(float)
    info = {"nis": np.random.default_rng(0).chisquare(dof), "nis_dof": dof}
    assert case(info=info).values["nis_mean"] == pytest.approx(1.0, abs=4.0 * math.sqrt(2.0 / dof.sum()))  # four sigma
    info = {"nis": np.array([np.nan, 30.0, 10.0, 5.0]), "nis_dof": np.array([np.nan, 20.0, 10.0, np.nan])}
    assert case(info=info).values["nis_mean"] == pytest.approx(40.0 / 30.0)


def test_nis_behind_a_gate_is_held_against_what_passes_it(case):
    """An honest filter's innovations, gated at 95 %, have a mean of 1; by their degrees of freedom it would be 0.88."""
    drawn = np.random.default_rng(3).chisquare(3, (2000, 10))
    accepted = drawn < chi2_bound(3, 0.95)
    nis, count = (drawn * accepted).sum(axis=1), accepted.sum(axis=1)
    info = {"nis": nis, "nis_dof": 3.0 * count, "nis_expected": count * mean_below_bound(3, 0.95)}
    # Four sigma of the mean over its 3 degrees of freedom, which the gate only narrows.
    assert case(info=info).values["nis_mean"] == pytest.approx(1.0, abs=4.0 * math.sqrt(2.0 / (3 * count.sum())))
    without = {name: info[name] for name in ("nis", "nis_dof")}
    assert case(info=without).values["nis_mean"] == pytest.approx(0.877, abs=0.01)


def test_what_the_gate_accepts_is_the_share_over_all_steps_that_tested_something(case):
    info = {"gate_tested": np.array([np.nan, 30.0, 0.0, 10.0]), "gate_accepted": np.array([np.nan, 27.0, 0.0, 3.0])}
    assert case(info=info).values[ACCEPTED] == pytest.approx(75.0)


ONES, ZEROS, NANS = np.ones(3), np.zeros(3), np.full(3, np.nan)


@pytest.mark.parametrize(
    ("key", "output", "info", "reason"),
    [
        ("nis_mean", "final", {"nis": ONES, "nis_dof": ONES}, "causal"),
        ("nis_mean", "causal", {}, "reports no innovations"),
        ("nis_mean", "causal", {"nis": NANS, "nis_dof": NANS}, "no step"),
        (ACCEPTED, "final", {"gate_tested": ONES, "gate_accepted": ONES}, "causal"),
        (ACCEPTED, "causal", {}, "reports no gate"),
        (ACCEPTED, "causal", {"gate_tested": ZEROS, "gate_accepted": ZEROS}, "tested nothing"),
    ],
)
def test_what_is_read_off_innovations_is_missing_with_its_reason(case, key, output, info, reason):
    scores = case(output, info=info)
    assert scores.values[key] is None
    assert reason in scores.notes[key]


@pytest.mark.parametrize("name", ["ekf", "msckf-slam"])
def test_a_sound_recording_passes_and_a_focal_length_a_tenth_too_long_does_not(run_estimator, name):
    """The innovations that remain look consistent in both: behind its gate msckf-slam reads a NIS near 1."""
    sound = simulate(replace(SCENARIOS["flight"], duration_s=4.0), seed=5)
    wrong = replace(sound, rig=replace(sound.rig, fx_px=1.1 * sound.rig.fx_px))
    shares = [score_run(run_estimator(name, one), "causal", one).values[ACCEPTED] for one in (sound, wrong)]
    assert not refuses_much(shares[0])
    assert refuses_much(shares[1])


def test_cost_is_read_off_the_timings(case):
    values = case().values
    assert values["frame_ms_mean"] == pytest.approx(2.0)
    assert values["frame_ms_max"] == pytest.approx(4.0)
    assert 2.0 < values["frame_ms_p95"] < 4.0
    assert (values["total_s"], values["cpu_s"], values["peak_rss_mb"]) == (0.6, 0.7, 123.0)


def test_an_output_that_does_not_exist_is_refused():
    sequence = make_sequence(drive_poses(20), track_count=3)
    run = make_run(sequence.frames_t_ns, drive_poses(20), causal=None)
    with pytest.raises(ValueError, match="no causal output"):
        score_run(run, "causal", sequence)


def test_a_defect_in_a_metric_passes_through(case, monkeypatch):
    from toolkit.metrics import drift

    monkeypatch.setattr(drift, "score", lambda evaluation: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        case()


def test_a_metric_is_chosen_by_its_key_its_name_or_what_stands_above_its_column():
    for metric in metrics.known_metrics():
        assert metrics.metrics_called([metric.column]) == (metric,)
    assert [m.key for m in metrics.metrics_called(["NIS mean", "ate_se3_m"])] == ["nis_mean", "ate_se3_m"]
    with pytest.raises(VislamError, match=r"no metric is called ATE SE3; did you mean ATE SE\(3\)\?"):
        metrics.metrics_called(["pairs", "ATE SE3"])
