"""NEES of velocity and biases: draws from what is stated are consistent, in any world, and what is lacking is said."""

from dataclasses import replace

import numpy as np
import pytest

from toolkit.estimate import Trajectory
from toolkit.geometry import se3_exp, se3_inverse
from toolkit.measurements import Prior
from toolkit.metrics import Evaluation
from toolkit.metrics.nees import score
from toolkit.sequence import Truth

FRAMES = 4000
KEYS = ("nees_vel_mean", "nees_gyro_bias_mean", "nees_accel_bias_mean")
SIGMA = np.repeat([0.002, 0.03, 0.05, 0.02, 0.001], 3)  # rotation, position, velocity, accelerometer and gyro bias
BLOCKS = {"nees_vel_mean": np.s_[6:9], "nees_accel_bias_mean": np.s_[9:12], "nees_gyro_bias_mean": np.s_[12:15]}


def covariance() -> np.ndarray:
    mix = np.eye(15) + 0.3 * np.tri(15, k=-1)
    return np.diag(SIGMA) @ mix @ mix.T @ np.diag(SIGMA)


@pytest.fixture
def sequence(make_sequence, drive):
    made = make_sequence(drive(FRAMES), track_count=3, motion="imu")
    rng = np.random.default_rng(4)
    truth = replace(made.truth, v_world=rng.normal(0, 5, (FRAMES, 3)), bias=rng.normal(0, 0.1, (FRAMES, 6)))
    prior = Prior(truth.T_world_imu[0], np.zeros(3), np.zeros(6), covariance(), "test")
    return replace(made, truth=truth, prior=prior)


def drawn(sequence, make_run, scale=1.0, T_new_old=None):
    """Return a run whose errors are drawn from ``scale`` times what it states, in a world of its own."""
    truth, cov = sequence.truth, covariance()
    T_new_old = np.eye(4) if T_new_old is None else T_new_old
    error = np.random.default_rng(7).standard_normal((FRAMES, 15)) @ np.linalg.cholesky(scale * cov).T
    poses = truth.T_world_imu @ se3_inverse(se3_exp(error[:, :6]))
    poses[0] = truth.T_world_imu[0]  # the pose by which a world of its own is placed
    v_world = truth.v_world - (poses[:, :3, :3] @ error[:, 6:9, None])[..., 0]
    trajectory = Trajectory(
        sequence.frames_t_ns,
        T_new_old @ poses,
        v_world=v_world @ T_new_old[:3, :3].T,
        bias=truth.bias - error[:, 9:],
        cov=np.broadcast_to(cov, (FRAMES, 15, 15)),
    )
    return make_run(sequence.frames_t_ns, trajectory.T_world_imu, causal=trajectory, final=trajectory)


def values(run, sequence):
    scores = score(Evaluation(run, "final", sequence))
    return [scores.values[key] for key in KEYS], [scores.notes.get(key, "") for key in KEYS]


@pytest.mark.parametrize("scale", [0.25, 1.0, 4.0])
def test_errors_drawn_from_what_is_stated_have_nees_one(sequence, make_run, scale):
    # Four sigma of a mean of N chi-square variables of three degrees of freedom, over these: 7 % at 4000.
    found, _ = values(drawn(sequence, make_run, scale), sequence)
    assert found == pytest.approx([scale] * 3, rel=4.0 * np.sqrt(2.0 / (3 * FRAMES)))


@pytest.mark.parametrize("key", KEYS)
def test_each_block_is_checked_by_its_own_covariance(sequence, make_run, key):
    """One block stated four times too small in variance shows in its own figure alone."""
    run, cov = drawn(sequence, make_run), np.array(covariance())
    block, others = BLOCKS[key], [other for other in KEYS if other != key]
    cov[block] *= 0.5
    cov[:, block] *= 0.5
    stated = replace(run.final, cov=np.broadcast_to(cov, (FRAMES, 15, 15)))
    before = dict(zip(KEYS, values(run, sequence)[0], strict=True))
    after = dict(zip(KEYS, values(replace(run, final=stated), sequence)[0], strict=True))
    assert after[key] == pytest.approx(4.0 * before[key], rel=1e-9)
    assert [after[other] for other in others] == [before[other] for other in others]


def test_a_state_without_them_says_so(sequence, make_run, make_sequence, drive):
    """A state of nine has a gyro bias; one of six nothing but the pose; a truth may have poses alone."""
    run = drawn(sequence, make_run)
    kept = [*range(6), *range(12, 15)]
    cov = np.broadcast_to(covariance()[np.ix_(kept, kept)], (FRAMES, 9, 9))
    nine = replace(run.final, v_world=None, cov=cov)
    found, notes = values(replace(run, final=nine), sequence)
    assert found[0] is None and found[2] is None and found[1] == pytest.approx(1.0, rel=0.1)
    assert "no part of the state" in notes[0] and "no part of the state" in notes[2]
    six = replace(run.final, cov=np.broadcast_to(covariance()[:6, :6], (FRAMES, 6, 6)))
    assert values(replace(run, final=six), sequence) == ([None] * 3, ["the covariance is that of the pose alone"] * 3)
    bare = replace(sequence, truth=Truth(sequence.truth.t_ns, sequence.truth.T_world_imu))
    found, notes = values(run, bare)
    assert found == [None] * 3
    assert notes == [f"the ground truth has no {what}" for what in ("velocity", "biases", "biases")]
