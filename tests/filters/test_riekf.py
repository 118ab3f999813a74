"""The right-invariant filter is the textbook one, written in other coordinates, and its gauge is safe at any estimate.

The reference here is written from the definition alone: the group's matrices, the matrix exponential, and numerical
derivatives of the error.
"""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from scipy.linalg import expm

from filters import iekf
from filters.ekf_slam import JointEkf
from filters.kalman import joint_landmarks
from filters.kalman.coordinates import InvariantBelief
from filters.kalman.joint import AtLatestEstimates, JointBelief
from tests.filters.conftest import BELIEFS, carried, gauge, loosened, setup_of, short
from tests.models.conftest import numerical_jacobian
from toolkit.geometry import Array, se3, se3_exp, skew, so3_log
from toolkit.models.gating import FrameGate
from toolkit.models.motion import motion_model
from toolkit.models.state import IMU_LAYOUT
from toolkit.simulation import DRIVE, DRIVE_IMU, FLIGHT

AT = AtLatestEstimates()
both_kinds = pytest.mark.parametrize("scenario", [DRIVE, FLIGHT], ids=["twist", "imu"])


def group_element(joint: JointBelief) -> Array:
    """Return X = (R, p, v, l_1 ... l_L), a square matrix; the velocity only where it is estimated."""
    core = joint.core
    velocity = [] if core.layout.velocity is None else [core.v_world]
    vectors = np.column_stack([core.T_world_imu[:3, 3], *velocity, *joint.points])
    element = np.eye(3 + vectors.shape[1])
    element[:3, :3], element[:3, 3:] = core.T_world_imu[:3, :3], vectors
    return element


def invariant_error(joint: JointBelief, delta: Array) -> Array:
    """Return xi, then the biases' errors, of a state that is off by the ``delta`` (n,) of a plain joint belief."""
    plain = JointBelief(joint._core)
    plain.__dict__.update({k: v for k, v in joint.__dict__.items() if k != "anchors"})
    off = group_element(plain.displaced(delta)) @ np.linalg.inv(group_element(joint))
    theta = so3_log(off[:3, :3])
    # exp(xi) = [[exp(theta), J(theta) rho], [0, 1]]; J is read off the exponential map of a pose.
    left_jacobian = np.column_stack([se3_exp(np.r_[theta, unit])[:3, 3] for unit in np.eye(3)])
    rho = np.linalg.solve(left_jacobian, off[:3, 3:])
    biases = delta[6:9] if joint.core.layout is not IMU_LAYOUT else delta[9:15]
    return np.concatenate([theta, rho.T.reshape(-1), biases])


def to_invariant(joint: JointBelief) -> Array:
    """Return d xi / d delta (n, n) at the estimate, by numerical differentiation of the definition."""
    return numerical_jacobian(partial(invariant_error, joint), joint.cov.shape[0])


def group_exponential(xi: Array, vectors: int) -> Array:
    algebra = np.zeros((3 + vectors, 3 + vectors))
    algebra[:3, :3], algebra[:3, 3:] = skew(xi[:3]), xi[3 : 3 + 3 * vectors].reshape(vectors, 3).T
    return expm(algebra)


