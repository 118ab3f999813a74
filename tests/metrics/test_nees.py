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
from toolkit.metrics.parts.consistency import nees_band, nees_over_time
from toolkit.sequence import Truth

POSES = 4000
KEYS = ("nees_pose_mean", "nees_ori_mean", "nees_pos_mean", "nees_pose_in_band_percent")
# What a velocity and biases have, and where they stand in a covariance.
BLOCKS = {"nees_vel_mean": np.s_[6:9], "nees_gyro_bias_mean": np.s_[12:15], "nees_accel_bias_mean": np.s_[9:12]}
# Of one unit to another, correlated: what forgetting a transpose or a block would get wrong.
_SIGMA = np.r_[0.001, 0.003, 0.002, 0.05, 0.01, 0.1, np.repeat([0.05, 0.02, 0.001], 3)]
_MIX = np.eye(15) + 0.3 * np.tri(15, k=-1)
COV = np.diag(_SIGMA) @ _MIX @ _MIX.T @ np.diag(_SIGMA)


def prior_at(pose):
    return Prior(pose, np.zeros(3), np.zeros(6), COV, "test")


@pytest.fixture
def sequence():
    """Return a recording with an IMU, whose truth has velocities and biases."""
    made = make_sequence(drive_poses(POSES), track_count=3, motion="imu")
    rng = np.random.default_rng(4)
    truth = replace(made.truth, v_world=rng.normal(0, 5, (POSES, 3)), bias=rng.normal(0, 0.1, (POSES, 6)))
    return replace(made, truth=truth, prior=prior_at(truth.T_world_imu[0]))


def drawn(sequence, scale=1.0):
    """Return a run whose errors are drawn from ``scale`` times the covariance it states; right, in the body frame."""
    truth = sequence.truth
    error = np.random.default_rng(7).standard_normal((POSES, 15)) @ np.linalg.cholesky(scale * COV).T
    # T_true = T_estimate exp(xi)
    poses = truth.T_world_imu @ se3_inverse(se3_exp(error[:, :6]))
    poses[0] = truth.T_world_imu[0]  # the pose by which a world of its own is placed
    v_world = truth.v_world - (poses[:, :3, :3] @ error[:, 6:9, None])[..., 0]
    return stating(sequence, poses, COV, v_world=v_world, bias=truth.bias - error[:, 9:])


def stating(sequence, poses, cov, **states):
    covs = np.broadcast_to(cov, (len(poses), *cov.shape))
    trajectory = Trajectory(sequence.frames_t_ns[: len(poses)], poses, cov=covs, **states)
    return make_run(sequence.frames_t_ns, poses, causal=trajectory, final=trajectory)


def nees(run, sequence, output="causal", keys=KEYS):
    scores = score(Evaluation(run, output, sequence))
    return [scores.values[key] for key in keys]


@pytest.mark.parametrize("output", ["causal", "final"])
def test_exact_draws_have_nees_one_and_are_in_band_at_95_percent(sequence, output):
    run = drawn(sequence)
    # Four sigma: the mean of N chi-square variables over d degrees of freedom scatters by sqrt(2 / (d N)).
    assert nees(run, sequence, output, KEYS[:1]) == pytest.approx([1.0], abs=4.0 * np.sqrt(2.0 / (6 * POSES)))
    parts = nees(run, sequence, output, [*KEYS[1:3], *BLOCKS])
    assert parts == pytest.approx([1.0] * 5, abs=4.0 * np.sqrt(2.0 / (3 * POSES)))
    in_band = nees(run, sequence, output)[3]
    assert in_band == pytest.approx(95.0, abs=4.0 * 100.0 * np.sqrt(0.95 * 0.05 / POSES))


@pytest.mark.parametrize("scale", [0.25, 4.0])
def test_a_wrong_covariance_leaves_the_band(sequence, scale):
    *of_states, in_band = nees(drawn(sequence, scale), sequence, keys=[*BLOCKS, *KEYS])
    assert of_states == pytest.approx([scale] * 6, rel=4.0 * np.sqrt(2.0 / (3 * POSES)))
    assert in_band < 60.0


