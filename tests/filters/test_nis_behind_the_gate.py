"""The innovations of a consistent filter are as large as its gate lets them be: its calibrated NIS is 1."""

from functools import cache

import numpy as np
import pytest

from toolkit.datasets import load_sequence
from toolkit.metrics import score_run
from toolkit.sequence import Sequence
from toolkit.settings import POLICIES, Settings, Window

FRAMES, SEEDS = 40, range(10, 18)


@cache
def recording(name: str, seed: int) -> Sequence:
    return load_sequence(name, seed=seed).truncated(FRAMES)


@pytest.mark.parametrize(("name", "policy"), [("drive", "classic"), ("flight", "classic"), ("drive", "robust")])
def test_the_nis_of_a_consistent_filter_is_one_on_simulated_truth(name, policy, run_estimator):
    """MSCKF with first-estimate Jacobians; over its degrees of freedom the same NIS is 0.94 to 0.97 at 95 %.

    The loss of ``robust`` weighs after the test: the innovations are those before it.
    """
    settings = Settings(outliers=POLICIES[policy], window=Window(lag_s=0.6))
    found, by_dof = [], []
    for seed in SEEDS:
        sequence = recording(name, seed)
        run = run_estimator("msckf-fej", sequence, settings=settings)
        by_dof.append(np.nansum(run.info["nis"]) / np.nansum(run.info["nis_dof"]))
        found.append(score_run(run, "causal", sequence).values["nis_mean"])
    assert policy == "robust" or (np.mean(by_dof) < 0.98 and max(by_dof) < 0.99)
    standard_error = np.std(found, ddof=1) / np.sqrt(len(found))
    assert standard_error < 0.015  # or the test could not see what the gate does
    # Three standard errors of the mean over the seeds.
    assert np.mean(found) == pytest.approx(1.0, abs=3.0 * standard_error)
