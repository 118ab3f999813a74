"""The covariances a smoother reports for all of its states are those of GTSAM's marginals."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest

from filters.smoothing import indeterminate
from toolkit.models import state_covariances
from toolkit.models.motion import state_cov
from toolkit.models.state_covariances import RoundingError, state_covs
from toolkit.settings import Settings, Window
from toolkit.simulation import DRIVE, DRIVE_IMU, FLIGHT, simulate

SHORT = {"drive": replace(DRIVE, duration_s=3.0), "flight": replace(FLIGHT, duration_s=5.0)}


def _only_dissected(eliminated):
    """Return an elimination that fails the first time, which is in the order of time."""
    failed = []

    def eliminate(*given):
        if not failed:
            failed.append(True)
            raise RoundingError("not in the order of time")
        return eliminated(*given)

    return eliminate


@pytest.mark.parametrize(("scenario", "in_time"), [("drive", True), ("flight", True), ("drive", False)])
def test_every_state_has_gtsams_marginal(scenario, in_time, run_estimator, monkeypatch):
    """In the order of time, and by nested dissection where that is no good."""
    if not in_time:
        monkeypatch.setattr(state_covariances, "_eliminated", _only_dissected(state_covariances._eliminated))
    calls = []

    def spy(linear, motion, poses):
        calls.append((linear, motion, poses))
        return state_covs(linear, motion, poses)

    monkeypatch.setattr(indeterminate, "state_covs", spy)
    run = run_estimator("batch", simulate(SHORT[scenario], 3))
    (linear, motion, poses) = calls[0]
    tree = linear.eliminateMultifrontal(gtsam.Ordering.ColamdGaussianFactorGraph(linear))
    for k in range(0, len(poses), 5):
        expected = state_cov(motion, tree, k, poses[k, :3, :3])
        sigmas = np.sqrt(np.diag(expected))
        np.testing.assert_allclose(
            run.final.cov[k] / np.outer(sigmas, sigmas), expected / np.outer(sigmas, sigmas), atol=1e-6
        )


@pytest.mark.parametrize("scenario", [DRIVE, DRIVE_IMU, FLIGHT], ids=lambda s: s.name)
def test_the_newest_state_of_a_window_that_never_leaves_has_the_batchs_covariance(scenario, run_estimator):
    """Both linearised near the same values; the window keeps its Huber weights, so a quarter is allowed."""
    sequence = simulate(replace(scenario, duration_s=1.5), 5)
    never = Settings(window=Window(lag_s=2.0))
    newest = run_estimator("fixed-lag", sequence, settings=never).causal.cov[-1]
    smoothed = run_estimator("batch", sequence).final.cov[-1]
    sigma_ratio = np.sqrt(np.diag(newest)[:6] / np.diag(smoothed)[:6])
    np.testing.assert_allclose(sigma_ratio, 1.0, atol=0.25)


def test_a_dissection_that_loses_its_digits_over_an_imu_is_not_shown(run_estimator, monkeypatch):
    monkeypatch.setattr(state_covariances, "_eliminated", _only_dissected(state_covariances._eliminated))
    run = run_estimator("batch", simulate(SHORT["flight"], 3))
    assert run.status == "ok"
    assert run.final.cov is None


def test_covariances_that_rounding_spoils_are_not_shown(run_estimator, monkeypatch):
    recovered = state_covariances._recovered

    def spoiled(conditionals, together):
        return [1.05 * cov for cov in recovered(conditionals, together)]

    monkeypatch.setattr(state_covariances, "_recovered", spoiled)
    run = run_estimator("batch", simulate(replace(DRIVE, duration_s=1.0), 3))
    assert run.status == "ok"
    assert run.final.cov is None
    assert run.log == ("no covariances of the final states: they were lost to rounding",)
