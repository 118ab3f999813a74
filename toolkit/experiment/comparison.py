"""The result of a comparison on one sequence: every estimator under every seed, scored. Every report is made from it.

A line of the table is one kind of output of one estimator. Its values are those of the single run or, over seeds, the
means over the runs that are ok. Whether it is overconfident or timid is told by the NEES of its poses (Bar-Shalom, Li
and Kirubarajan 2001, section 5.4) where the truth is independent, else by the NIS, with bands that hold however its
errors are correlated in time; docs/metrics.md derives them.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Annotated, Literal, NamedTuple

import numpy as np
from msgspec import Meta, Struct

from toolkit.experiment.contests import Contest, contests_of
from toolkit.experiment.statistics import MeanNees, QuantilesAll, Spread, mean_nees, quantiles_of_all, spread_of
from toolkit.experiment.units import OUTPUTS, Outcome, Scored
from toolkit.metrics import Metric, Scores, describe
from toolkit.metrics.correction_trend import LIMIT, TREND
from toolkit.metrics.innovations import ACCEPTED, refuses_much
from toolkit.metrics.parts.consistency import POSE_DOF, nees_band
from toolkit.settings import DEFAULTS, Settings

if TYPE_CHECKING:
    from toolkit.answers import Output, Run, Status
    from toolkit.audit import Finding
    from toolkit.geometry import Array
    from toolkit.measurements import Prior
    from toolkit.noise import Card, MeasuredNoise
    from toolkit.sequence import Sequence as Recorded

Verdict = Literal["consistent", "overconfident", "timid", "heavy-tailed", "contradicted"]
NEES, NIS = "nees_pose_mean", "nis_mean"
# The name that stands for the truth among those of trajectories.
TRUTH = "truth"


class ConsistencyMark(Struct, frozen=True, kw_only=True):
    """What a run's errors, or its innovations, say of the uncertainty it states."""

    verdict: Annotated[
        Verdict, Meta(description="mean in, above, below its band; below, behind a gate that rejected many; a trend")
    ]
    metric: Annotated[str, Meta(description="key of the metric it rests on")]
    mean: Annotated[float, Meta(description="its value, over seeds the mean over the runs that are ok")]
    band: Annotated[tuple[float, float], Meta(description="of 95 % of consistent estimators; of a trend to its limit")]


def consistency_of(runs: Iterable[Scored]) -> ConsistencyMark | None:
    """Judge one kind of output of an estimator over one run or several: by NEES where there is one, else by NIS.

    Unless these show overconfidence, a correction trend beyond its limit decides. Returns None where none of these is
    known: no covariance is stated, or a final output has no independent truth.
    """
    scored = list(runs)
    by_errors = _by_errors(scored)
    if by_errors is not None and by_errors.verdict == "overconfident":
        return by_errors
    trends, limits = _known(scored, TREND), _known(scored, LIMIT)
    if trends and (mean := float(np.mean(trends))) > (limit := float(np.mean(limits))):
        return ConsistencyMark(verdict="contradicted", metric=TREND, mean=mean, band=(0.0, limit))
    return by_errors


def _by_errors(scored: Sequence[Scored]) -> ConsistencyMark | None:
    if nees := _known(scored, NEES):
        return _by_band(NEES, nees, float(POSE_DOF * len(nees)))
    innovating = [one for one in scored if one.nis_dof and one.scores.values.get(NIS) is not None]
    if not (nis := _known(innovating, NIS)):
        return None
    # A mean of n chi-square variables over their degrees of freedom d_i has the variance 2 sum(1 / d_i) / n^2.
    dof = len(nis) ** 2 / sum(1.0 / one.nis_dof for one in innovating if one.nis_dof)
    accepted = _known(scored, ACCEPTED)
    refused_much = bool(accepted) and refuses_much(sum(accepted) / len(accepted))
    return _by_band(NIS, nis, dof, refused_much=refused_much)


def _by_band(metric: str, values: list[float], dof: float, *, refused_much: bool = False) -> ConsistencyMark:
    """Judge values that are 1 on average where consistent; small ones prove nothing behind a gate that refused much."""
    mean, (low, high) = sum(values) / len(values), nees_band(dof)
    below: Verdict = "heavy-tailed" if refused_much else "timid"
    verdict: Verdict = "overconfident" if mean > high else "consistent" if mean >= low else below
    return ConsistencyMark(verdict=verdict, metric=metric, mean=mean, band=(low, high))


