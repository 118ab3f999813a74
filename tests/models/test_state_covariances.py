"""The covariances a smoother reports for all of its states are those of GTSAM's marginals."""

from dataclasses import replace
from functools import cache
from typing import NamedTuple

import gtsam
import numpy as np
import pytest

from filters.smoothing import indeterminate
from toolkit.answers import Run
from toolkit.estimate import Trajectory
from toolkit.geometry import Array
from toolkit.measurements import TwistNoise
from toolkit.models import state_covariances
from toolkit.models.factors import L, X, joint_cov, linear_factor
from toolkit.models.graph_state import MotionModel
from toolkit.models.state_covariances import RoundingError, state_covs
from toolkit.models.twist import TwistModel
from toolkit.simulation import DRIVE, FLIGHT, simulate

SHORT = {"drive": replace(DRIVE, duration_s=3.0), "flight": replace(FLIGHT, duration_s=5.0)}


def _refused(*_given: object) -> gtsam.Ordering:
    raise RoundingError("not in this order")


class Smoothed(NamedTuple):
    """What `batch` makes of a short scenario: its run, the solution without covariances and what these are of."""

    run: Run
    solution: Trajectory
    linear: gtsam.GaussianFactorGraph
    motion: MotionModel
    marginals: dict[int, Array]  # of GTSAM, of every fifth state

    def covariances(self) -> tuple[Array | None, tuple[str, ...]]:
        """Return the covariances of all states, or why there are none."""
        trajectory, log = indeterminate.with_covariances(self.solution, self.linear, self.motion)
        return trajectory.cov, log


@pytest.fixture(scope="module")
def smoothed(run_estimator):
    """Return a function that runs `batch` over a scenario, once for all tests."""

    @cache
    def smooth(scenario: str) -> Smoothed:
        calls = []

        def spy(linear, motion, poses):
            calls.append((linear, motion, poses))
            return state_covs(linear, motion, poses)

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(indeterminate, "state_covs", spy)
            run = run_estimator("batch", simulate(SHORT[scenario], 3))
        linear, motion, poses = calls[0]
        tree = linear.eliminateMultifrontal(gtsam.Ordering.ColamdGaussianFactorGraph(linear))
        marginals = {k: motion.state_cov(tree, k, poses[k, :3, :3]) for k in range(0, len(poses), 5)}
        return Smoothed(run, replace(run.final, cov=None), linear, motion, marginals)

    return smooth


def assert_marginals(cov: Array, expected: dict[int, Array]) -> None:
    for k, marginal in expected.items():
        sigmas = np.sqrt(np.diag(marginal))
        np.testing.assert_allclose(cov[k] / np.outer(sigmas, sigmas), marginal / np.outer(sigmas, sigmas), atol=1e-6)


@pytest.mark.parametrize(
    ("scenario", "refused", "most_tied"),
    [("drive", "_dissected", 5), ("flight", "_dissected", 5), ("drive", "_in_time", 50), ("flight", "_in_time", 50)],
)
def test_every_state_has_gtsams_marginal_in_any_order(scenario, refused, most_tied, smoothed, monkeypatch):
    """In the order of time, landmarks among the states or before them, and by nested dissection."""
    problem = smoothed(scenario)
    monkeypatch.setattr(state_covariances, "_MOST_TIED", most_tied)
    monkeypatch.setattr(state_covariances, refused, _refused)
    cov, log = problem.covariances()
    assert log == ()
    assert_marginals(cov, problem.marginals)


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
