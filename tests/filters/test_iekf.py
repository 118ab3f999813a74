"""The iterated update is the converged Gauss-Newton of a smoother with no lag, over the predicted Gaussian.

The smoother is GTSAM's: the predicted joint belief as one factor on pose and landmarks, and the stereo factors that the
graph estimators use.
"""

from copy import copy
from functools import partial
from typing import NamedTuple

import gtsam
import numpy as np
import pytest

from filters import iekf
from filters.ekf_slam import JointEkf
from filters.kalman.coordinates import AnchoredBelief, inverse_depth, inverse_depth_jacobian
from filters.kalman.joint import AtLatestEstimates, JointBelief, marginalise_lost, propagate
from filters.kalman.online_output import LandmarkMemory
from tests.filters.conftest import setup_of, short
from tests.models.conftest import numerical_jacobian
from toolkit.geometry import Array, se3_exp, se3_inverse, se3_log, skew, so3_left_jacobian, transform
from toolkit.measurements import StereoFrame, StereoRig
from toolkit.models.factors import L, StereoFactors, X
from toolkit.models.gating import FrameGate
from toolkit.models.motion import motion_model
from toolkit.simulation import DRIVE, FLIGHT

AT = AtLatestEstimates()
both_kinds = pytest.mark.parametrize("scenario", [DRIVE, FLIGHT], ids=["twist", "imu"])


class Scene(NamedTuple):
    """A joint belief carried to a frame, the pose cloned, and that frame, showing the state's landmarks only."""

    joint: JointBelief
    frame: StereoFrame
    rig: StereoRig

    def measurement(self) -> iekf.Measurement:
        return iekf.Measurement(self.joint, self.frame, AT, self.rig, np.ones(len(self.joint.points), dtype=bool))


def scene(scenario, disturbed: float = 2.0) -> Scene:
    """Return a belief that was filtered for six frames, some standard deviations from where it would have been."""
    sequence = short(scenario, 1.0, 12, 3)
    ekf = JointEkf(setup_of(sequence), AT, partial(AnchoredBelief, T_imu_cam=sequence.rig.T_imu_cam))
    *packets, last = list(sequence.packets())[:7]
    for packet in packets:
        ekf.step(packet)
    joint = ekf.joint
    propagate(joint, motion_model(sequence.noise, sequence.gravity_world), AT, last.motion)
    marginalise_lost(joint, last.frame, LandmarkMemory())
    assert len(joint.landmark_ids) > 5
    drawn = np.random.default_rng(8).standard_normal(joint.cov.shape[0])
    joint.move(disturbed * np.linalg.cholesky(joint.cov) @ drawn)
    joint.clone()
    return Scene(joint, last.frame.select(np.isin(last.frame.track_ids, joint.landmark_ids)), sequence.rig)


@both_kinds
def test_a_move_is_the_groups_and_leaves_the_covariance_of_the_errors_that_it_moves(scenario) -> None:
    """The error by its definition, differentiated before and after a move: what the move must be and carry over."""
    joint, *_ = scene(scenario)
    joint.marginalise_clones(1)
    start, before, P = copy(joint), d_error(joint), joint.cov
    delta = np.linalg.cholesky(P) @ np.random.default_rng(4).standard_normal(len(P))
    joint.move(delta)
    moved_by = before @ delta
    if joint.core.layout.velocity is not None:  # of exp(xi), the logarithm is taken of the pose alone
        moved_by[6:9] = so3_left_jacobian(moved_by[:3]) @ moved_by[6:9]
    np.testing.assert_allclose(error_of(start, joint), moved_by, rtol=0.0, atol=1e-9)
    carry = np.linalg.solve(d_error(joint), before)
    sigma = np.sqrt(np.diag(joint.cov))
    assert np.abs((joint.cov - carry @ P @ carry.T) / np.outer(sigma, sigma)).max() < 1e-8
    assert np.abs((joint.cov - P) / np.outer(sigma, sigma)).max() > 1e-3, "the move was too small to tell"