def _known(scored: Iterable[Scored], key: str) -> list[float]:
    return [value for one in scored if (value := one.scores.values.get(key)) is not None]


@dataclass(frozen=True, eq=False)
class Row:
    """One kind of output of one estimator over all seeds, in their order: a line of the table."""

    output: Output
    outcomes: tuple[Outcome, ...]

    @property
    def estimator(self) -> str:
        return self.outcomes[0].estimator

    @property
    def run(self) -> Run:
        """Return the run under the first seed; only of a comparison that keeps its runs."""
        run = self.outcomes[0].run
        assert run is not None, "a comparison over seeds keeps no runs"
        return run

    @property
    def status(self) -> Status:
        return self.outcomes[0].status

    @cached_property
    def scores(self) -> Scores:
        """The scores under the first seed; without a value where the run gave no such output."""
        scored = self.outcomes[0].outputs.get(self.output)
        if scored is not None:
            return scored.scores
        return Scores.none(describe(), "the run gave no trajectory")

    @property
    def answered(self) -> bool:
        """Say whether any run gave this kind of output."""
        return any(self.output in outcome.outputs for outcome in self.outcomes)

    @property
    def repeats_causal(self) -> bool:
        """Say whether this is a final answer that only repeats the causal one, as a filter's does."""
        return self.output == "final" and self._final_is_causal

    @property
    def label(self) -> str:
        """Return the kind of output, or "both" where one line serves for the two."""
        return "both" if self._final_is_causal else self.output

    @cached_property
    def _final_is_causal(self) -> bool:
        return all(outcome.final_is_causal for outcome in self.outcomes)

    @property
    def counts(self) -> dict[Status, int]:
        counted = Counter(outcome.status for outcome in self.outcomes)
        return {status: counted[status] for status in ("ok", "diverged", "failed")}

    @cached_property
    def good(self) -> tuple[Scored, ...]:
        """The outputs of the runs that are ok; everything that is aggregated is aggregated over these."""
        given = (o.outputs.get(self.output) for o in self.outcomes if o.status == "ok")
        return tuple(scored for scored in given if scored is not None)

    def value(self, key: str) -> float | None:
        """Return a metric's value: that of the only run however it ended, or the mean over the runs that are ok."""
        if len(self.outcomes) == 1:
            return self.scores.values.get(key)
        spread = self.spread(key)
        return None if spread is None else spread.mean

    def values(self, key: str) -> list[float | None]:
        given = (outcome.outputs.get(self.output) for outcome in self.outcomes)
        return [None if scored is None else scored.scores.values.get(key) for scored in given]

    def good_values(self, key: str) -> list[float | None]:
        """Return a metric's value under each seed whose run is ok, None under the others."""
        return [v if o.status == "ok" else None for v, o in zip(self.values(key), self.outcomes, strict=True)]

    def spread(self, key: str) -> Spread | None:
        return spread_of(_known(self.good, key))

    def quantiles_of_all(self, metric: Metric) -> QuantilesAll | None:
        """Return a metric's quartiles over all runs, one that is not ok counted as infinitely bad.

        Returns None where runs are ok and none of them has a value, or no value is better than another.
        """
        good = _known(self.good, metric.key)
        if self.good and not good:
            return None
        return quantiles_of_all(good, len(self.outcomes) - self.counts["ok"], metric.best)

    def reason(self, key: str) -> str:
        """Return why a metric has no value under any seed."""
        if len(self.outcomes) == 1:
            return self.scores.notes.get(key, "not computed")
        notes = (scored.scores.notes.get(key) for scored in self.good)
        return next((note for note in notes if note), "no run is ok" if not self.good else "not computed")

    @cached_property
    def consistency(self) -> ConsistencyMark | None:
        """The verdict on the stated uncertainty by the only run, or over seeds by the runs that are ok, or None."""
        only = self.outcomes[0].outputs.get(self.output) if len(self.outcomes) == 1 else None
        return consistency_of(self.good if only is None else (only,))

    @property
    def mark(self) -> str:
        """Return "overconfident", "timid", "heavy-tailed" or "contradicted" where a run is so, else nothing."""
        verdict = "consistent" if self.consistency is None else self.consistency.verdict
        return "" if verdict == "consistent" else verdict

    @cached_property
    def mean_nees(self) -> MeanNees | None:
        known = [scored.nees_pose for scored in self.good if np.isfinite(scored.nees_pose).any()]
        return mean_nees(np.array(known)) if known else None

    @cached_property
    def position_m(self) -> Array | None:
        known = [scored.position_m for scored in self.good if np.isfinite(scored.position_m).any()]
        return np.array(known) if known else None


