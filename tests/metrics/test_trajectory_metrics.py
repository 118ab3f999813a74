"""Properties of the metrics that compare with the truth: alignment, invariance, KITTI's figures, end drift."""

import itertools

import numpy as np
import pytest
from scipy.optimize import minimize

from tests.metrics.conftest import drive_poses, make_run, make_sequence, perturb
from toolkit.geometry import about_z, se3, se3_exp, transform
from toolkit.metrics import score_run
from toolkit.metrics.parts.evaluation import fit_se3, fit_yaw
from toolkit.metrics.parts.scores import Unavailable

ERRORS = ["ate_none_m", "ate_se3_m", "ate_yaw_m", "ate_sim3_m", "ate_se3_deg", "rpe_1s_m", "rpe_1s_deg"]
ERRORS += ["rpe_100m_percent", "kitti_t_percent", "kitti_r_deg_per_m", "end_drift_percent"]


@pytest.fixture
def score():
    def scored(sequence, poses, output="final"):
        return score_run(make_run(sequence.frames_t_ns, poses), output, sequence)

    return scored


@pytest.mark.parametrize("motion", ["twist", "imu"])
def test_every_error_is_zero_on_truth(score, motion):
    sequence = make_sequence(drive_poses(400), track_count=3, motion=motion)
    values = score(sequence, sequence.truth.T_world_imu).values
    for key in ERRORS:
        assert values[key] == pytest.approx(0.0, abs=1e-10), key  # 400 m in doubles: 1e-13 a step
    assert values["pairs"] == 400
    assert values["coverage_percent"] == 100.0


def test_with_an_imu_a_heading_is_free_and_a_tilt_is_an_error(score):
    sequence = make_sequence(drive_poses(400), track_count=3, motion="imu")
    estimate = perturb(sequence.truth.T_world_imu, 1e-3, seed=1)
    turned = se3(about_z(2.2), np.array([9.0, 1.0, 3.0])) @ estimate
    tilted = se3_exp(np.array([0.0, 0.05, 0.0, 0.0, 0.0, 0.0])) @ estimate
    as_is = score(sequence, estimate).values
    for key in ("ate_none_m", "ate_yaw_m", "end_drift_percent"):
        assert score(sequence, turned).values[key] == pytest.approx(as_is[key], rel=1e-9)  # rounding only
        assert score(sequence, tilted).values[key] > 1.2 * as_is[key]


@pytest.mark.parametrize(
    ("motion", "tilt_rad", "remarked"),
    [
        ("imu", 0.05, {"ate_none_m": "vertical 3 deg off", "ate_yaw_m": "vertical 3 deg off"}),
        ("imu", 0.0, {}),
        ("twist", 0.02, {"ate_yaw_m": "nothing measured"}),
        ("twist", 0.002, {}),
        ("twist", 0.0, {}),
    ],
)
def test_a_tilt_is_remarked_where_it_is_most_of_the_error_with_the_vertical_kept(score, motion, tilt_rad, remarked):
    sequence = make_sequence(drive_poses(400), track_count=3, motion=motion)
    estimate = perturb(sequence.truth.T_world_imu, 1e-3, seed=1)
    notes = score(sequence, se3_exp(np.array([0.0, tilt_rad, 0.0, 0.0, 0.0, 0.0])) @ estimate).notes
    for key in ("ate_none_m", "ate_yaw_m", "ate_se3_m"):
        assert (key in notes) == (key in remarked)
        assert remarked.get(key, "") in notes.get(key, "")


@pytest.mark.parametrize("seed", range(2))
def test_the_heading_fit_is_the_least_squares_one(seed):
    rng = np.random.default_rng(seed)
    truth = rng.normal(0.0, 20.0, (50, 3))
    estimate = truth @ about_z(rng.uniform(-3, 3)) + rng.normal(0.0, 4.0, (50, 3)) + 7.0

    def mean_square(parameters):
        moved = estimate @ about_z(parameters[0]).T + parameters[1:]
        return np.mean(np.sum((moved - truth) ** 2, axis=1))

    starts = [np.array([yaw, 0.0, 0.0, 0.0]) for yaw in np.linspace(-3.0, 3.0, 7)]
    best = min(minimize(mean_square, start, method="BFGS", options={"gtol": 1e-9}).fun for start in starts)
    fit = fit_yaw(truth, estimate)
    ours = mean_square([np.arctan2(fit.rotation[1, 0], fit.rotation[0, 0]), *fit.translation])
    assert ours == pytest.approx(best, rel=1e-9)  # at a minimum the cost is flat to second order
    assert ours <= best * (1.0 + 1e-12)


def test_a_fit_needs_three_pairs():
    with pytest.raises(Unavailable, match="needs 3"):
        fit_se3(np.zeros((2, 3)), np.zeros((2, 3)))
    corners = np.array([[0.0, 0.0, 0.0], [2.0, 0.0, 0.0], [0.0, 1.0, 3.0]])
    T_other_here = se3_exp(np.array([0.4, -1.1, 2.0, 3.0, -5.0, 7.0]))
    fit = fit_se3(transform(T_other_here, corners), corners)
    np.testing.assert_allclose(fit.rotation, T_other_here[:3, :3], atol=1e-14)  # an SVD of numbers near one


