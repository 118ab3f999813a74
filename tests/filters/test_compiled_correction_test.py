"""A correction that is tested or made compiled is that of NumPy."""

from dataclasses import replace

import numpy as np
import pytest

from filters.kalman import compiled as compiled_parts
from toolkit.compilation import Compilation
from toolkit.geometry import se3_exp
from toolkit.models.corrections import correction_test
from toolkit.models.imu import IMU_LAYOUT
from toolkit.models.state import Belief
from toolkit.models.twist import TWIST_LAYOUT


@pytest.fixture(scope="module")
def compiled():
    pytest.importorskip("numba", reason="the extra 'fast' is not installed: there is nothing compiled to compare")
    return compiled_parts.correction_test(Compilation("compiled"))


def corrected(layout, seed, turn_rad):
    """Return a belief, and what a measurement of fewer dimensions than the state and another turn made of it."""
    rng, d = np.random.default_rng(seed), layout.size
    root = rng.normal(size=(d, d)) * np.geomspace(1e-4, 1e2, d)[:, None]
    pose = se3_exp(rng.normal(size=6))
    before = Belief(layout, pose, rng.normal(size=3), rng.normal(size=6), root @ root.T)
    H = rng.normal(size=(4, d)) / np.sqrt(np.diag(before.cov))
    gain = before.cov @ H.T @ np.linalg.inv(H @ before.cov @ H.T + np.eye(4))
    delta = gain @ rng.normal(size=4)
    turn = rng.normal(size=3)
    delta[:3] += turn_rad * turn / np.linalg.norm(turn)
    return before, before.moved(delta, before.cov - gain @ H @ before.cov)


@pytest.mark.parametrize("turn_rad", [0.0, 1e-9, 1e-3, 1.0, np.pi - 1e-3])
@pytest.mark.parametrize("layout", [IMU_LAYOUT, TWIST_LAYOUT], ids=["imu", "twist"])
def test_compiled_and_numpy_test_corrections_alike(compiled, layout, turn_rad):
    for seed in range(10):
        before, after = corrected(layout, seed, turn_rad)
        ours, theirs = correction_test(before, after), compiled(before, after)
        assert theirs.dof == ours.dof == 4
        assert theirs.nis == pytest.approx(ours.nis, rel=1e-9)


def test_compiled_and_numpy_make_the_same_motions_of_twists(compiled):
    exponentials = compiled_parts.exponentials(Compilation("compiled"))
    twists = np.random.default_rng(2).normal(size=(40, 6)) * np.geomspace(1e-12, 3.0, 40)[:, None]
    assert exponentials(twists) == pytest.approx(se3_exp(twists), abs=1e-14)


def test_what_has_no_variance_is_left_out(compiled):
    before, after = corrected(IMU_LAYOUT, 3, 0.0)
    for belief in (before, after):
        belief.cov[9], belief.cov[:, 9] = 0.0, 0.0
    assert compiled(before, after).nis == pytest.approx(correction_test(before, after).nis, rel=1e-9)


def test_a_correction_that_removes_no_covariance_has_no_test(compiled):
    before, _ = corrected(IMU_LAYOUT, 1, 0.0)
    assert compiled(before, replace(before, v_world=before.v_world + 1.0)) == (0.0, 0)
