"""What many seeds say together: every metric's mean, median and spread, and the NEES averaged over the seeds.

Bar-Shalom, Li and Kirubarajan, "Estimation with applications to tracking and navigation" (2001), section 5.4:
over N independent runs the mean NEES of a consistent estimator stays within the chi-square band for N runs.
"""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from toolkit.estimate import Output, Status
from toolkit.experiment.trial import OUTPUTS, Outcome, Scored
from toolkit.geometry import Array, IntArray
from toolkit.metrics._shared.consistency import POSE_DOF, nees_band


@dataclass(frozen=True)
class Spread:
    """What the n values of a metric say together; ``std`` (n - 1 in its divisor) is None for a single one."""

    n: int
    mean: float
    median: float
    std: float | None
    least: float
    lower_quartile: float
    upper_quartile: float
    most: float


@dataclass(frozen=True, eq=False)
class MeanNees:
    """Pose NEES over 6 averaged over runs: at each frame (K,) the mean, the number of runs and the band for it."""

    mean: Array
    runs: IntArray
    low: Array
    high: Array

    @property
    def in_band_percent(self) -> float:
        """Share of the frames with a mean at which it is in its band."""
        known = self.runs > 0
        return 100.0 * float(np.mean((self.mean >= self.low)[known] & (self.mean <= self.high)[known]))

    @property
    def too_sure_percent(self) -> float:
        """Share of the frames with a mean at which it is above its band: errors larger than stated."""
        return 100.0 * float(np.mean((self.mean > self.high)[self.runs > 0]))


@dataclass(frozen=True, eq=False)
class Group:
    """One kind of output of one estimator over all seeds, in their order."""

    estimator: str
    output: Output
    outcomes: tuple[Outcome, ...]

    @property
    def counts(self) -> dict[Status, int]:
        """Return how many seeds ended each way."""
        counted = Counter(outcome.status for outcome in self.outcomes)
        return {status: counted[status] for status in ("ok", "diverged", "failed")}

    @cached_property
    def good(self) -> tuple[Scored, ...]:
        """What the runs that are ok gave; all that is aggregated is aggregated over these."""
        given = (o.outputs.get(self.output) for o in self.outcomes if o.status == "ok")
        return tuple(scored for scored in given if scored is not None)

    def values(self, key: str) -> list[float | None]:
        """Return a metric's value under each seed, whatever the run's status."""
        given = (outcome.outputs.get(self.output) for outcome in self.outcomes)
        return [None if scored is None else scored.scores.values.get(key) for scored in given]

    def spread(self, key: str) -> Spread | None:
        """Return what a metric's values over the runs that are ok say, or None where there is no value."""
        return spread_of(value for scored in self.good if (value := scored.scores.values.get(key)) is not None)

    def reason(self, key: str) -> str:
        """Return why a metric has no value under any seed."""
        notes = (scored.scores.notes.get(key) for scored in self.good)
        return next((note for note in notes if note), "no run is ok" if not self.good else "not computed")

    @cached_property
    def mean_nees(self) -> MeanNees | None:
        """The NEES averaged over the runs that are ok, or None where no run has one."""
        known = [scored.nees_pose for scored in self.good if np.isfinite(scored.nees_pose).any()]
        return mean_nees(np.array(known)) if known else None

    @cached_property
    def position_m(self) -> Array | None:
        """Position errors (runs, K) m of the runs that are ok, or None where no run has any."""
        known = [scored.position_m for scored in self.good if np.isfinite(scored.position_m).any()]
        return np.array(known) if known else None


@dataclass(frozen=True, eq=False)
class OverSeeds:
    """Several estimators over several seeds of one recording; ``outcomes`` by estimator, then seed.

    ``frames_s`` (K,) are the frames' times from the first. ``changes`` says, on a ladder only, what each estimator
    changes against the rung before.
    """

    name: str
    source: str
    motion: str
    seeds: tuple[int, ...]
    start: str
    frames_s: Array
    estimators: tuple[str, ...]
    outcomes: tuple[Outcome, ...]
    workers: int
    changes: Mapping[str, str]

    @cached_property
    def groups(self) -> tuple[Group, ...]:
        """Every kind of output of every estimator; one that gave none under any seed keeps its final one."""
        return tuple(group for name in self.estimators for group in self._groups_of(name))

    @property
    def hashes(self) -> tuple[str | None, ...]:
        """The hash of what the estimators read under each seed, None where no run lived to tell it."""
        told = {outcome.seed: outcome.sequence_hash for outcome in self.outcomes if outcome.sequence_hash}
        return tuple(told.get(seed) for seed in self.seeds)

    @property
    def all_ok(self) -> bool:
        """Say whether every run under every seed ended well."""
        return all(outcome.status == "ok" for outcome in self.outcomes)

    def _groups_of(self, estimator: str) -> list[Group]:
        outcomes = tuple(outcome for outcome in self.outcomes if outcome.estimator == estimator)
        given = [output for output in OUTPUTS if any(output in outcome.outputs for outcome in outcomes)]
        return [Group(estimator, output, outcomes) for output in given or ["final"]]


def spread_of(values: Iterable[float]) -> Spread | None:
    """Return mean, median and spread of values, or None where there are none."""
    given = np.array(list(values), dtype=float)
    if not given.size:
        return None
    least, lower, median, upper, most = np.percentile(given, [0.0, 25.0, 50.0, 75.0, 100.0]).tolist()
    std = float(given.std(ddof=1)) if given.size > 1 else None
    return Spread(given.size, float(given.mean()), median, std, least, lower, upper, most)


def mean_nees(nees: Array) -> MeanNees:
    """Average pose NEES (runs, K), each over 6, at every frame over the runs that have it there (NaN: has not)."""
    known = np.isfinite(nees)
    runs = known.sum(axis=0)
    mean = np.where(known, nees, 0.0).sum(axis=0) / np.maximum(runs, 1)
    bands = {n: nees_band(POSE_DOF, n) if n else (np.nan, np.nan) for n in np.unique(runs).tolist()}
    low, high = (np.array([bands[n][side] for n in runs.tolist()]) for side in (0, 1))
    return MeanNees(np.where(runs > 0, mean, np.nan), runs, low, high)


def in_order(outcomes: Iterable[Outcome], estimators: Sequence[str], seeds: Sequence[int]) -> tuple[Outcome, ...]:
    """Return outcomes by estimator, then seed, whatever the order they came in."""
    return tuple(sorted(outcomes, key=lambda o: (estimators.index(o.estimator), seeds.index(o.seed))))