def d_error(joint: AnchoredBelief) -> Array:
    """Return the derivative (n, n) of the error by the errors in which the covariance is kept."""
    plain = JointBelief(joint.core)
    plain.landmark_ids, plain.points, plain._cov = joint.landmark_ids, joint.points, joint.cov
    return numerical_jacobian(lambda delta: error_of(joint, plain.displaced(delta)), joint.cov.shape[0])


def error_of(here: AnchoredBelief, off: JointBelief) -> Array:
    """Return the error of another state: of the pose in the world, of vectors turned with it, of depths, and biases."""
    moved, core = off.core.T_world_imu @ se3_inverse(here.core.T_world_imu), here.core.layout
    parts = [se3_log(moved)]
    if core.velocity is not None:
        parts.append(off.core.v_world - moved[:3, :3] @ here.core.v_world)
    anchors_now, anchors = moved @ here.anchors, here.anchors
    now = inverse_depth(transform(se3_inverse(anchors_now), off.points))
    parts.append((now - inverse_depth(transform(se3_inverse(anchors), here.points))).reshape(-1))
    kept = slice(0 if core.accel_bias is not None else 3, 6)
    return np.concatenate([*parts, off.core.bias[kept] - here.core.bias[kept]])


def test_inverse_depth_is_its_own_inverse_and_has_that_jacobian() -> None:
    points = np.array([[1.0, -2.0, 5.0], [0.1, 0.2, 0.7], [-3.0, 1.0, -4.0]])
    np.testing.assert_allclose(inverse_depth(inverse_depth(points)), points, rtol=1e-14)
    for point in points:
        expected = numerical_jacobian(lambda d, at=point: inverse_depth(at + d), 3)
        np.testing.assert_allclose(inverse_depth_jacobian(point), expected, rtol=0.0, atol=1e-9)


class LagZero:
    """A graph of one pose and the landmarks: the prediction as a Gaussian, and the sightings of one frame."""

    def __init__(self, given: Scene) -> None:
        self._joint, part = given.joint, given.measurement().part
        self._keys = [*(L(i) for i in given.joint.landmark_ids.tolist()), X(0)]
        noise = gtsam.noiseModel.Gaussian.Covariance(given.joint.cov[part, part])
        self._sightings = list(StereoFactors(given.rig).of(given.frame, 0))
        self._graph = gtsam.NonlinearFactorGraph()
        self._graph.add(gtsam.CustomFactor(noise, self._keys, self._residual))
        for factor in self._sightings:
            self._graph.add(factor)

    def solved(self) -> gtsam.Values:
        """Return the minimum, by GTSAM's Gauss-Newton from the prediction."""
        values = self.values(self._joint.core.T_world_imu, self._joint.points)
        params = gtsam.GaussNewtonParams()
        params.setMaxIterations(50)
        params.setRelativeErrorTol(1e-15)
        params.setAbsoluteErrorTol(1e-15)
        return gtsam.GaussNewtonOptimizer(self._graph, values, params).optimize()

    def values(self, T_world_imu: Array, points: Array) -> gtsam.Values:
        values = gtsam.Values()
        values.insert(X(0), gtsam.Pose3(T_world_imu))
        for key, point in zip(self._keys[:-1], points, strict=True):
            values.insert(key, point)
        return values

    def sightings_information(self, T_world_imu: Array, points: Array) -> Array:
        """Return H^T H of GTSAM's own linearisation of the sightings, the pose last."""
        graph, ordering = gtsam.NonlinearFactorGraph(), gtsam.Ordering()
        for factor in self._sightings:
            graph.add(factor)
        for key in self._keys:
            ordering.push_back(key)
        return np.asarray(graph.linearize(self.values(T_world_imu, points)).hessian(ordering)[0])

    def _residual(self, this: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[Array] | None) -> Array:
        T, points = values.atPose3(X(0)).matrix(), np.array([values.atPoint3(k) for k in self._keys[:-1]])
        error = self._error(T, points)
        if jacobians is not None:
            jacobians[len(points)] = numerical_jacobian(lambda d: self._error(T @ se3_exp(d), points), 6)
            for i in range(len(points)):
                jacobians[i] = numerical_jacobian(
                    lambda d, i=i: self._error(T, points + np.eye(len(points))[i][:, None] * d), 3
                )
        return error

    def _error(self, T: Array, points: Array) -> Array:
        """Return the move (k,) that leads here from the prediction: relative inverse depths, and a pose."""
        T_imu_world, turn = se3_inverse(self._joint.core.T_world_imu), self._joint.core.T_world_imu[:3, :3]
        predicted, anchors = self._joint.points, self._joint.anchors
        pose = se3_log(T_imu_world @ T)
        at_first = transform(se3_inverse(anchors), predicted)
        now = transform(se3_inverse(T @ T_imu_world @ anchors), points)
        change = (inverse_depth(now) - inverse_depth(at_first))[..., None]
        relative = anchors[:, :3, :3] @ np.linalg.solve(inverse_depth_jacobian(at_first), change)
        with_pose = turn @ pose[3:] - skew(predicted - self._joint.core.T_world_imu[:3, 3]) @ (turn @ pose[:3])
        return np.concatenate([(relative[..., 0] + with_pose).reshape(-1), pose])