@pytest.mark.parametrize("prior", [None, "elsewhere"])
@pytest.mark.parametrize(("motion", "tilt_is_an_error"), [("imu", True), ("twist", False)])
def test_a_world_of_its_own_is_placed_by_the_first_pose_and_says_so(prior, motion, tilt_is_an_error):
    """Placed by the whole pose, an IMU's run would have its tilt, which it states to 3 mrad, given away."""
    sequence = make_sequence(drive_poses(200), track_count=3, motion=motion)
    poses = se3(about_z(1.0), np.array([10.0, 20.0, 30.0])) @ drive_poses(200)
    sequence = replace(sequence, prior=None if prior is None else prior_at(poses[0]))
    scores = score(Evaluation(stating(sequence, poses, COV[:6, :6]), "causal", sequence))
    # A perfect estimate: what is left is rounding, far below the covariance.
    assert scores.values["nees_pose_mean"] < 1e-12
    assert "its own world frame" in scores.notes["nees_pose_mean"]
    tilted = se3_exp(np.array([0.0, 0.05, 0.0, 0.0, 0.0, 0.0])) @ drive_poses(200)
    _, orientation, position, _ = nees(stating(sequence, tilted, COV[:6, :6]), replace(sequence, prior=None))
    # (0.05 rad / 0.003 rad)^2 / 3 = 93; along 200 m the position is off by 10 m and more. Else rounding is left.
    assert (orientation > 50.0) == (position > 50.0) == tilt_is_an_error
    assert tilt_is_an_error or max(orientation, position) < 1e-12


def test_a_world_of_its_own_needs_the_truth_of_its_first_pose():
    sequence = make_sequence(drive_poses(50), track_count=3)
    late = replace(sequence, truth=Truth(sequence.truth.t_ns[20:], sequence.truth.T_world_imu[20:]))
    run = stating(sequence, drive_poses(50), COV[:6, :6])
    assert nees(run, late) == [None] * 4


def test_a_truth_with_other_stamps_is_interpolated():
    """Truth between the frames: on the geodesic of a smooth path it is off by far less than the covariance."""
    sequence = replace(make_sequence(drive_poses(100), track_count=3), prior=prior_at(drive_poses(100)[0]))
    t_ns = sequence.truth.t_ns
    between = np.concatenate([t_ns[:1], t_ns[:-1] + 30_000_000])
    truth = Truth(between, interpolate_poses(t_ns, sequence.truth.T_world_imu, between))
    run = stating(sequence, drive_poses(100), COV[:6, :6])
    evaluation = Evaluation(run, "causal", replace(sequence, truth=truth))
    found = nees_over_time(evaluation)
    assert found.t_ns.tolist() == t_ns[:-1].tolist()  # the last frame is behind the truth's end
    assert found.pose.max() < 0.05


def refused(sequence, run):
    scores = score(Evaluation(run, "causal", sequence))
    assert [scores.values[key] for key in KEYS] == [None] * 4
    return scores.notes["nees_pose_mean"]


def test_missing_nees_has_its_reason(sequence):
    run = drawn(sequence)
    dependent = replace(sequence, truth=replace(sequence.truth, independent=False))
    assert "agreement proves nothing" in refused(dependent, run)
    assert "no ground truth" in refused(replace(sequence, truth=None), run)
    silent = replace(run, causal=replace(run.causal, cov=None))
    assert "states no covariance" in refused(sequence, silent)
    unknown = replace(run, causal=replace(run.causal, cov=np.full((POSES, 15, 15), np.nan)))
    assert "finite covariance" in refused(sequence, unknown)
    indefinite = replace(run, causal=replace(run.causal, cov=run.causal.cov - 2.0 * np.diag(_SIGMA**2)))
    assert "not positive definite" in refused(sequence, indefinite)


def test_the_band_is_that_of_the_tables():
    """Against printed tables of the chi-square distribution: 6, 100 and 3 degrees of freedom."""
    assert np.array(nees_band(6)) * 6 == pytest.approx([1.24, 14.4], abs=0.05)
    assert np.array(nees_band(2, 50)) * 100 == pytest.approx([74.2, 129.6], abs=0.1)


def of_states(run, sequence):
    scores = score(Evaluation(run, "final", sequence))
    return [scores.values[key] for key in BLOCKS], [scores.notes.get(key, "") for key in BLOCKS]


def test_a_state_without_them_says_so(sequence):
    """A state of nine has a gyro bias; one of six nothing but the pose; a truth may have poses alone."""
    run = drawn(sequence)
    kept = [*range(6), *range(12, 15)]
    nine = replace(run.final, v_world=None, cov=np.broadcast_to(COV[np.ix_(kept, kept)], (POSES, 9, 9)))
    (velocity, gyro, accelerometer), notes = of_states(replace(run, final=nine), sequence)
    assert velocity is None and accelerometer is None and gyro == pytest.approx(1.0, rel=0.1)
    assert "no part of the state" in notes[0] and "no part of the state" in notes[2]
    six = replace(run.final, cov=np.broadcast_to(COV[:6, :6], (POSES, 6, 6)))
    of_pose = of_states(replace(run, final=six), sequence)
    assert of_pose == ([None] * 3, ["the covariance is that of the pose alone"] * 3)
    bare = replace(sequence, truth=Truth(sequence.truth.t_ns, sequence.truth.T_world_imu))
    found, notes = of_states(run, bare)
    assert found == [None] * 3
    assert notes == [f"the ground truth has no {what}" for what in ("velocity", "biases", "biases")]
