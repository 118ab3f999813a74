"""A grid of experiments: what each is, that they are paired, kept, and found again whoever asks. 4 s."""

from dataclasses import replace

import numpy as np
import pytest

from toolkit.errors import DataError, EstimatorError
from toolkit.experiment import pipeline
from toolkit.experiment.grid import Trial, run_grid
from toolkit.experiment.pipeline import Plan
from toolkit.experiment.pipeline import run as run_plan
from toolkit.experiment.recording import Recording, prepare
from toolkit.experiment.units import Unit, run_unit
from toolkit.progress import SILENT
from toolkit.settings import SettingsError
from toolkit.settings.reading import settings_of
from toolkit.simulation.faults import dropped_frames

CLEAN, LOST = Trial("dead-reckoning"), Trial.of("dead-reckoning", faults={"dropped_frames": 0.3})
SCALED = Trial.of("dead-reckoning", {"noise.motion_scale": 4.0})


@pytest.fixture
def plan(two_seconds: None) -> Plan:
    settings = settings_of({"seeds": 2}, "here")
    return Plan(("drive",), ("dead-reckoning",), settings=settings, max_frames=12, workers=1)


def test_an_experiment_is_what_a_comparison_with_its_settings_is(plan):
    grid = run_grid(plan, [CLEAN, SCALED])
    for trial, scale in ((CLEAN, "auto"), (SCALED, 4.0)):
        settings = settings_of({"seeds": 2, "noise": {"motion_scale": scale}}, "here")
        (compared,) = run_plan(replace(plan, settings=settings))
        expected = [one.outputs["final"].scores.values["nees_pose_mean"] for one in compared.outcomes]
        assert grid.row(trial, "final").values("nees_pose_mean") == expected


def test_faults_are_planted_in_the_part_that_is_run_and_pairs_are_drawn_alike(plan):
    grid = run_grid(plan, [CLEAN, LOST, Trial.of("ekf", faults={"dropped_frames": 0.3})])
    clean, lost, beside = ([one.sequence_hash for one in outcomes] for outcomes in grid.outcomes.values())
    assert lost == beside
    assert not set(lost) & set(clean)
    recording = replace(plan.recording("drive", 1), faults=LOST.faults)
    assert 3 <= prepare(recording).sequence.frame_count < 12


def test_what_one_grid_kept_another_finds_to_the_bit(plan, tmp_path, monkeypatch):
    """What a kill leaves is found by the tests of the outcome store and of the command."""
    (fresh, _) = run_grid(plan, [LOST, CLEAN], tmp_path).outcomes.values()
    monkeypatch.setattr(pipeline, "run_unit", lambda *_: pytest.fail("a unit was run again"))
    (kept,) = run_grid(plan, [LOST], tmp_path).outcomes.values()
    for one, other in zip(kept, fresh, strict=True):
        assert one.outputs["final"].scores == other.outputs["final"].scores
        for name in ("drift_m", "heldout_px"):
            np.testing.assert_array_equal(getattr(one.outputs["final"], name), getattr(other.outputs["final"], name))


def test_trials_that_come_to_the_same_run_run_once(plan, monkeypatch):
    ran: list[Unit] = []
    monkeypatch.setattr(pipeline, "run_unit", lambda unit, progress: (ran.append(unit), run_unit(unit, progress))[1])
    default = Trial.of("dead-reckoning", {"noise.motion_scale": "auto"})
    grid = run_grid(plan, [CLEAN, default, Trial.of("dead-reckoning", {"estimators.ekf.landmark_uncertainty": False})])
    assert len(ran) == 2
    assert len({id(outcomes[0]) for outcomes in grid.outcomes.values()}) == 1


def test_stretches_of_two_runs_that_lack_frames_are_of_the_same_times():
    prepared = prepare(Recording("drive", 0, duration_s=12.0))
    thinned = replace(prepared, sequence=dropped_frames(prepared.sequence, 0.2, 1))
    whole, lacking = (
        run_unit(Unit(one, 0, "dead-reckoning"), SILENT).outputs["final"].drift_m for one in (prepared, thinned)
    )
    both = np.isfinite(lacking)
    assert np.isfinite(whole).all() and both.mean() > 0.8
    assert np.corrcoef(whole[both], lacking[both])[0, 1] > 0.8  # the ends are up to a frame apart


def test_a_recording_that_a_fault_makes_unusable_is_a_failed_run(plan):
    grid = run_grid(plan, [CLEAN, Trial.of("dead-reckoning", faults={"nan_span": 0.5})])
    clean, broken = grid.outcomes.values()
    assert {one.status for one in clean} == {"ok"}
    assert {one.status for one in broken} == {"failed"}
    assert "not finite" in broken[0].why


@pytest.mark.parametrize(
    ("trial", "error", "what"),
    [
        (lambda: Trial.of("ekf", faults={"fog": 1.0}), SettingsError, "fault"),
        (lambda: Trial.of("ekf", {"window.lag": 1.0}), SettingsError, "window.lag"),
        (lambda: Trial.of("ekf", {"estimators.ekf.fast": 1}), EstimatorError, "no option fast"),
        (lambda: Trial("no-such"), EstimatorError, "no-such"),
        (lambda: Trial.of("ekf", faults={"standstill": 1.0}), DataError, "can be planted between twists only"),
        (lambda: Trial.of("ekf", faults={"frame_jitter": -1.0}), DataError, "a dose of -1 s cannot be planted"),
        (lambda: Trial.of("ekf", faults={"blackout": np.inf}), SettingsError, "give a finite dose, in s"),
        (lambda: Trial.of("ekf", faults={"outlier_tracks": -0.5}), SettingsError, "give a share from 0 to 1"),
    ],
)
def test_what_cannot_be_run_is_told_before_anything_runs(plan, trial, error, what, monkeypatch):
    monkeypatch.setattr(pipeline, "run_unit", lambda *_: pytest.fail("a unit was run"))
    with pytest.raises(error, match=what):
        run_grid(replace(plan, sources=("flight" if error is DataError else "drive",)), [CLEAN, trial()])