@both_kinds
def test_it_is_a_lag_zero_smoother_at_convergence(scenario) -> None:
    """In the mean, and in the covariance: ``(P^-1 + H^T H)^-1`` with GTSAM's Jacobians at the corrected estimate."""
    joint, frame, rig = given = scene(scenario)
    graph, measurement = LagZero(given), given.measurement()
    part = measurement.part
    smoothed = graph.solved()
    pose = smoothed.atPose3(X(0)).matrix()
    points = np.array([smoothed.atPoint3(L(i)) for i in joint.landmark_ids.tolist()])
    nothing = measurement.after(np.zeros(joint.cov.shape[0] - joint.landmark_columns.start))
    single = joint.displaced(measurement.after(measurement.step(nothing)[0]).delta)
    moved = copy(joint)
    moved.move(iekf.most_probable(measurement)[0].delta)
    gate = FrameGate(probability=1.0)
    iekf.correct(joint, frame, AT, rig, gate)

    assert gate.unconverged == 0
    assert np.abs(joint.points - points).max() < 1e-6
    assert np.abs(se3_log(se3_inverse(pose) @ joint.core.T_world_imu)).max() < 1e-6
    np.testing.assert_allclose(joint.clones[-1], joint.core.T_world_imu, rtol=0.0, atol=1e-12)
    assert np.abs(single.points - points).max() > 1e-4, "one update is not enough"
    information = graph.sightings_information(moved.core.T_world_imu, moved.points)
    expected = np.linalg.inv(np.linalg.inv(moved.cov[part, part]) + information)
    sigma = np.sqrt(np.diag(expected))
    assert np.abs((joint.cov[part, part] - expected) / np.outer(sigma, sigma)).max() < 1e-6
    assert (sigma < 0.99 * np.sqrt(np.diag(moved.cov[part, part]))).any()


def test_where_no_step_lowers_the_cost_the_frame_corrects_nothing(monkeypatch) -> None:
    monkeypatch.setattr(iekf, "MOST_HALVINGS", -1)
    joint, frame, rig = scene(FLIGHT, disturbed=0.3)
    before, gate = copy(joint), FrameGate(0.95)
    iekf.correct(joint, frame, AT, rig, gate)
    assert gate.accepted > 0
    assert gate.info()["unconverged"] == 1
    np.testing.assert_array_equal(joint.cov, before.cov)
    np.testing.assert_array_equal(joint.points, before.points)
    np.testing.assert_array_equal(joint.core.T_world_imu, before.core.T_world_imu)


def test_an_iteration_that_is_broken_off_ends_at_its_lowest_cost(monkeypatch) -> None:
    monkeypatch.setattr(iekf, "MOST_STEPS", 1)
    measurement = scene(FLIGHT).measurement()
    start = measurement.after(np.zeros(measurement.prediction.cov.shape[0] - 15))
    best, converged = iekf.most_probable(measurement)
    assert not converged
    assert best.cost < start.cost
    assert best.cost == measurement.after(best.pull).cost
