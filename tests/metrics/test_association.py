"""Which poses are compared, and that a run which tracked little cannot hide it."""

from dataclasses import replace

import numpy as np
import pytest

from tests.metrics.conftest import drive_poses, make_run, make_sequence, perturb
from toolkit.estimate import Trajectory
from toolkit.geometry import se3_exp
from toolkit.metrics import score_run
from toolkit.metrics.parts.evaluation import associate
from toolkit.sequence import Truth

PERIOD_NS = 100_000_000


def test_stamps_that_differ_by_rounding_are_not_interpolated():
    poses = drive_poses(30)
    t_ns = PERIOD_NS * np.arange(30)
    rounding_ns = np.random.default_rng(0).integers(-60_000, 60_000, 30)  # kitti00's truth: four decimals
    matched = associate(Trajectory(t_ns, poses), Truth(t_ns + rounding_ns, poses), PERIOD_NS)
    np.testing.assert_array_equal(matched.estimate, poses)


@pytest.mark.parametrize(
    "truth_ns", [PERIOD_NS * np.arange(19) + PERIOD_NS // 2, np.arange(0, 19 * PERIOD_NS + 1, 1_000_000)]
)
def test_between_frames_the_estimate_moves_on_the_geodesic_and_no_pose_is_matched_twice(truth_ns):
    twist, t_ns = np.array([0.1, -0.2, 0.3, 1.0, 2.0, 3.0]), PERIOD_NS * np.arange(20)
    estimate, truth = (se3_exp((ns / PERIOD_NS)[:, None] * twist) for ns in (t_ns, truth_ns))
    matched = associate(Trajectory(t_ns, estimate), Truth(truth_ns, truth), PERIOD_NS)
    np.testing.assert_allclose(matched.estimate, matched.truth, atol=1e-12)  # a constant twist is a geodesic
    assert len(matched) == truth_ns.size


def test_nothing_is_scored_in_a_gap_or_outside_the_estimate():
    poses, t_ns = drive_poses(40), PERIOD_NS * np.arange(40)
    kept = np.r_[5:15, 17:30]
    matched = associate(Trajectory(t_ns[kept], poses[kept]), Truth(t_ns, poses), PERIOD_NS)
    np.testing.assert_array_equal(matched.t_ns, t_ns[kept])


def test_poses_that_are_not_finite_and_frames_that_are_missing_lower_the_coverage():
    sequence = make_sequence(drive_poses(300), track_count=60)
    poses, t_ns = sequence.truth.T_world_imu.copy(), sequence.frames_t_ns
    poses[40:70] = np.nan
    poses[100, 1, 3] = np.inf
    scores = score_run(make_run(t_ns, poses), "final", sequence)
    assert scores.values["pairs"] == 269
    assert scores.values["coverage_percent"] == pytest.approx(100.0 * 269 / 300)
    assert scores.values["ate_se3_m"] == pytest.approx(0.0, abs=1e-10)  # 300 m in doubles
    assert "observations scored" in scores.notes["heldout_reproj_median_px"]
    drifting = perturb(sequence.truth.T_world_imu, 2e-3, seed=3)
    whole, tenth = (score_run(make_run(t_ns[:n], drifting[:n]), "final", sequence).values for n in (300, 30))
    assert tenth["ate_se3_m"] < whole["ate_se3_m"]  # looks better ...
    assert (tenth["coverage_percent"], tenth["pairs"]) == (pytest.approx(10.0), 30)  # ... and says why
    assert (whole["coverage_percent"], whole["pairs"]) == (100.0, 300)


def test_coverage_counts_the_frames_within_the_truths_time():
    sequence = make_sequence(drive_poses(100), track_count=3)
    truth = Truth(sequence.frames_t_ns[:80] + 128, sequence.truth.T_world_imu[:80])  # ucsd 0027: off by 128 ns, short
    run = make_run(sequence.frames_t_ns[:80], sequence.truth.T_world_imu[:80])
    assert score_run(run, "final", replace(sequence, truth=truth)).values["coverage_percent"] == 100.0


@pytest.mark.parametrize("kept", [0, 1])
def test_too_few_matches_leave_reasons_instead_of_numbers(kept):
    sequence = make_sequence(drive_poses(50), track_count=20)
    scores = score_run(make_run(sequence.frames_t_ns[:kept], drive_poses(50)[:kept]), "final", sequence)
    assert scores.values["pairs"] == kept
    assert scores.values["coverage_percent"] == pytest.approx(2.0 * kept)
    for key in ("ate_none_m", "ate_se3_m", "rpe_1s_m", "kitti_t_percent", "end_drift_percent"):
        assert scores.values[key] is None
        assert "match" in scores.notes[key]