@both_kinds
def test_its_update_is_that_of_the_filter_written_on_the_group(scenario) -> None:
    """xi = K r, X+ = exp(xi) X, P_xi+ = (1 - K H) P_xi; an open gate, so that all landmarks correct."""
    joint, frame, rig = carried(scenario, BELIEFS["riekf"], 15)
    shift = np.random.default_rng(0).standard_normal(joint.cov.shape[0])
    joint.move(3.0 * np.linalg.cholesky(joint.cov) @ shift)  # there will be something to correct
    bias = joint.core.bias
    convert, before = to_invariant(joint), group_element(joint)
    P = convert @ joint.cov @ convert.T
    joint.clone()
    seen = joint_landmarks.linearise_sightings(joint, frame, AT, rig)
    H, residuals = joint_landmarks.stacked(joint, seen).weighed(np.ones(len(seen.depth_m)))
    H_plain = np.zeros((residuals.size, convert.shape[0]))
    H_wide, d = H.toarray(), joint.core.layout.size
    H_plain[:, :6], H_plain[:, d:] = H_wide[:, -6:], H_wide[:, :-6]
    H = H_plain @ np.linalg.inv(convert)
    gain = P @ H.T @ np.linalg.inv(H @ P @ H.T + np.eye(len(H)))
    xi = gain @ residuals
    joint_landmarks.correct(joint, frame, AT, rig, FrameGate(probability=1.0))
    joint.forget_clones(1)

    assert np.linalg.norm(xi[:3]) > 1e-5
    assert np.linalg.norm(group_exponential(xi, before.shape[0] - 3) - np.eye(len(before))) > 0.01
    expected = group_exponential(xi, before.shape[0] - 3) @ before
    np.testing.assert_allclose(group_element(joint), expected, rtol=0.0, atol=1e-9)
    biases = xi[3 + 3 * (before.shape[0] - 3) :]
    np.testing.assert_allclose(joint.core.bias - bias, np.r_[np.zeros(6 - biases.size), biases], rtol=0.0, atol=1e-9)
    back = np.linalg.inv(to_invariant(joint))
    cov = back @ (P - gain @ H @ P) @ back.T
    sigma = np.sqrt(np.diag(cov))
    # Depths far and near: the textbook's inverse of H P H^T + 1 loses some seven digits of sixteen.
    assert np.abs((joint.cov - cov) / np.outer(sigma, sigma)).max() < 1e-7


@pytest.mark.parametrize("scenario", [DRIVE, DRIVE_IMU, FLIGHT], ids=lambda s: s.name)
def test_its_error_propagates_alike_from_every_state(scenario) -> None:
    """Group-affine: but for the biases' columns the transition of xi does not know the estimate."""
    sequence = short(scenario, 1.0, 15, 3)
    setup, motion = setup_of(sequence), list(sequence.packets())[3].motion
    carry, rng = motion_model(setup.noise, setup.gravity_world), np.random.default_rng(1)
    start = motion_model(setup.noise, setup.gravity_world).initial_belief(setup.prior)
    transitions = []
    for _ in range(3):
        T_world_imu = se3_exp(np.r_[rng.standard_normal(3), 100.0 * rng.standard_normal(3)])
        here = replace(start, T_world_imu=T_world_imu, v_world=10.0 * rng.standard_normal(3))
        step = carry.integrate(motion, here.bias).predict(here)
        there = replace(here, T_world_imu=step.T_world_imu, v_world=step.v_world)
        before, after = to_invariant(JointBelief(here)), to_invariant(JointBelief(there))
        transitions.append(after @ step.transition @ np.linalg.inv(before))
    biases = 6 if start.layout is IMU_LAYOUT else 3
    for other in transitions[1:]:
        # Positions of 100 m stand beside rotations: rounding and differencing leave 1e-7.
        np.testing.assert_allclose(other[:, :-biases], transitions[0][:, :-biases], rtol=0.0, atol=1e-7)
    assert np.abs(transitions[1][:, -biases:] - transitions[0][:, -biases:]).max() > 1e-3, "imperfect: biases know it"


