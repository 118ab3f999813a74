"""Scores of stated distributions: closed forms, smfeval where it is installed, and the right covariance is best."""

import numpy as np
import pytest
from scipy.stats import multivariate_normal, norm

from toolkit.geometry import quaternion_from_rotation, se3_exp, se3_log
from toolkit.metrics.parts.consistency import BodyErrors, StatedErrors, nees_of
from toolkit.metrics.uncertainty import energy_scores, of_stated

N = 400


@pytest.fixture(scope="module")
def stated() -> StatedErrors:
    """Errors of a consistent estimator with correlated covariances of some mrad and cm."""
    rng = np.random.default_rng(3)
    mixing = np.eye(6) + 0.2 * rng.normal(size=(N, 6, 6))
    root = np.repeat([5e-3, 0.05], 3)[:, None] * mixing
    errors = se3_exp((root @ rng.normal(size=(N, 6, 1)))[..., 0])
    t_ns = 10**8 * np.arange(N)
    poses = np.tile(np.eye(4), (N, 1, 1))
    return StatedErrors(BodyErrors(t_ns, np.arange(N), errors, poses, placed=False), root @ np.swapaxes(root, 1, 2))


@pytest.mark.parametrize("sigma", [1e-4, 1.0, 1e3])
@pytest.mark.parametrize("z", [0.0, 1e-3, 1.0, 5.0, 300.0])
def test_the_energy_score_on_a_line_is_the_crps_of_a_normal(sigma: float, z: float) -> None:
    """Gneiting & Raftery (2007), below eq. 21."""
    exact = sigma * (z * (2.0 * norm.cdf(z) - 1.0) + 2.0 * norm.pdf(z) - 1.0 / np.sqrt(np.pi))
    found = energy_scores(np.array([[z * sigma]]), np.array([[[sigma**2]]]))
    np.testing.assert_allclose(found, exact, rtol=1e-9)


def test_the_energy_score_at_the_mean_of_a_sphere_is_that_of_maxwells_distribution() -> None:
    found = energy_scores(np.zeros((1, 3)), 4.0 * np.eye(3)[None])
    np.testing.assert_allclose(found, 4.0 * np.sqrt(2.0 / np.pi) * (1.0 - np.sqrt(0.5)), rtol=1e-11)


def test_of_very_unequal_variances_the_energy_score_is_that_of_the_largest() -> None:
    flat = energy_scores(np.array([[0.7, 0.0, 0.0]]), np.diag([1.0, 1e-6, 1e-6])[None])
    line = energy_scores(np.array([[0.7]]), np.ones((1, 1, 1)))
    np.testing.assert_allclose(flat, line, atol=2e-6)


def test_log_scores_and_coverage_are_those_of_normal_distributions(stated: StatedErrors) -> None:
    found, xi = of_stated(stated).values, se3_log(stated.errors.T_estimate_truth)
    for block, rows in (("pose", slice(0, 6)), ("ori", slice(0, 3)), ("pos", slice(3, 6))):
        pairs = zip(xi[:, rows], stated.cov[:, rows, rows], strict=True)
        densities = [multivariate_normal.logpdf(x, cov=cov) for x, cov in pairs]
        assert found[f"log_score_{block}"] == pytest.approx(-np.mean(densities), rel=1e-12)
        for percent in (50, 90, 95):
            # Three standard deviations of a share of 400.
            share = percent / 100.0
            assert found[f"inside_{percent}_{block}_percent"] == pytest.approx(
                percent, abs=300.0 * np.sqrt(share * (1.0 - share) / N)
            )


@pytest.mark.parametrize("times", [0.25, 4.0])
def test_a_covariance_that_is_too_small_or_too_large_scores_worse(stated: StatedErrors, times: float) -> None:
    right, wrong = of_stated(stated).values, of_stated(stated._replace(cov=times * stated.cov)).values
    for key in ("log_score_pose", "log_score_ori", "log_score_pos", "energy_ori_deg", "energy_pos_m"):
        assert wrong[key] > right[key]


def test_blocks_that_are_stated_apart_have_their_scores_and_the_pose_none(stated: StatedErrors) -> None:
    cov = stated.cov.copy()
    cov[:, :3, 3:] = cov[:, 3:, :3] = np.nan
    whole, apart = of_stated(stated), of_stated(stated._replace(cov=cov))
    assert apart.values["log_score_pose"] is None
    assert apart.notes["inside_90_pose_percent"] == "what couples orientation and position is not stated"
    for key in ("log_score_ori", "energy_pos_m", "inside_95_pos_percent"):
        assert apart.values[key] == whole.values[key]


def test_smfeval_finds_the_same(stated: StatedErrors) -> None:
    """Of positions, which it scores: NEES, log score, coverage of 90 %; the energy score within its own sampling."""
    scoring = pytest.importorskip("smfeval.scoring", reason="an oracle that is not installed here: smfeval")
    from smfeval.format import TangentOrder
    from smfeval.steps import GaussianStep

    first, identity = np.r_[3:6, 0:3], np.array([0.0, 0.0, 0.0, 1.0])
    steps = [GaussianStep(0.0, np.zeros(3), identity, cov[np.ix_(first, first)]) for cov in stated.cov]
    truth = stated.errors.T_estimate_truth
    at, turn = truth[:, :3, 3], quaternion_from_rotation(truth[:, :3, :3])
    order = TangentOrder.TRANS_ROT
    theirs = [
        scoring.gaussian_log_score_components(step, p, q, order).translation
        for step, p, q in zip(steps, at, turn, strict=True)
    ]
    ours = of_stated(stated).values
    nees = nees_of(stated)
    np.testing.assert_allclose(3.0 * nees.position, [one.nees for one in theirs], rtol=1e-9)
    assert ours["log_score_pos"] == pytest.approx(np.mean([one.log_score for one in theirs]), rel=1e-9)
    calibration = scoring.calibrate(steps, at, turn, order, alpha=0.1)
    assert ours["inside_90_pos_percent"] == pytest.approx(100.0 * calibration.coverage, rel=1e-9)
    sampled = [scoring.energy_score(step, p, order, n_samples=400) for step, p in zip(steps[:50], at[:50], strict=True)]
    few = energy_scores(nees.errors[:50, 3:], stated.cov[:50, 3:, 3:])
    # Its errors are differences of positions, ours logarithms: alike to the turns of some mrad.
    assert np.mean(sampled) == pytest.approx(few.mean(), rel=0.03)
