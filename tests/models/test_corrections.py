"""A correction is as long as the covariance that it takes away says, one by one and summed, whatever it corrects."""

from dataclasses import replace

import numpy as np
import pytest

from toolkit.estimate import Trajectory
from toolkit.geometry import se3_inverse, se3_log
from toolkit.models.corrections import Correction, CorrectionTest, predicted_steps
from toolkit.models.motion import motion_model
from toolkit.motion_samples import Bridges
from toolkit.simulation import DRIVE_IMU, FLIGHT, simulate

COUNT, ROWS = 400, 6


@pytest.fixture(scope="module")
def belief():
    """Return the first belief of a drive with an IMU."""
    sound = simulate(replace(DRIVE_IMU, duration_s=1.0), 3)
    return motion_model(sound.noise, sound.gravity_world).initial_belief(sound.prior)


@pytest.fixture(scope="module")
def corrected(belief):
    """Return beliefs that consistent measurements of the same six rows made of one, each by its own draw."""
    rng = np.random.default_rng(5)
    H = rng.normal(size=(ROWS, len(belief.cov))) / np.sqrt(np.diag(belief.cov))
    S = H @ belief.cov @ H.T + np.eye(ROWS)
    gain, root = np.linalg.solve(S, H @ belief.cov).T, np.linalg.cholesky(S)
    draws = rng.normal(size=(COUNT, ROWS))
    return [belief.moved(gain @ root @ draw, belief.cov - gain @ S @ gain.T) for draw in draws]


def summed(corrections):
    """Return the test of a sum of corrections."""
    total = Correction(sum(each.moved for each in corrections), sum(each.taken for each in corrections))
    return total.test(np.sqrt(np.diag(total.taken)))


@pytest.mark.parametrize("together", [1, 10])
def test_consistent_corrections_and_sums_of_them_have_chi_square_lengths(belief, corrected, together):
    each = [Correction.of(belief, after) for after in corrected]
    found = [summed(each[k : k + together]) for k in range(0, COUNT, together)]
    assert {test.dof for test in found} == {ROWS}
    # The mean of so many chi-square variables is within four of its standard errors.
    assert abs(np.mean([test.nis for test in found]) - ROWS) < 4.0 * np.sqrt(2.0 * ROWS / len(found))


def test_a_sum_shows_what_leans_one_way_and_no_single_correction_shows(belief, corrected):
    """Ten corrections, each moved by half a standard deviation the same way: 2.5 = 10 (0.5)^2 a degree of freedom."""
    first = Correction.of(belief, corrected[0])
    shares, axes = np.linalg.eigh(first.taken / np.outer(*2 * [np.sqrt(np.diag(first.taken))]))
    lean = 0.5 * np.sqrt(np.diag(first.taken)) * (axes[:, -ROWS:] @ np.sqrt(shares[-ROWS:]))
    leaning = [replace(each, moved=each.moved + lean) for each in (Correction.of(belief, a) for a in corrected)]
    alone = np.mean([each.test(np.sqrt(np.diag(each.taken))).nis for each in leaning]) / ROWS
    ten = [summed(leaning[k : k + 10]) for k in range(0, COUNT, 10)]
    assert alone == pytest.approx(1.25, abs=4.0 * np.sqrt(2.0 * 1.5 / (ROWS * COUNT)))
    assert np.mean([test.nis for test in ten]) / ROWS == pytest.approx(3.5, abs=4.0 * np.sqrt(12.0 / (ROWS * len(ten))))


def test_what_nothing_corrected_is_not_tested(belief):
    assert Correction.of(belief, belief).test(np.sqrt(np.diag(belief.cov))) == CorrectionTest(0.0, 0)


def test_what_was_added_elsewhere_hides_as_much_that_is_taken_away(belief):
    """A smoother that linearises anew adds to one variance: what another lost is told where it is more than that."""
    taken = np.diag(belief.cov) * np.array([0.2, 0.05, *[0.0] * (len(belief.cov) - 3), -0.1])
    test = Correction(np.sqrt(np.abs(taken)), np.diag(taken)).test(np.sqrt(np.diag(belief.cov)))
    assert test == CorrectionTest(pytest.approx(1.0), 1)


def test_averaged_samples_predict_the_same_poses_and_noise():
    """To far less than a test of divergence allows a step: 0.02 rad/s and 0.2 m/s, at 20 frames a second."""
    sound = simulate(replace(FLIGHT, duration_s=2.0), 3)
    bridged = replace(sound, bridges=Bridges(sound.frames_t_ns[5:6], sound.frames_t_ns[9:10], np.full((1, 2), 30.0)))
    truth = sound.truth
    at_frames = np.searchsorted(truth.t_ns, sound.frames_t_ns)
    rows = at_frames[truth.t_ns[np.minimum(at_frames, truth.t_ns.size - 1)] == sound.frames_t_ns]
    trajectory = Trajectory(truth.t_ns[rows], truth.T_world_imu[rows], v_world=truth.v_world[rows])
    exact, averaged = (predicted_steps(trajectory, bridged, longest_s) for longest_s in (0.0, 0.02))
    np.testing.assert_allclose(averaged.dt_s, exact.dt_s, rtol=1e-12)
    off = se3_log(se3_inverse(exact.predictions.T_world_imu) @ averaged.predictions.T_world_imu)
    assert 0.0 < np.abs(off[:, :3]).max() < 1e-5
    assert np.abs(off[:, 3:]).max() < 1e-4
    noise = [np.diagonal(each.predictions.noise, axis1=1, axis2=2) for each in (exact, averaged)]
    np.testing.assert_allclose(noise[1], noise[0], rtol=0.2)
