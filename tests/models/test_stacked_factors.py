"""Stacks of Python factors: residuals, noise and derivatives are those of the factors one by one."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest

from toolkit.geometry import se3_exp
from toolkit.measurements import TwistMotion, TwistNoise
from toolkit.models.factors import B, X
from toolkit.models.motion import motion_model
from toolkit.models.stacked_factors import StackedFactors, linear_factors, stacked
from toolkit.models.twist import TwistIncrement, TwistModel, twist_factor
from toolkit.simulation import FLIGHT, simulate

NOISE = TwistNoise(np.array([0.01, 0.02, 0.03]), np.array([0.1, 0.2, 0.3]), np.full(3, 1e-5))
STATES = 7


def increments(rng: np.random.Generator) -> dict[int, TwistIncrement]:
    model, found = TwistModel(NOISE), {}
    for k in range(1, STATES):
        motion = TwistMotion(np.array([0.04, 0.07]), 8.0 * rng.standard_normal((2, 3)), rng.standard_normal((2, 3)))
        found[k] = model.integrate(motion, 0.1 * rng.standard_normal(6))
    return found


def values_off(steps: dict[int, TwistIncrement], size: float, rng: np.random.Generator) -> gtsam.Values:
    """Return states that are off what the steps predict by about a size (rad, m)."""
    values, pose = gtsam.Values(), se3_exp(rng.standard_normal(6))
    for k in range(STATES):
        pose = pose @ steps[k].step.T_start_end if k else pose
        values.insert(X(k), gtsam.Pose3(pose @ se3_exp(size * rng.standard_normal(6))))
        values.insert(B(k), 0.1 * rng.standard_normal(3))
    return values


def one_by_one(steps: dict[int, TwistIncrement]) -> list[gtsam.NonlinearFactor]:
    return [twist_factor(increment.step, increment.gyro_bias, k) for k, increment in steps.items()]


@pytest.mark.parametrize("size", [0.0, 1e-6, 1e-2, 0.7])
def test_a_stack_has_the_errors_and_linearisations_of_its_factors(size):
    rng = np.random.default_rng(3)
    steps = increments(rng)
    values, single = values_off(steps, size, rng), one_by_one(steps)
    stacks = stacked(steps)
    keys = [keys for stack in stacks for keys in stack.keys]
    assert keys == [tuple(factor.keys()) for factor in single]
    errors = np.concatenate([0.5 * np.square(stack.residuals(values)).sum(axis=1) for stack in stacks])
    # Twelve digits of squares that the smallest sigma makes a million times the residuals'.
    np.testing.assert_allclose(errors, [factor.error(values) for factor in single], rtol=1e-9, atol=1e-16)
    linear = [factor for stack in stacks for factor in linear_factors(stack, values)]
    for found, factor in zip(linear, single, strict=True):
        expected = factor.linearize(values).augmentedInformation()
        np.testing.assert_allclose(found.augmentedInformation(), expected, atol=1e-9 * np.abs(expected).max())


def test_residuals_alone_are_those_that_are_linearised():
    rng = np.random.default_rng(4)
    steps = increments(rng)
    values = values_off(steps, 0.1, rng)
    stack: StackedFactors
    for stack in stacked(steps):
        np.testing.assert_array_equal(stack.residuals(values), stack.linearised(values).residuals)


def test_what_gtsam_has_itself_is_not_stacked():
    sequence = simulate(replace(FLIGHT, duration_s=1.0), 0)
    model = motion_model(sequence.noise, sequence.gravity_world)
    moved = {packet.index: packet.motion for packet in sequence.packets() if packet.motion is not None}
    assert moved
    assert stacked({k: model.integrate(motion, np.zeros(6)) for k, motion in moved.items()}) == []