@both_kinds
def test_a_shift_and_a_turn_of_the_world_are_the_same_error_at_every_estimate(scenario) -> None:
    """And a sighting is blind to both, wherever it is linearised."""
    joint, frame, rig = carried(scenario, BELIEFS["riekf"], 15)
    joint.clone()
    rng = np.random.default_rng(5)
    constant = gauge(joint, turns=np.eye(3))
    for _ in range(3):
        drawn = 0.1 * rng.standard_normal(joint.cov.shape[0])
        drawn[joint.clone_columns] = drawn[:6]
        moved = joint.displaced(drawn)
        here = gauge(moved, turns=np.eye(3))
        assert np.abs(here - constant).max() > 0.01, "in the plain error they are others"
        seen = joint_landmarks.linearise_sightings(moved, frame, AT, rig)
        H, _ = joint_landmarks.stacked(moved, seen).weighed(np.ones(len(seen.depth_m)))
        part = joint_landmarks.columns(moved)
        # Jacobians of hundreds of pixels a radian or metre, directions of tens of metres.
        assert np.abs(H @ here[part]).max() < 1e-9
        moved.forget_clones(1)
        xi = to_invariant(moved) @ gauge(moved, turns=np.eye(3))
        expected = np.zeros_like(xi)
        expected[:3, 3:] = np.eye(3)
        with_velocity = moved.core.layout is IMU_LAYOUT
        expected[3:6, :3] = np.eye(3)
        first = 9 if with_velocity else 6
        expected[first : first + 3 * len(moved.points), :3] = np.tile(np.eye(3), (len(moved.points), 1))
        np.testing.assert_allclose(xi, expected, rtol=0.0, atol=1e-8)


def most_information_gained(scenario, belief, correct) -> float:
    """Return by how much of the prior's the information along the gauge ever rises, at worst, in a run."""
    sequence = short(scenario, 3.0 if scenario is DRIVE else 2.0, 20, 3)
    setup = setup_of(sequence)
    # Without an accelerometer nothing measures the vertical either.
    turns = np.eye(3) if setup.motion_kind == "twist" else np.eye(3)[:, 2:]
    model = motion_model(setup.noise, setup.gravity_world)
    core = model.initial_belief(setup.prior)
    setup = replace(setup, prior=loosened(setup.prior, core, turns))
    directions = gauge(JointBelief(core), turns)
    first = directions.T @ np.linalg.solve(model.initial_belief(setup.prior).cov, directions)
    root = np.linalg.inv(np.linalg.cholesky(first))
    ekf, gained = JointEkf(setup, AT, partial(belief, setup.rig), correct), -1.0
    for packet in sequence.packets():
        ekf.step(packet)
        directions = gauge(ekf.joint, turns)
        information = directions.T @ np.linalg.solve(ekf.joint.cov, directions)
        gained = max(gained, float(np.linalg.eigvalsh(root @ information @ root.T).max()) - 1.0)
    return gained


CORRECT = {"riekf": joint_landmarks.correct, "iekf": iekf.correct}


@both_kinds
@pytest.mark.parametrize("name", CORRECT)
def test_no_information_about_global_position_and_heading_is_gained(scenario, name) -> None:
    """Of the whole joint belief, landmarks included; after marginalising them less is left."""
    # The condition of a joint covariance is some 1e9: seven digits of the information are left.
    assert most_information_gained(scenario, BELIEFS[name], CORRECT[name]) < 1e-6


@both_kinds
@pytest.mark.parametrize("correct", CORRECT.values(), ids=["single", "iterated"])
def test_the_plain_error_at_latest_estimates_does_gain_it(scenario, correct) -> None:
    """The test above can fail."""
    assert most_information_gained(scenario, BELIEFS["plain"], correct) > 0.01


def test_the_world_a_filter_starts_in_makes_no_difference() -> None:
    """Started 700 m away and turned by two radians, its relative motion and covariance are the same."""
    sequence = short(DRIVE, 1.0, 15, 3)
    T_other_world = se3(se3_exp(np.array([0.0, 0.0, 2.0, 0.0, 0.0, 0.0]))[:3, :3], np.array([500.0, -490.0, 3.0]))
    elsewhere = replace(sequence.prior, T_world_imu=T_other_world @ sequence.prior.T_world_imu)
    setup = setup_of(sequence)
    here, there = (JointEkf(s, AT, InvariantBelief) for s in (setup, replace(setup, prior=elsewhere)))
    for packet in sequence.packets():
        one, other = here.step(packet), there.step(packet)
        np.testing.assert_allclose(other.T_world_imu, T_other_world @ one.T_world_imu, rtol=0.0, atol=1e-8)
        sigma = np.sqrt(np.diag(one.cov))
        assert np.abs((one.cov - other.cov) / np.outer(sigma, sigma)).max() < 1e-7
