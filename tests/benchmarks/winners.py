"""How often one run names a winner: of two that differ by their noise alone, or by twice the error; not a test.

    python tests/benchmarks/winners.py --seeds 20 --estimators dead-reckoning ekf

A line a scenario and estimator: the share of pairs of seeds that name a winner, and the share of the seeds under which
the estimator is named before a twin of it with twice the error.
"""

import argparse
from dataclasses import replace
from itertools import combinations

import numpy as np

from toolkit.experiment.drift_test import less_drift
from toolkit.experiment.recording import Recording, prepare
from toolkit.experiment.units import Unit, run_estimator
from toolkit.metrics import Evaluation
from toolkit.metrics.ate import position_rmse
from toolkit.metrics.parts.against_truth import Matched, fit_yaw
from toolkit.progress import SILENT


def matched(scenario: str, seed: int, estimator: str) -> Matched:
    """Return the poses that an estimator gives of a scenario in the end, with the true ones."""
    prepared = prepare(Recording(scenario, seed))
    run = run_estimator(Unit(prepared, seed, estimator), prepared, SILENT)
    return Evaluation(run, "causal" if run.final is None else "final", prepared.sequence).compared


def ate_m(pairs: Matched) -> float:
    """Return the error of position after a fit of heading and position."""
    truth, estimate = pairs.positions
    return position_rmse(pairs, fit_yaw(truth, estimate))


def twice_the_error(pairs: Matched) -> Matched:
    """Return the pairs with twice the error of every position."""
    estimate = pairs.estimate.copy()
    estimate[:, :3, 3] = 2.0 * pairs.estimate[:, :3, 3] - pairs.truth[:, :3, 3]
    return replace(pairs, estimate=estimate)


def names_a_winner(one: Matched, other: Matched) -> bool:
    """Say whether the one with the smaller error also drifts less by more than chance."""
    better, worse = sorted((one, other), key=ate_m)
    found = less_drift(better, worse)
    return found is not None and found.low > 1.0


def main() -> None:
    """Print the shares."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--estimators", nargs="+", default=["dead-reckoning", "ekf"])
    parser.add_argument("--scenarios", nargs="+", default=["drive", "drive-realistic", "flight"])
    options = parser.parse_args()
    for scenario in options.scenarios:
        for estimator in options.estimators:
            runs = [matched(scenario, seed, estimator) for seed in range(options.seeds)]
            by_noise = [names_a_winner(*pair) for pair in combinations(runs, 2)]
            by_twice = [names_a_winner(run, twice_the_error(run)) for run in runs]
            print(f"{scenario:16} {estimator:16} noise alone {np.mean(by_noise):.3f}, twice {np.mean(by_twice):.3f}")


if __name__ == "__main__":
    main()