@pytest.mark.parametrize(
    ("factor", "expected"), [(1.0 / 0.3048, "0.3048, as if in feet"), (1.06, "0.9434:"), (0.8, "1.25:")]
)
def test_positions_that_fit_at_another_scale_are_remarked_with_it(score, factor, expected):
    sequence = make_sequence(drive_poses(400), track_count=3)
    longer = sequence.truth.T_world_imu.copy()
    longer[:, :3, 3] *= factor
    notes = score(sequence, longer).notes
    for key in ("ate_se3_m", "ate_yaw_m"):
        assert f"when multiplied by {expected}" in notes[key]
    # A scale that explains little of the error is none.
    assert "multiplied" not in score(sequence, perturb(sequence.truth.T_world_imu, 1e-3, seed=1)).notes.get(
        "ate_se3_m", ""
    )


def test_on_a_straight_line_the_rotation_error_is_refused_and_reported(score):
    poses = se3(np.eye(3), np.outer(np.arange(50.0), [1.0, 0.5, 0.1]))
    sequence = make_sequence(poses, track_count=3)
    scores = score(sequence, se3_exp(np.array([0.3, 0.0, 0.5, 1.0, 2.0, 3.0])) @ poses)
    assert scores.values["ate_se3_m"] == pytest.approx(0.0, abs=1e-12)  # 50 m in doubles
    assert scores.values["ate_se3_deg"] is None
    assert "line" in scores.notes["ate_se3_deg"]
    assert "line" in scores.notes["ate_se3_m"]


def devkit_errors(truth, estimate):
    """KITTI's devkit in plain loops: mean of t_err and r_err over all segments."""
    dist = [0.0]
    for a, b in itertools.pairwise(truth):
        dist.append(dist[-1] + float(np.sqrt(((b[:3, 3] - a[:3, 3]) ** 2).sum())))
    t_errors, r_errors = [], []
    for first in range(0, len(truth), 10):
        for length in (100, 200, 300, 400, 500, 600, 700, 800):
            last = next((k for k in range(first, len(truth)) if dist[k] > dist[first] + length), -1)
            if last == -1:
                continue
            delta_truth = np.linalg.inv(truth[first]) @ truth[last]
            delta_estimate = np.linalg.inv(estimate[first]) @ estimate[last]
            error = np.linalg.inv(delta_estimate) @ delta_truth
            r_errors.append(np.arccos(np.clip(0.5 * (np.trace(error[:3, :3]) - 1.0), -1.0, 1.0)) / length)
            t_errors.append(np.sqrt((error[:3, 3] ** 2).sum()) / length)
    return np.mean(t_errors), np.mean(r_errors), len(t_errors)


def test_kitti_figures_equal_the_development_kits_loops(score):
    sequence = make_sequence(drive_poses(600, step_m=1.7), track_count=3)
    estimate = perturb(sequence.truth.T_world_imu, 2e-3, seed=4)
    t_error, r_error, segments = devkit_errors(sequence.truth.T_world_imu, estimate)
    values = score(sequence, estimate).values
    assert segments > 200
    assert values["kitti_t_percent"] == pytest.approx(100.0 * t_error, rel=1e-9)  # rounding of 4x4 inverses
    # The devkit's arccos loses half the digits of a small angle; the angles here are 0.02 rad and more.
    assert values["kitti_r_deg_per_m"] == pytest.approx(np.degrees(r_error), rel=1e-9)


@pytest.mark.parametrize(("step_m", "scored"), [(54.0, True), (56.0, False), (0.5, False)])
def test_a_path_that_is_shorter_than_100_m_or_a_step_that_is_a_tenth_longer_has_no_pair(score, step_m, scored):
    """Two steps are the first beyond 100 m: 108 or 112."""
    poses = se3(np.eye(3), np.outer(np.arange(30.0), [step_m, 0.0, 0.0]))
    scores = score(make_sequence(poses, track_count=3), poses)
    assert (scores.values["rpe_100m_percent"] is not None) == scored
    if step_m < 1.0:
        for key in ("kitti_t_percent", "kitti_r_deg_per_m", "rpe_100m_percent"):
            assert scores.values[key] is None
            assert "100 m" in scores.notes[key]


@pytest.mark.parametrize(("resumed_at", "scored"), [(20, True), (21, False)])
def test_a_second_that_ends_in_a_gap_lasts_half_a_step_longer_at_most(resumed_at, scored):
    """From the last frame before the gap, at 0.9 s, the first one a second on is 1.1 or 1.2 s later."""
    sequence, kept = make_sequence(drive_poses(30), track_count=3), np.r_[0:10, resumed_at : resumed_at + 9]
    run = make_run(sequence.frames_t_ns[kept], sequence.truth.T_world_imu[kept])
    assert (score_run(run, "final", sequence).values["rpe_1s_m"] is not None) == scored


def test_end_drift_is_the_last_error_over_the_path(score):
    poses = se3(np.eye(3), np.outer(np.arange(51.0), [2.0, 0.0, 0.0]))
    sequence = make_sequence(poses, track_count=3)
    stretched = se3(np.eye(3), 1.02 * poses[:, :3, 3])
    # 2 % too long everywhere: 2 m at the end of 100 m; rounding only.
    assert score(sequence, stretched).values["end_drift_percent"] == pytest.approx(2.0, rel=1e-12)
