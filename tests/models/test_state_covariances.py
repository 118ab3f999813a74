"""The covariances a smoother reports for all of its states are those of GTSAM's marginals."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest

from tests.filters.conftest import Problem, assert_covariances_agree, short
from toolkit.measurements import TwistNoise
from toolkit.models import state_covariances
from toolkit.models.factors import L, X, joint_cov, linear_factor, poses_of
from toolkit.models.state_covariances import RoundingError, state_covs
from toolkit.models.twist import TwistModel
from toolkit.simulation import DRIVE, FLIGHT, simulate


def _refused(*_given: object) -> gtsam.Ordering:
    raise RoundingError("not in this order")


@pytest.mark.parametrize("scenario", [DRIVE, FLIGHT], ids=lambda scenario: scenario.name)
@pytest.mark.parametrize(("refused", "most_tied"), [("_dissected", 5), ("_dissected", 50), ("_in_time", 50)])
def test_every_state_has_gtsams_marginal_in_any_order(scenario, refused, most_tied, monkeypatch):
    """In the order of time, landmarks among the states or before them, and by nested dissection."""
    problem = Problem(short(scenario, 3.0, seed=3))
    linear, motion = problem.graph.linearize(problem.start), problem.motion
    poses = poses_of(problem.start, np.arange(len(problem.frames)))
    monkeypatch.setattr(state_covariances, "_MOST_TIED", most_tied)
    monkeypatch.setattr(state_covariances, refused, _refused)
    covs = state_covs(linear, motion, poses)
    tree = linear.eliminateMultifrontal(gtsam.Ordering.ColamdGaussianFactorGraph(linear))
    for k in range(0, len(poses), 5):
        assert_covariances_agree(covs[k], motion.state_cov(tree, k, poses[k, :3, :3]), 1e-6)


def test_covariances_that_rounding_spoils_are_not_shown(run_estimator, monkeypatch):
    recovered = state_covariances._recovered

    def spoiled(conditionals, together):
        return [1.05 * cov for cov in recovered(conditionals, together)]

    monkeypatch.setattr(state_covariances, "_recovered", spoiled)
    run = run_estimator("batch", simulate(replace(DRIVE, duration_s=1.0), 3))
    assert run.status == "ok"
    assert run.final.cov is None
    assert run.log == ("no covariances of the final states: they were lost to rounding",)


STATES, SIZES = 30, {"x": 6, "b": 3}
TWIST = TwistModel(TwistNoise(np.ones(3), np.ones(3), np.ones(3)))


def _walking_states(step_sigma: float) -> gtsam.GaussianFactorGraph:
    """Return states of which the first has unit covariance, and each follows from the one before it."""
    graph = gtsam.GaussianFactorGraph()
    for k in range(STATES):
        for key, size in zip(TWIST.keys(k), SIZES.values(), strict=True):
            if k == 0:
                graph.add(linear_factor([(key, np.eye(size))], np.zeros(size)))
                continue
            before = TWIST.keys(k - 1)[TWIST.keys(k).index(key)]
            step = np.eye(size) / step_sigma
            graph.add(linear_factor([(before, -step), (key, step)], np.zeros(size)))
    return graph


def test_a_world_far_looser_than_the_steps_in_it_has_covariances():
    """As behind hundreds of frames. GTSAM refuses the clique of two states by its condition; rounding is 1e-5 here."""
    graph, poses = _walking_states(1e-4), np.tile(np.eye(4), (STATES, 1, 1))
    last = gtsam.Ordering.ColamdConstrainedLastGaussianFactorGraph(graph, TWIST.keys(0))
    with pytest.raises(RuntimeError, match="Indeterminate"):
        joint_cov(graph.eliminateMultifrontal(last), TWIST.keys(0))
    covs = state_covs(graph, TWIST, poses)
    expected = 1.0 + 1e-8 * np.arange(STATES)
    np.testing.assert_allclose(covs[:, range(9), range(9)], np.tile(expected[:, None], 9), rtol=1e-4)


@pytest.mark.parametrize("wanted", [1e-7, 1e-12, 0.0])
def test_a_landmark_at_infinity_leaves_the_states_their_covariances(wanted):
    """Its depth in metres is told by next to nothing, of which GTSAM refuses it; or by nothing at all."""
    rng, poses = np.random.default_rng(4), np.tile(np.eye(4), (STATES, 1, 1))
    near, far = _walking_states(0.1), _walking_states(0.1)
    turned = np.linalg.qr(rng.standard_normal((3, 3)))[0]
    in_metres = turned @ np.diag([1.0, 1.0, wanted]) @ turned.T
    for k in range(0, STATES, 5):
        of_pose, of_landmark = rng.standard_normal((3, 6)), rng.standard_normal((3, 3))
        if wanted < 1e-10:  # two directions of the landmark, and nothing of a third
            near.add(linear_factor([(X(k), of_pose), (L(0), of_landmark @ turned[:, :2])], np.zeros(3)))
        else:
            near.add(linear_factor([(X(k), of_pose), (L(0), of_landmark)], np.zeros(3)))
        far.add(linear_factor([(X(k), of_pose), (L(0), of_landmark @ in_metres)], np.zeros(3)))
    with pytest.raises(RuntimeError, match="Indeterminate"):
        far.eliminateSequential(gtsam.Ordering.ColamdGaussianFactorGraph(far))
    # The Jacobian in metres has the depth's share of sixteen digits: 1e-9 of them at 1e-7.
    np.testing.assert_allclose(state_covs(far, TWIST, poses), state_covs(near, TWIST, poses), rtol=1e-6, atol=1e-9)