class Record(NamedTuple):
    """One value of one metric, as a long table has it.

    ``output`` is "both" for a filter's, whose final output repeats the causal one: what a document of scores has under
    causal and again under final is then there once, and what belongs to causal output alone is among it.
    """

    sequence: str
    seed: int
    estimator: str
    output: Output | Literal["both"]
    metric: str
    value: float | None


@dataclass(frozen=True, eq=False)
class Comparison:
    """Several estimators on the same packets of one sequence, from the same start, under one seed or many.

    ``sequence`` is what the estimators read under the first seed, after any repair; ``findings`` is what the audit saw
    in it before; ``outcomes`` are by estimator, then seed. ``changes`` says, on a ladder only, what each estimator
    changes against the rung before; ``measured`` is the noise that was measured on the recording under the first seed,
    None where the settings state it. ``undecided`` has the faults that the audit could not judge, and why; ``card`` is
    that of the recording's tracks, where asked for. ``own_files`` has the path of each estimator that is a file of the
    user's own.
    """

    source: str
    sequence: Recorded
    findings: tuple[Finding, ...]
    prior: Prior
    seeds: tuple[int, ...]
    outcomes: tuple[Outcome, ...]
    changes: Mapping[str, str] = field(default_factory=dict)
    measured: MeasuredNoise | None = None
    settings: Settings = DEFAULTS
    workers: int = 1
    undecided: Mapping[str, str] = field(default_factory=dict)
    card: Card | None = None
    own_files: Mapping[str, str] = field(default_factory=dict)

    @property
    def over_seeds(self) -> bool:
        return len(self.seeds) > 1

    @property
    def name(self) -> str:
        return self.sequence.name

    @cached_property
    def estimators(self) -> tuple[str, ...]:
        """The estimators' names, in order, other systems' behind."""
        return tuple(dict.fromkeys(outcome.estimator for outcome in self.outcomes))

    @cached_property
    def runs(self) -> tuple[Run, ...]:
        """The runs, by estimator; none where the comparison was repeated over seeds."""
        return tuple(outcome.run for outcome in self.outcomes if outcome.run is not None)

    @cached_property
    def rows(self) -> tuple[Row, ...]:
        """Every kind of output of every estimator; one that gave none under any seed keeps its final one."""
        return tuple(row for name in self.estimators for row in self._rows_of(name))

    @cached_property
    def lines(self) -> tuple[Row, ...]:
        """The rows to print: a final answer that only repeats the causal one has no line of its own."""
        return tuple(row for row in self.rows if not row.repeats_causal)

    @cached_property
    def contests(self) -> tuple[Contest, ...]:
        """What the lines can be ranked by, with tests of whether the first is better by more than chance."""
        return contests_of(self.lines, self.sequence)

    @property
    def all_ok(self) -> bool:
        return all(outcome.status == "ok" for outcome in self.outcomes)

    @property
    def hashes(self) -> tuple[str | None, ...]:
        known = {outcome.seed: outcome.sequence_hash for outcome in self.outcomes if outcome.sequence_hash}
        return tuple(known.get(seed) for seed in self.seeds)

    def records(self) -> Iterator[Record]:
        """Yield every value of every metric once: a row of sequence, seed, estimator, output, metric and value."""
        for outcome in self.outcomes:
            repeats = outcome.final_is_causal
            for output, scored in outcome.outputs.items():
                if repeats and output == "final":
                    continue
                for key, value in scored.scores.values.items():
                    yield Record(self.name, outcome.seed, outcome.estimator, "both" if repeats else output, key, value)

    def _rows_of(self, estimator: str) -> list[Row]:
        outcomes = tuple(outcome for outcome in self.outcomes if outcome.estimator == estimator)
        given = [output for output in OUTPUTS if any(output in outcome.outputs for outcome in outcomes)]
        return [Row(output, outcomes) for output in given or ["final"]]


def in_order(outcomes: Iterable[Outcome], estimators: Sequence[str], seeds: Sequence[int]) -> tuple[Outcome, ...]:
    return tuple(sorted(outcomes, key=lambda o: (estimators.index(o.estimator), seeds.index(o.seed))))
