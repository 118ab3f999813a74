"""A prediction along an IMU's samples that is made compiled is that of GTSAM's preintegration."""

import numpy as np
import pytest

from filters.kalman import compiled as compiled_parts
from toolkit.compilation import Compilation
from toolkit.geometry import read_only, se3_exp
from toolkit.measured_motion import ImuMotion, ImuNoise
from toolkit.models.imu import IMU_LAYOUT, ImuModel
from toolkit.models.state import Belief
from toolkit.sequence import GRAVITY_WORLD

# Both round at 1e-16 of the sums of twenty steps.
TOLERANCE = 1e-9
NOISE = ImuNoise(2e-3, 1.7e-4, 3e-3, 2e-5)
GRAVITY = np.array(GRAVITY_WORLD)
BIAS = np.array([0.3, -0.2, 0.1, 0.02, -0.03, 0.01])


@pytest.fixture(scope="module")
def compiled():
    pytest.importorskip("numba", reason="the extra 'fast' is not installed: there is nothing compiled to compare")
    return compiled_parts.integrator(NOISE, GRAVITY, Compilation("compiled"))


def belief(seed: int) -> Belief:
    """Return a state in read-only arrays or in arrays by columns, as GTSAM gives them."""
    rng = np.random.default_rng(seed)
    pose = np.asfortranarray(se3_exp(rng.normal(size=6)))
    return Belief(IMU_LAYOUT, pose, read_only(rng.normal(size=3)), read_only(BIAS), np.eye(15))


def motion(turn_rate: float, steps: int, scaled: bool = False) -> ImuMotion:
    """Return uneven steps of a lively motion."""
    rng = np.random.default_rng(5)
    return ImuMotion(
        rng.uniform(0.003, 0.007, steps),
        np.array([0.5, -0.7, 9.6]) + 5.0 * rng.normal(size=(steps, 3)),
        BIAS[3:] + turn_rate * rng.normal(size=(steps, 3)),
        rng.uniform(1.0, 3.0, (steps, 2)) if scaled else None,
    )


def assert_close(ours, theirs, scale=1.0):
    np.testing.assert_allclose(theirs / scale, ours / scale, rtol=0.0, atol=TOLERANCE)


@pytest.mark.parametrize("turn_rate", [0.0, 1e-9, 1e-4, 1e-2, 1.0, 30.0])
@pytest.mark.parametrize("steps", [1, 20])
@pytest.mark.parametrize("scaled", [False, True], ids=["as stated", "with noise scaled"])
def test_compiled_and_gtsam_predict_alike(compiled, turn_rate, steps, scaled):
    """At the largest rate the turn of an interval is beyond a radian, where closed forms take over."""
    start, samples = belief(3), motion(turn_rate, steps, scaled)
    ours = ImuModel(NOISE, GRAVITY).integrate(samples, start.bias).predict(start)
    theirs = compiled.integrate(samples, start.bias).predict(start)
    assert_close(ours.T_world_imu, theirs.T_world_imu)
    assert_close(ours.v_world, theirs.v_world)
    assert_close(ours.transition, theirs.transition)
    sigmas = np.sqrt(np.diag(ours.noise))
    assert_close(ours.noise, theirs.noise, np.outer(sigmas, sigmas))


def test_compiled_and_gtsam_have_the_same_transition_between_other_states_and_the_same_factors(compiled):
    start, other, samples = belief(3), belief(4), motion(1.0, 20)
    ours, theirs = (by.integrate(samples, start.bias) for by in (ImuModel(NOISE, GRAVITY), compiled))
    end = ours.predict(start)
    assert_close(ours.transition_between(other, end), theirs.transition_between(other, end))
    assert ours.factors(1).equals(theirs.factors(1), TOLERANCE)


def test_gtsam_preintegrates_where_nothing_is_set_and_where_numpy_is_requested():
    for compilation in (Compilation(), Compilation("numpy")):
        assert isinstance(compiled_parts.integrator(NOISE, GRAVITY, compilation), ImuModel)
