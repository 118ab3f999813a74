"""The window of fixed-lag goes on after what would end GTSAM's, and a tree built anew has the same estimates."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest

from filters.fixed_lag import FixedLag
from filters.smoothing import indeterminate
from filters.smoothing.fixed_lag_tree import FixedLagTree
from filters.smoothing.graph_builder import GraphExtension
from tests.filters.conftest import off_at_the_end_m, recording_with_a_fleck, setup_of, short
from toolkit.geometry import Array
from toolkit.measurements import NS_PER_S
from toolkit.models.factors import L, X
from toolkit.settings import Outliers, Settings
from toolkit.simulation import DRIVE, DRIVE_IMU, FLIGHT, simulate
from toolkit.simulation.faults import moving_vehicles


def position_of(window: FixedLagTree, k: int) -> Array:
    return np.asarray(window.values().atPoint3(X(k)))


UNIT = gtsam.noiseModel.Unit.Create(3)


def chain_link(k: int, off_m: float = 1.0, step: gtsam.noiseModel.Base = UNIT) -> GraphExtension:
    """Return a position X(k), one step of a metre from the last, and a fix of it that is off by so much times k."""
    extension = GraphExtension(state_keys=[X(k)])
    extension.values.insert(X(k), np.array([1.0 * k, 0.0, 0.0]))
    if k:
        extension.factors.add(gtsam.BetweenFactorPoint3(X(k - 1), X(k), np.array([1.0, 0.0, 0.0]), step))
    extension.factors.addPriorPoint3(X(k), np.array([(1.0 + off_m) * k, 0.0, 0.0]), UNIT)
    return extension


def test_a_linear_chain_has_its_exact_answer_after_the_tree_is_built_anew_in_every_frame():
    """Nothing is lost by marginalising a linear problem: the newest position is that of all factors ever added.

    The fixes pull each position away from where it begins, beyond the threshold of relinearisation: a prior that
    followed its variables there would pull the less.
    """
    window, everything = FixedLagTree(2 * NS_PER_S), gtsam.NonlinearFactorGraph()
    start = gtsam.Values()
    for k in range(8):
        extension = chain_link(k)
        everything.push_back(extension.factors)
        start.insert(extension.values)
        window.add(extension, k * NS_PER_S)
        assert window.rebuild().log == []
        exact = start.retract(everything.linearize(start).optimize())
        # Eight digits are left of sixteen by normal equations of this condition, and more.
        np.testing.assert_allclose(position_of(window, k), exact.atPoint3(X(k)), atol=1e-9)
    assert np.linalg.norm(exact.atPoint3(X(7)) - start.atPoint3(X(7))) > 1.0


def test_states_that_hang_together_far_better_than_on_the_world_are_solved_by_cholesky():
    """As with a good IMU after minutes: a clique of two such states is beyond the condition that GTSAM allows one."""
    window, stiff = FixedLagTree(2 * NS_PER_S), gtsam.noiseModel.Isotropic.Sigma(3, 1e-6)
    everything, start = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for k in range(6):
        extension = chain_link(k, 0.1, stiff)
        everything.push_back(extension.factors)
        start.insert(extension.values)
        assert window.add(extension, k * NS_PER_S).log == []
    exact = start.retract(everything.linearize(start).optimizeDensely())
    # A condition of 1e12 leaves four digits of sixteen; the positions are some metres.
    np.testing.assert_allclose(position_of(window, 5), exact.atPoint3(X(5)), atol=1e-3)


def test_a_point_that_moves_with_the_car_does_not_end_it(run_estimator):
    """It ended as failed: solved by QR, the point showed to be indeterminate only when it was read."""
    run = run_estimator("fixed-lag", recording_with_a_fleck(replace(DRIVE_IMU, duration_s=12.5), 2, 1, 3.0))
    assert run.status != "failed", run.log
    assert np.isfinite(run.final.T_world_imu).all()


def test_a_landmark_that_is_indeterminate_though_held_is_dropped_with_its_sightings(monkeypatch):
    """A hold that holds nothing stands for one that is too weak."""
    monkeypatch.setattr(indeterminate, "WEAK_SIGMA", 1e200)
    window, extension = FixedLagTree(NS_PER_S), chain_link(0)
    extension.landmark_ids = [5, 6]
    for i, seen in ((5, 1.0), (6, 0.0)):
        information = gtsam.noiseModel.Diagonal.Precisions(np.full(3, seen))
        extension.values.insert(L(i), np.ones(3))
        extension.factors.add(gtsam.BetweenFactorPoint3(X(0), L(i), np.ones(3), information))
    recovery = window.add(extension, 0)
    assert [line.split(" ", 3)[0] for line in recovery.log] == ["l6", "l6"]
    assert "has a weak prior at its value" in recovery.log[0]
    assert "was dropped" in recovery.log[1]
    assert recovery.dropped == {6}
    assert not window.values().exists(L(6))
    assert window.add(chain_link(1), NS_PER_S).log == []


def test_a_landmark_dropped_with_its_sightings_leaves_to_the_others_what_it_contributed_before():
    """The position that saw it has left, so the prior holds the landmark: it is marginalised, not cut out."""
    window, everything, start = FixedLagTree(2 * NS_PER_S), gtsam.NonlinearFactorGraph(), gtsam.Values()
    for k in range(5):
        extension = chain_link(k)
        sighting = gtsam.BetweenFactorPoint3(X(k), L(5), np.array([7.0 - k, 0.0, 0.0]), UNIT)
        extension.landmark_ids = [5]
        if k == 0:
            extension.values.insert(L(5), np.array([7.0, 0.0, 0.0]))
        everything.push_back(extension.factors)
        start.insert(extension.values)
        extension.factors.add(sighting)
        if k < 2:  # those of the positions that have left by the end
            everything.add(sighting)
        assert window.add(extension, k * NS_PER_S).log == []
    assert window.drop([5]).log == []
    assert not window._isam.valueExists(L(5))
    exact = start.retract(everything.linearize(start).optimize())
    np.testing.assert_allclose(position_of(window, 4), exact.atPoint3(X(4)), atol=1e-9)


def test_landmarks_without_a_depth_are_dropped_where_gtsam_names_another():
    """It names the first variable of a clique. Of what moves as fast as the camera, the depth grows without end."""
    sequence = moving_vehicles(simulate(replace(DRIVE, duration_s=4.5), seed=1), dose=0.6, seed=1)
    ungated = Settings(outliers=Outliers(gate_probability=None))  # the gate refuses the vehicles
    estimator = FixedLag(replace(setup_of(sequence), settings=ungated), 0.6)
    answers_there = [estimator.step(packet) for packet in sequence.packets()]
    log = estimator.finish().log
    assert any("in all" in line for line in log)
    # 45 m of odometry that is good to 0.1 m: what vehicles take vision to is not more than a metre off.
    assert off_at_the_end_m(sequence, answers_there[-1]) < 1.0


class BrokenOff:
    """A tree whose update was refused after it had taken factors out: their variable is still among the values."""

    def __init__(self, whole: gtsam.ISAM2, lost: int) -> None:
        self._whole, self._lost = whole, lost

    def getFactorsUnsafe(self) -> gtsam.NonlinearFactorGraph:  # noqa: N802 - GTSAM's name
        kept, whole = gtsam.NonlinearFactorGraph(), self._whole.getFactorsUnsafe()
        for factor in (whole.at(slot) for slot in range(whole.size()) if whole.exists(slot)):
            if self._lost not in list(factor.keys()):
                kept.add(factor)
        return kept

    def __getattr__(self, name: str) -> object:
        return getattr(self._whole, name)


@pytest.mark.parametrize(("distance_m", "sigma_m"), [(5.0, 1.0), (2e4, 2e3)])
def test_the_weak_prior_of_a_landmark_is_a_tenth_of_a_radian_or_wider(distance_m, sigma_m):
    """Held by a metre, one at 20 km told all attitudes to 0.05 mrad."""
    values = gtsam.Values()
    values.insert(X(0), gtsam.Pose3(gtsam.Rot3(), np.array([100.0, 0.0, 0.0])))
    values.insert(L(7), np.array([100.0, distance_m, 0.0]))
    jacobian, residual = indeterminate.weak_prior(L(7), values).linearize(values).jacobian()
    np.testing.assert_allclose(jacobian, np.eye(3) / sigma_m)
    np.testing.assert_array_equal(residual, 0.0)


def test_a_landmark_without_sightings_does_not_come_into_a_tree_built_anew():
    """GTSAM, asked to marginalise a variable that is in no clique, ends the process."""
    window, extension = FixedLagTree(2 * NS_PER_S), chain_link(0)
    extension.landmark_ids = [5]
    extension.values.insert(L(5), np.array([7.0, 0.0, 0.0]))
    extension.factors.add(gtsam.BetweenFactorPoint3(X(0), L(5), np.array([7.0, 0.0, 0.0]), UNIT))
    assert window.add(extension, 0).log == []
    window._isam = BrokenOff(window._isam, L(5))
    assert window.rebuild().log == []
    assert not window.values().exists(L(5))
    for k in range(1, 4):
        assert window.add(chain_link(k), k * NS_PER_S).log == []


def test_an_imu_so_good_that_a_covariance_is_refused_does_not_end_it(run_estimator):
    """GTSAM multiplies cliques to read a covariance; of the oldest state of the first full window it refused it."""
    sequence = short(FLIGHT, 2.5, 30, 4)
    run = run_estimator("fixed-lag", replace(sequence, noise=sequence.noise.scaled(0.01)))
    assert run.status == "ok"
    assert any("indeterminate to rounding in a covariance: solved by QR" in line for line in run.log)
    assert run.causal.t_ns.size == run.final.t_ns.size == sequence.frame_count
    assert np.isfinite(run.final.cov).all()
