"""NEES of the whole state: exact draws are consistent, wrong covariances are not, in the right world."""

from dataclasses import replace

import numpy as np
import pytest

from tests.metrics.conftest import drive_poses, make_run, make_sequence
from toolkit.estimate import Trajectory
from toolkit.geometry import about_z, interpolate_poses, se3, se3_exp, se3_inverse
from toolkit.measurements import Prior
from toolkit.metrics import Evaluation
from toolkit.metrics.nees import score
from toolkit.metrics.parts.consistency import chi2_quantile, nees_band, nees_over_time
from toolkit.sequence import Truth

POSES = 4000
KEYS = ("nees_pose_mean", "nees_ori_mean", "nees_pos_mean", "nees_pose_in_band_percent")
# Rotation of 1-3 mrad, position of 1-10 cm, correlated: what forgetting a transpose or a block would get wrong.
_SIGMA = np.array([0.001, 0.003, 0.002, 0.05, 0.01, 0.1])
_MIX = np.eye(6) + 0.4 * np.tri(6, k=-1)
COV = np.diag(_SIGMA) @ _MIX @ _MIX.T @ np.diag(_SIGMA)


def prior_at(pose):
    cov = np.eye(15)
    cov[:6, :6] = COV
    return Prior(pose, np.zeros(3), np.zeros(6), cov, "test")


@pytest.fixture
def sequence():
    made = make_sequence(drive_poses(POSES), track_count=3)
    return replace(made, prior=prior_at(drive_poses(POSES)[0]))


def drawn(sequence, make_run, scale=1.0, seed=1):
    """Return a run whose errors are drawn from ``scale`` times the covariance it states; right, in the body frame."""
    noise = np.random.default_rng(seed).standard_normal((POSES, 6)) @ np.linalg.cholesky(scale * COV).T
    # T_true = T_estimate exp(xi)
    poses = sequence.truth.T_world_imu @ se3_inverse(se3_exp(noise))
    return stating(make_run, sequence, poses, np.broadcast_to(COV, (POSES, 6, 6)))


def stating(make_run, sequence, poses, cov):
    trajectory = Trajectory(sequence.frames_t_ns[: len(poses)], poses, cov=cov)
    return make_run(sequence.frames_t_ns, poses, causal=trajectory, final=trajectory)


def nees(run, sequence, output="causal"):
    scores = score(Evaluation(run, output, sequence))
    return [scores.values[key] for key in KEYS]


@pytest.mark.parametrize("output", ["causal", "final"])
def test_exact_draws_have_nees_one_and_are_in_band_at_95_percent(sequence, output):
    pose, ori, pos, in_band = nees(drawn(sequence, make_run), sequence, output)
    # Four sigma: the mean of N chi-square variables over d degrees of freedom scatters by sqrt(2 / (d N)).
    assert pose == pytest.approx(1.0, abs=4.0 * np.sqrt(2.0 / (6 * POSES)))
    assert ori == pytest.approx(1.0, abs=4.0 * np.sqrt(2.0 / (3 * POSES)))
    assert pos == pytest.approx(1.0, abs=4.0 * np.sqrt(2.0 / (3 * POSES)))
    assert in_band == pytest.approx(95.0, abs=4.0 * 100.0 * np.sqrt(0.95 * 0.05 / POSES))


@pytest.mark.parametrize("scale", [0.25, 4.0])
def test_a_wrong_covariance_leaves_the_band(sequence, scale):
    pose, ori, pos, in_band = nees(drawn(sequence, make_run, scale), sequence)
    assert [pose, ori, pos] == pytest.approx([scale] * 3, rel=0.1)
    assert in_band < 60.0


@pytest.mark.parametrize("prior", [None, "elsewhere"])
@pytest.mark.parametrize("motion", ["twist", "imu"])
def test_a_world_of_its_own_is_placed_by_the_first_pose_and_says_so(prior, motion):
    sequence = make_sequence(drive_poses(200), track_count=3, motion=motion)
    elsewhere = se3(about_z(1.0), np.array([10.0, 20.0, 30.0]))
    poses = elsewhere @ drive_poses(200)
    sequence = replace(sequence, prior=None if prior is None else prior_at(poses[0]))
    run = stating(make_run, sequence, poses, np.broadcast_to(COV, (200, 6, 6)))
    scores = score(Evaluation(run, "causal", sequence))
    # A perfect estimate: what is left is rounding, far below the covariance.
    assert scores.values["nees_pose_mean"] < 1e-12
    assert "its own world frame" in scores.notes["nees_pose_mean"]


