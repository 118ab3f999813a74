"""The tests that sightings must pass: the chi-square bound of an innovation and the weights of Huber's loss."""

import numpy as np
import pytest
from scipy import integrate, stats

from toolkit.models.gating import chi2_bound, huber_weights, mahalanobis_squared, mean_below_bound

HUBER = 1.5


def test_the_bound_is_the_textbooks_quantile():
    """Abramowitz & Stegun, table 26.8: 95 % of three degrees of freedom, 99.9 % of six."""
    assert chi2_bound(3, 0.95) == pytest.approx(7.81473, abs=5e-6)
    assert chi2_bound(np.array([6]), 0.999) == pytest.approx([22.458], abs=5e-4)


@pytest.mark.parametrize("dof", [1, 3, 33, 200])
@pytest.mark.parametrize("probability", [0.5, 0.95, 0.999])
def test_the_mean_behind_the_gate_is_the_truncated_densitys(dof, probability):
    bound = stats.chi2.ppf(probability, dof)
    moment, _ = integrate.quad(lambda x: x * stats.chi2.pdf(x, dof), 0.0, bound, epsabs=1e-10)
    assert mean_below_bound(dof, probability) == pytest.approx(moment / probability, rel=1e-7)  # of the integration


def test_the_bound_shuts_out_what_is_not_a_number():
    distances = mahalanobis_squared(np.array([[np.nan, 0.0, 0.0], [0.0, 0.0, 0.0]]), np.stack([np.eye(3)] * 2))
    np.testing.assert_array_equal(distances < chi2_bound(3, 0.95), [False, True])


def test_huber_weights_are_one_inside_the_threshold_and_fall_with_the_distance_outside():
    distances = np.array([0.0, 0.5, 1.0, 1.0 + 1e-9, 2.0, 10.0]) * HUBER
    weights = huber_weights(distances**2, HUBER)
    np.testing.assert_allclose(weights, [1.0, 1.0, 1.0, 1.0, 0.5, 0.1], atol=1e-8)
