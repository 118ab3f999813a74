"""What the project promises to show on real recordings, with the defaults a user gets."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from toolkit.answers import Output, Run
from toolkit.datasets import built_in_names
from toolkit.experiment import recording
from toolkit.experiment.recording import Recording
from toolkit.geometry import Array
from toolkit.jackknife import jackknife_error
from toolkit.measurements import Prior
from toolkit.metrics import Evaluation, score_run
from toolkit.sequence import Sequence


class Case(NamedTuple):
    """A recording as the estimators read it, and its start."""

    sequence: Sequence
    prior: Prior


Prepare = Callable[[str, str | None], Case]
RunOn = Callable[[str, Case], Run]
HELD_OUT = "heldout_reproj_median_px"


@pytest.fixture(scope="module")
def prepare(real: Callable[[str], Path]) -> Prepare:
    @cache
    def prepared(source: str, truth: str | None) -> Case:
        path = source if source in built_in_names() else str(real(source))
        found = recording.prepare(Recording(path, truth=None if truth is None else real(truth)))
        return Case(found.sequence, found.prior)

    return prepared


@pytest.fixture(scope="module")
def run_on(run_estimator: Callable[..., Run]) -> RunOn:
    return cache(lambda name, case: run_estimator(name, case.sequence, case.prior))


def scored(run: Run, case: Case, output: Output, *metrics: str) -> list[float | None]:
    """Return the metrics asked for of a run that went well."""
    assert run.status == "ok", run.log
    values = score_run(run, output, case.sequence).values
    return [values[metric] for metric in metrics]


@pytest.fixture(scope="module")
def drive_27(prepare: Prepare) -> Case:
    return prepare("ucsd/0027.npz", "ucsd/gt/0027.tum")


@pytest.fixture(scope="module")
def dataset_03(prepare: Prepare) -> Case:
    return prepare("ucsd/03.npz", None)


def test_dead_reckoning_on_0027_errs_by_what_was_measured_before(drive_27, run_on):
    """15.8 +- 0.3 m: the twist, its lag and its noise are the file's, no estimator or repair has a part in it."""
    measured_alone = drive_27._replace(sequence=replace(drive_27.sequence, gap_twists=None))
    (ate_m,) = scored(run_on("dead-reckoning", measured_alone), measured_alone, "causal", "ate_se3_m")
    assert ate_m == pytest.approx(15.8, abs=0.3)


@pytest.mark.parametrize(("name", "output", "most_m"), [("ekf", "causal", 7.0), ("batch", "final", 6.5)])
def test_on_0027_vision_more_than_halves_the_error(name, output, most_m, drive_27, run_on):
    (ate_m,) = scored(run_on(name, drive_27), drive_27, output, "ate_se3_m")
    assert ate_m <= most_m


@pytest.mark.parametrize(("name", "output", "most_m"), [("ekf", "causal", 0.6), ("batch", "final", 0.4)])
def test_on_kitti00_both_err_by_no_more_than_was_measured_before(name, output, most_m, prepare, run_on):
    """On a real IMU; scored by a truth that the built-in recording does not bring."""
    case = prepare("kitti00", "kitti00/gt_imu.tum")
    ate_m, coverage_percent = scored(run_on(name, case), case, output, "ate_se3_m", "coverage_percent")
    assert ate_m <= most_m
    assert coverage_percent == 100.0


def test_on_03_the_filter_explains_the_tracks_it_saw_and_those_it_did_not(dataset_03, run_on):
    held_out_px, own_px = scored(run_on("ekf", dataset_03), dataset_03, "causal", HELD_OUT, "reproj_median_px")
    assert held_out_px <= 1.2
    assert own_px <= 0.6


def test_on_03_with_the_noise_as_stated_the_reports_filter_is_seen_to_diverge_and_no_other(dataset_03, run_on):
    """With the measured noise, ten times as large, it does not diverge either."""
    stated = dataset_03.sequence
    stated = dataset_03._replace(sequence=replace(stated, rig=replace(stated.rig, track_weight=1.0)))
    runs = [run_on(name, stated) for name in ("seed-ekf", "ekf", "dead-reckoning")]
    assert [run.status for run in runs] == ["diverged", "ok", "ok"], [run.log for run in runs]


@pytest.mark.parametrize("name", ["ekf", "batch"])
def test_on_03_filter_and_smoother_find_the_gyro_bias(name, dataset_03, run_on):
    """-0.010 rad/s on every axis, as the standstill of the same rig's drive 0010 shows; 0.004 is 0.2 deg/s."""
    np.testing.assert_allclose(run_on(name, dataset_03).final.bias[-1, 3:], -0.010, atol=0.004)


def more_px(one_px: Array, other_px: Array) -> float:
    """Return by how much the median of some errors is above that of others, of the same sightings."""
    return float(np.median(one_px) - np.median(other_px))


def test_on_03_the_smoother_is_no_worse_than_the_filter_beyond_chance(dataset_03, run_on):
    """By withheld tracks, in the order of time; both with the noise that is measured, by which tracks count a tenth."""
    errors_px = []
    for name in ("batch", "ekf"):
        run = run_on(name, dataset_03)
        assert run.status == "ok", run.log
        rows, found_px = Evaluation(run, "final", dataset_03.sequence).held_out_errors
        errors_px.append(found_px[np.argsort(dataset_03.sequence.held_out.frame[rows], kind="stable")])
    assert more_px(*errors_px) < 2.0 * jackknife_error(more_px, *errors_px)


def test_a_recording_without_features_is_dead_reckoned(prepare, run_on):
    case = prepare("ucsd/10_imu_only.npz", None)
    run = run_on("dead-reckoning", case)
    assert run.status == "ok"
    assert len(run.final) == case.sequence.frame_count
    assert len(run.landmarks) == 0
