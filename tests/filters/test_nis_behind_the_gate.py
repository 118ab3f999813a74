"""The innovations of a consistent filter are as large as its gate lets them be: its calibrated NIS is 1."""

import numpy as np
import pytest

from toolkit.datasets import load_sequence
from toolkit.metrics import score_run

FRAMES, SEEDS = 40, range(10, 18)


@pytest.mark.parametrize("name", ["drive", "flight"])
def test_the_nis_of_a_consistent_filter_is_one_on_simulated_truth(name, run_estimator):
    """MSCKF with first-estimate Jacobians; over its degrees of freedom the same NIS is 0.94 to 0.97."""
    found = []
    for seed in SEEDS:
        sequence = load_sequence(name, seed=seed).truncated(FRAMES)
        run = run_estimator("msckf-fej", sequence)
        by_dof = np.nansum(run.info["nis"]) / np.nansum(run.info["nis_dof"])
        assert by_dof < 0.99
        found.append(score_run(run, "causal", sequence).values["nis_mean"])
    standard_error = np.std(found, ddof=1) / np.sqrt(len(found))
    assert standard_error < 0.015  # or the test could not see what the gate does
    # Three standard errors of the mean over the seeds.
    assert np.mean(found) == pytest.approx(1.0, abs=3.0 * standard_error)