@pytest.mark.parametrize(("motion", "tilt_is_an_error"), [("imu", True), ("twist", False)])
def test_a_tilted_start_counts_where_an_imu_measures_the_vertical(motion, tilt_is_an_error):
    """Placed by the whole pose, an IMU's run would have its tilt, which it states to 3 mrad, given away."""
    sequence = make_sequence(drive_poses(200), track_count=3, motion=motion)
    tilted = se3_exp(np.array([0.0, 0.05, 0.0, 0.0, 0.0, 0.0])) @ drive_poses(200)
    _, orientation, position, _ = nees(stating(make_run, sequence, tilted, np.broadcast_to(COV, (200, 6, 6))), sequence)
    # (0.05 rad / 0.003 rad)^2 / 3 = 93; along 200 m the position is off by 10 m and more. Else rounding is left.
    assert (orientation > 50.0) == (position > 50.0) == tilt_is_an_error
    assert tilt_is_an_error or max(orientation, position) < 1e-12


def test_a_world_of_its_own_needs_the_truth_of_its_first_pose():
    sequence = make_sequence(drive_poses(50), track_count=3)
    late = replace(sequence, truth=Truth(sequence.truth.t_ns[20:], sequence.truth.T_world_imu[20:]))
    run = stating(make_run, sequence, drive_poses(50), np.broadcast_to(COV, (50, 6, 6)))
    assert nees(run, late) == [None] * 4


def test_a_truth_with_other_stamps_is_interpolated():
    """Truth between the frames: on the geodesic of a smooth path it is off by far less than the covariance."""
    sequence = replace(make_sequence(drive_poses(100), track_count=3), prior=prior_at(drive_poses(100)[0]))
    t_ns = sequence.truth.t_ns
    between = np.concatenate([t_ns[:1], t_ns[:-1] + 30_000_000])
    truth = Truth(between, interpolate_poses(t_ns, sequence.truth.T_world_imu, between))
    run = stating(make_run, sequence, drive_poses(100), np.broadcast_to(COV, (100, 6, 6)))
    evaluation = Evaluation(run, "causal", replace(sequence, truth=truth))
    found = nees_over_time(evaluation)
    assert found.t_ns.tolist() == t_ns[:-1].tolist()  # the last frame is behind the truth's end
    assert found.pose.max() < 0.05


def refused(sequence, run):
    scores = score(Evaluation(run, "causal", sequence))
    assert [scores.values[key] for key in KEYS] == [None] * 4
    return scores.notes["nees_pose_mean"]


def test_missing_nees_has_its_reason(sequence):
    run = drawn(sequence, make_run)
    dependent = replace(sequence, truth=replace(sequence.truth, independent=False))
    assert "agreement proves nothing" in refused(dependent, run)
    assert "no ground truth" in refused(replace(sequence, truth=None), run)
    silent = replace(run, causal=replace(run.causal, cov=None))
    assert "states no covariance" in refused(sequence, silent)
    unknown = replace(run, causal=replace(run.causal, cov=np.full((POSES, 6, 6), np.nan)))
    assert "finite covariance" in refused(sequence, unknown)
    indefinite = replace(run, causal=replace(run.causal, cov=run.causal.cov - 2.0 * np.diag(_SIGMA**2)))
    assert "not positive definite" in refused(sequence, indefinite)


def test_the_band_is_that_of_the_tables():
    """Against printed tables of the chi-square distribution: 6, 100 and 3 degrees of freedom."""
    assert np.array(nees_band(6)) * 6 == pytest.approx([1.24, 14.4], abs=0.05)
    assert np.array(nees_band(2, 50)) * 100 == pytest.approx([74.2, 129.6], abs=0.1)
    assert chi2_quantile(0.95, 3) == pytest.approx(7.815, abs=1e-3)


# Velocity and biases

STATE_KEYS = ("nees_vel_mean", "nees_gyro_bias_mean", "nees_accel_bias_mean")
STATE_SIGMA = np.repeat([0.002, 0.03, 0.05, 0.02, 0.001], 3)  # rotation, position, velocity, both biases
BLOCKS = {"nees_vel_mean": np.s_[6:9], "nees_accel_bias_mean": np.s_[9:12], "nees_gyro_bias_mean": np.s_[12:15]}


