"""How many runs a gate of trajectories needs, from the scatter of the first ones; nothing is compared.

The tests are those of a check (:mod:`toolkit.gate.significance`) of as many runs as the baseline has: Welch's, one
sided, of a growth beyond the bound, each at the share of the rate that Holm's correction leaves to the smallest p-value
of all. Its power at a standard deviation s is a noncentral t probability (Cohen, "Statistical power analysis for the
behavioral sciences", 1988, chapter 2). The s of few runs is itself uncertain, so that the power is averaged over the
chi-square distribution of s^2 given them (O'Hagan, Stevens and Campbell, "Assurance in clinical trial design",
Pharmaceutical Statistics 4, 2005).
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.special import chdtri, nctdtr, stdtrit

from toolkit.errors import DataError
from toolkit.evaluation.against_baseline import TrajectoryBaselineRecord, everywhere
from toolkit.gate.baseline import Criterion
from toolkit.gate.significance import FEWEST_RUNS, Everywhere, Repeats, Where
from toolkit.geometry import Array

CHANGES_PERCENT = (5.0, 10.0, 20.0)
WANTED, MOST_RUNS = 0.9, 200
_QUANTILES = (np.arange(20) + 0.5) / 20.0


@dataclass(frozen=True)
class Planned:
    """What runs as scattered as the first ones show of one metric, on one sequence or on all of them together.

    ``seen`` has the chance of each of CHANGES_PERCENT with as many ``runs`` a sequence as there are; ``needed`` the
    runs a sequence for a chance of 90 %, None where that is more than MOST_RUNS.
    """

    where: Where
    runs: int
    bound_percent: float
    scatter_percent: float
    seen: tuple[float, ...]
    needed: tuple[int | None, ...]

    def is_allowed(self, i: int) -> bool:
        """Say whether the i-th of CHANGES_PERCENT is within the bound, and so never found."""
        return CHANGES_PERCENT[i] <= self.bound_percent


def planned(baseline: TrajectoryBaselineRecord) -> tuple[Planned, ...]:
    """Return the plan of every metric that a check would test; raises DataError where none has three runs or more."""
    tests = list(_tests(baseline))
    if not tests:
        raise DataError(
            f"no sequence has {FEWEST_RUNS} runs, of which the scatter is known; give the files of repeated runs, "
            "SEQUENCE/RUN.tum"
        )
    tests += everywhere(tests)
    rate = baseline.false_alarm_rate / 2.0 / len(tests)
    return tuple(_planned(one, rate) for one in tests)


def _tests(baseline: TrajectoryBaselineRecord) -> Iterator[Repeats]:
    """Yield the tests of a check in which the baseline's own runs come again."""
    for one in baseline.sequences:
        for key, percent in baseline.bounds.items():
            values = np.array([value for value in one.scores[key] if value is not None])
            if values.size >= FEWEST_RUNS:
                yield Repeats(Where(one.sequence, "", "", key), Criterion("larger", percent), values, values)


def _planned(test: Repeats, rate: float) -> Planned:
    error, dof = test.error_and_dof
    runs = min(part.before.size for part in (test.parts if isinstance(test, Everywhere) else (test,)))
    # Errors of one run on each side, at which the variance is as certain as one side's runs make it.
    one_run, known = error * np.sqrt(runs), 0.5 * dof
    counts = np.arange(FEWEST_RUNS, max(MOST_RUNS, runs) + 1.0)
    excess = np.log1p(np.array(CHANGES_PERCENT) / 100.0) - test.criterion.margin
    chances = _chances(excess, counts, one_run, known, dof / (2.0 * (runs - 1)), rate)
    return Planned(
        test.where,
        runs,
        test.criterion.percent,
        100.0 * float(np.expm1(one_run / np.sqrt(2.0))),
        tuple(chances[:, runs - FEWEST_RUNS].tolist()),
        tuple(int(counts[np.argmax(row >= WANTED)]) if row.max() >= WANTED else None for row in chances),
    )


def _chances(excess: Array, counts: Array, one_run: float, known: float, sequences: float, rate: float) -> Array:
    """Return the chance (c, n) that growths beyond the bound of ``excess`` (c,) are found with ``counts`` (n,) runs."""
    if one_run == 0.0:
        return np.repeat((excess > 0.0)[:, None].astype(float), counts.size, axis=1)
    errors = one_run * np.sqrt(known / chdtri(known, _QUANTILES))
    dof = 2.0 * (counts - 1.0) * sequences
    limit = stdtrit(dof, 1.0 - rate)
    shift = excess[:, None, None] / (errors[None, None, :] / np.sqrt(counts)[None, :, None])
    # Farther from the limit the chance to miss is none, and the function has no value.
    missed = nctdtr(dof[None, :, None], np.minimum(shift, 30.0), limit[None, :, None])
    return np.where(excess[:, None] > 0.0, 1.0 - missed.mean(axis=-1), 0.0)