def covariance() -> np.ndarray:
    mix = np.eye(15) + 0.3 * np.tri(15, k=-1)
    return np.diag(STATE_SIGMA) @ mix @ mix.T @ np.diag(STATE_SIGMA)


@pytest.fixture
def states():
    made = make_sequence(drive_poses(POSES), track_count=3, motion="imu")
    rng = np.random.default_rng(4)
    truth = replace(made.truth, v_world=rng.normal(0, 5, (POSES, 3)), bias=rng.normal(0, 0.1, (POSES, 6)))
    prior = Prior(truth.T_world_imu[0], np.zeros(3), np.zeros(6), covariance(), "test")
    return replace(made, truth=truth, prior=prior)


def drawn_states(states, make_run, scale=1.0, T_new_old=None):
    """Return a run whose errors are drawn_states from ``scale`` times what it states, in a world of its own."""
    truth, cov = states.truth, covariance()
    T_new_old = np.eye(4) if T_new_old is None else T_new_old
    error = np.random.default_rng(7).standard_normal((POSES, 15)) @ np.linalg.cholesky(scale * cov).T
    poses = truth.T_world_imu @ se3_inverse(se3_exp(error[:, :6]))
    poses[0] = truth.T_world_imu[0]  # the pose by which a world of its own is placed
    v_world = truth.v_world - (poses[:, :3, :3] @ error[:, 6:9, None])[..., 0]
    trajectory = Trajectory(
        states.frames_t_ns,
        T_new_old @ poses,
        v_world=v_world @ T_new_old[:3, :3].T,
        bias=truth.bias - error[:, 9:],
        cov=np.broadcast_to(cov, (POSES, 15, 15)),
    )
    return make_run(states.frames_t_ns, trajectory.T_world_imu, causal=trajectory, final=trajectory)


def values(run, states):
    scores = score(Evaluation(run, "final", states))
    return [scores.values[key] for key in STATE_KEYS], [scores.notes.get(key, "") for key in STATE_KEYS]


@pytest.mark.parametrize("scale", [0.25, 1.0, 4.0])
def test_errors_drawn_from_what_is_stated_have_nees_one(states, scale):
    # Four sigma of a mean of N chi-square variables of three degrees of freedom, over these: 7 % at 4000.
    found, _ = values(drawn_states(states, make_run, scale), states)
    assert found == pytest.approx([scale] * 3, rel=4.0 * np.sqrt(2.0 / (3 * POSES)))


@pytest.mark.parametrize("key", STATE_KEYS)
def test_each_block_is_checked_by_its_own_covariance(states, key):
    """One block stated four times too small in variance shows in its own figure alone."""
    run, cov = drawn_states(states, make_run), np.array(covariance())
    block, others = BLOCKS[key], [other for other in STATE_KEYS if other != key]
    cov[block] *= 0.5
    cov[:, block] *= 0.5
    stated = replace(run.final, cov=np.broadcast_to(cov, (POSES, 15, 15)))
    before = dict(zip(STATE_KEYS, values(run, states)[0], strict=True))
    after = dict(zip(STATE_KEYS, values(replace(run, final=stated), states)[0], strict=True))
    assert after[key] == pytest.approx(4.0 * before[key], rel=1e-9)
    assert [after[other] for other in others] == [before[other] for other in others]


def test_a_state_without_them_says_so(states):
    """A state of nine has a gyro bias; one of six nothing but the pose; a truth may have poses alone."""
    run = drawn_states(states, make_run)
    kept = [*range(6), *range(12, 15)]
    cov = np.broadcast_to(covariance()[np.ix_(kept, kept)], (POSES, 9, 9))
    nine = replace(run.final, v_world=None, cov=cov)
    found, notes = values(replace(run, final=nine), states)
    assert found[0] is None and found[2] is None and found[1] == pytest.approx(1.0, rel=0.1)
    assert "no part of the state" in notes[0] and "no part of the state" in notes[2]
    six = replace(run.final, cov=np.broadcast_to(covariance()[:6, :6], (POSES, 6, 6)))
    assert values(replace(run, final=six), states) == ([None] * 3, ["the covariance is that of the pose alone"] * 3)
    bare = replace(states, truth=Truth(states.truth.t_ns, states.truth.T_world_imu))
    found, notes = values(run, bare)
    assert found == [None] * 3
    assert notes == [f"the ground truth has no {what}" for what in ("velocity", "biases", "biases")]
