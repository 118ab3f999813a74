"""Statistics over runs and sequences; a run that failed counts in each of them as infinitely bad.

Over the runs of a system on a sequence: median and quartiles. Over sequences: ranks, and tests of each pair of systems
by Wilcoxon's signed-rank test on the logarithms of the ratios of their medians (Wilcoxon, Biometrics Bulletin 1, 1945),
in its exact form for ties (Pratt and Gibbons, "Concepts of nonparametric theory", 1981, section 3.7), with Holm's
correction over all pairs. A sequence on which one of two systems has no median is the largest difference there is.

``evaluation.json``, the contract ``vislam.evaluation/1`` (docs/evaluate.md), holds all of it: an entry of ``runs`` is
one of ``metrics.json`` with the sequence and the file it is of.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import combinations
from typing import Annotated, Literal

import numpy as np
from msgspec import UNSET, Meta, Struct, UnsetType

from toolkit.answers import Status
from toolkit.errors import DataError, one_line
from toolkit.evaluation.gathering import Gathered, Item
from toolkit.evaluation.scoring import COVERAGE, METRICS, Terms, TruthFile, read_truth, score_file
from toolkit.experiment.statistics import Quartiles, holm, quantiles_of_all
from toolkit.experiment.workers import LostUnit, results_of
from toolkit.files import documents
from toolkit.files.documents import Count, Value, of_attributes
from toolkit.gate.baseline import FALSE_ALARM_RATE
from toolkit.geometry import Array
from toolkit.metrics import Metric, Scores
from toolkit.progress import SILENT, Progress

METRIC_BY_KEY: Mapping[str, Metric] = {metric.key: metric for metric in METRICS}
RANKED_BY = "ate_se3_m"
# Processes take a second to start; a single process scores this many files in that time.
_WORTH_PROCESSES = 200
# Most signs that are counted exactly; beyond it the smallest p-value is below 1e-300 anyway.
_MOST_EXACT = 1000


class RunRecord(Struct, frozen=True, kw_only=True):
    """One run of one system."""

    sequence: str
    estimator: Annotated[str, Meta(description="the system's name")]
    run: str
    file: Annotated[str | None, Meta(description="as it was given; null where there is none and ought to be one")]
    output: Literal["final"]
    status: Status
    metrics: Annotated[dict[str, Value], Meta(description="by metric key")]
    notes: Annotated[dict[str, str], Meta(description="by metric key, why there is no value, or a remark on it")]
    log: Annotated[tuple[str, ...], Meta(description="why it failed")]

    def __post_init__(self) -> None:
        for key, value in self.metrics.items():
            if value is None and not self.notes.get(key):
                raise ValueError(f"metrics.{key} is null, and notes does not say why")
        if self.status != "ok" and not self.log:
            raise ValueError(f"status is {self.status}, and log does not say why")


class OverRuns(Struct, frozen=True, kw_only=True):
    """All runs of a system on a sequence."""

    sequence: str
    estimator: str
    runs: Count
    ok: Count
    metrics: Annotated[dict[str, Quartiles | None], Meta(description="null where runs are ok and none has a value")]

    def median(self, metric: Metric) -> float | None:
        """Return the median over all runs, None where failed runs decide it or there is no value."""
        found = self.metrics.get(metric.key)
        return None if found is None else found.median


class StandingRecord(Struct, frozen=True, kw_only=True):
    """A system over all sequences, best first."""

    estimator: Annotated[str, Meta(description="the system's name")]
    mean_rank: Annotated[float, Meta(description="over the sequences, by the median over the runs; 1 is the best")]
    wins: Annotated[Count, Meta(description="sequences on which every other system is worse")]
    sequences: Count
    solved: Annotated[Count, Meta(description="sequences with a median over the runs")]
    runs: Count
    ok: Count
    metrics: Annotated[dict[str, Quartiles | None], Meta(description="over the medians of the sequences")]


class PairedRecord(Struct, frozen=True, kw_only=True):
    """Two systems, paired over the sequences."""

    estimator: Annotated[str, Meta(description="the first system's name")]
    other: str
    better: Annotated[Count, Meta(description="sequences on which the first is better")]
    worse: Count
    tied: Count
    median_ratio: Annotated[float | None, Meta(description="first to second; null where failures decide it")]
    p: Annotated[float, Meta(description="Wilcoxon's signed-rank test, exact, two-sided", ge=0, le=1)]
    p_holm: Annotated[float, Meta(description="corrected for all pairs", ge=0, le=1)]

    @property
    def is_significant(self) -> bool:
        """Say whether the two differ by more than chance, at 5 % for all pairs together."""
        return self.p_holm <= FALSE_ALARM_RATE


@dataclass(frozen=True, eq=False)
class EvaluatedSystems:
    """Every run of every system, the truths, and by which metric systems are ranked."""

    truths: Mapping[str, TruthFile]
    terms: Terms
    runs: tuple[RunRecord, ...]
    ranked_by: Metric
    notes: tuple[str, ...] = field(default=())

    @cached_property
    def systems(self) -> tuple[str, ...]:
        return tuple(dict.fromkeys(run.estimator for run in self.runs))

    @property
    def sequences(self) -> tuple[str, ...]:
        return tuple(self.truths)

    @cached_property
    def cells(self) -> Mapping[tuple[str, str], OverRuns]:
        """The runs by system and sequence; every pair of the two has some."""
        return {pair: self._over_runs(*pair, runs) for pair, runs in self._runs_of.items()}

    @cached_property
    def _runs_of(self) -> Mapping[tuple[str, str], list[RunRecord]]:
        found: dict[tuple[str, str], list[RunRecord]] = {}
        for run in self.runs:
            found.setdefault((run.estimator, run.sequence), []).append(run)
        return found

    def ok_runs(self, system: str, sequence: str) -> list[RunRecord]:
        return [run for run in self._runs_of[system, sequence] if run.status == "ok"]

    @property
    def all_ok(self) -> bool:
        return all(run.status == "ok" for run in self.runs)

    @cached_property
    def scored_metrics(self) -> tuple[Metric, ...]:
        given = {key for run in self.runs for key, value in run.metrics.items() if value is not None}
        return tuple(metric for metric in METRICS if metric.key in given)

    @cached_property
    def leaderboard(self) -> tuple[StandingRecord, ...]:
        """The systems from the lowest mean rank up, and of the same mean rank in the order given."""
        from scipy.stats import rankdata  # its import takes as long as all others

        ranks = rankdata(list(self._costs.values()), axis=0)  # (systems, sequences), from 1, of equals the mean
        standings = [self._standing(system, row) for system, row in zip(self.systems, ranks, strict=True)]
        return tuple(sorted(standings, key=lambda standing: standing.mean_rank))

    @cached_property
    def paired(self) -> tuple[PairedRecord, ...]:
        """Every pair of systems over the sequences, the one higher on the leaderboard first; none of one sequence."""
        order = [standing.estimator for standing in self.leaderboard]
        pairs = list(combinations(order, 2)) if len(self.sequences) > 1 else []
        ratios = [_log_ratios(self._costs[one], self._costs[other]) for one, other in pairs]
        p_values = [signed_rank_p(given) for given in ratios]
        corrected = holm(np.array(p_values)).tolist()
        return tuple(_paired(*one) for one in zip(pairs, ratios, p_values, corrected, strict=True))

    @cached_property
    def ranked_sequences(self) -> tuple[str, ...]:
        """The sequences that can rank systems: some have a median there. All of them where none does."""
        metric, cells = self.ranked_by, self.cells
        found = [s for s in self.sequences if any(cells[name, s].median(metric) is not None for name in self.systems)]
        return tuple(found) or self.sequences

    @cached_property
    def _costs(self) -> Mapping[str, Array]:
        """Each system's cost (sequences,), the smaller the better: the metric's median, infinite where there is none.

        Where the ideal value is 1, the cost is the factor by which the median differs from it.
        """
        cells, by = self.cells, self.ranked_by
        return {
            name: np.array([_cost(cells[name, sequence].median(by), by) for sequence in self.ranked_sequences])
            for name in self.systems
        }

    def _over_runs(self, system: str, sequence: str, runs: Sequence[RunRecord]) -> OverRuns:
        good = [run.metrics for run in runs if run.status == "ok"]
        metrics: dict[str, Quartiles | None] = {}
        for metric in self.scored_metrics:
            values = [value for run in good if (value := run.get(metric.key)) is not None]
            metrics[metric.key] = None if good and not values else _quartiles(values, len(runs) - len(good), metric)
        return OverRuns(sequence=sequence, estimator=system, runs=len(runs), ok=len(good), metrics=metrics)

    def _standing(self, system: str, ranks: Array) -> StandingRecord:
        cells = [self.cells[system, sequence] for sequence in self.sequences]
        solved = np.isfinite(self._costs[system])
        return StandingRecord(
            estimator=system,
            mean_rank=float(ranks.mean()),
            wins=int(((ranks == 1.0) & solved).sum()),
            sequences=len(cells),
            solved=int(solved.sum()),
            runs=sum(cell.runs for cell in cells),
            ok=sum(cell.ok for cell in cells),
            metrics={metric.key: _over_sequences(cells, metric) for metric in self.scored_metrics},
        )


def _log_ratios(one: Array, two: Array) -> Array:
    """Return the logarithms (sequences,) of the ratios of costs; infinite where one is, 0 where both are."""
    with np.errstate(all="ignore"):  # of two that are infinite, or zero, the ratio is no number
        return np.where(one == two, 0.0, np.log(one / two))


def _cost(value: float | None, metric: Metric) -> float:
    if value is None or (metric.best in ("most", "one") and value <= 0.0):
        return np.inf
    if metric.best == "one":
        return max(value, 1.0 / value)
    return 1.0 / value if metric.best == "most" else value


def evaluate(
    gathered: Gathered, terms: Terms, ranked_by: str = RANKED_BY, progress: Progress = SILENT, workers: int = 1
) -> EvaluatedSystems:
    """Score every run, in ``workers`` processes where they are many.

    Raises DataError where a truth cannot be used, or no run can. A single run that cannot be used counts as failed,
    with the reason, and so does a run that covers too little of the truth's time.
    """
    truths = {name: read_truth(name, path, terms.cov_convention) for name, path in gathered.truths.items()}
    # All runs of a sequence, which share its truth, are the work of one process.
    of_sequence = {name: [item for item in gathered.items if item.sequence == name] for name in truths}
    units = [(truths[name], items, terms) for name, items in of_sequence.items()]
    scored: dict[Item, RunRecord] = {}
    processes = workers if len(gathered.items) >= _WORTH_PROCESSES else 1
    for place, result in results_of(units, processes, _evaluated, progress):
        items = units[place][1]
        found = [_run(item, None, result.why) for item in items] if isinstance(result, LostUnit) else result
        scored |= zip(items, found, strict=True)
    runs = tuple(scored[item] for item in gathered.items)
    if not any(value is not None for run in runs for value in run.metrics.values()):
        raise DataError(next(run.log[0] for run in runs if run.log))
    return EvaluatedSystems(truths, terms, runs, METRIC_BY_KEY[ranked_by], gathered.notes)


def _evaluated(unit: tuple[TruthFile, list[Item], Terms], progress: Progress) -> list[RunRecord]:
    truth, items, terms = unit
    runs = []
    for i, item in enumerate(items):
        progress.advance(i, len(items))
        runs.append(evaluated_run(item, truth, terms))
    return runs


def evaluated_run(item: Item, truth: TruthFile, terms: Terms) -> RunRecord:
    """Score a run; one that cannot be used, or covers too little of the truth's time, failed, with the reason."""
    if item.path is None:
        return _run(item, None, "there is no trajectory")
    try:
        scores = score_file(item.path, truth, terms)
    except DataError as error:
        return _run(item, None, one_line(str(error)))
    covered = scores.values[COVERAGE.key]
    if covered is not None and covered < terms.least_coverage_percent:
        why = f"it covers {covered:.1f} % of the truth's time, and {terms.least_coverage_percent:g} % is required"
        return _run(item, scores, f"{item.path}: {why}")
    return _run(item, scores)


def _run(item: Item, scores: Scores | None, why: str = "") -> RunRecord:
    scores = scores or Scores.none(METRIC_BY_KEY, why)
    values = {key: scores.values.get(key) for key in METRIC_BY_KEY}
    return RunRecord(
        sequence=item.sequence,
        estimator=item.system,
        run=item.run,
        file=None if item.path is None else item.path.as_posix(),
        output="final",
        status="failed" if why else "ok",
        metrics={key: int(v) if v is not None and METRIC_BY_KEY[key].count else v for key, v in values.items()},
        notes={key: scores.notes[key] for key in sorted(scores.notes)},
        log=(why,) if why else (),
    )


def signed_rank_p(differences: Array) -> float:
    """Return the two-sided p-value of Wilcoxon's signed-rank test, exact whatever ties there are.

    Differences (n,) of zero are left out; infinite ones are all equally large. Without any difference the result is 1.
    The distribution of the sum of the ranks over all 2^n signs is counted, ranks doubled to be whole.
    """
    given = differences[differences != 0.0][:_MOST_EXACT]
    if not given.size:
        return 1.0
    from scipy.stats import rankdata

    doubled = np.rint(2.0 * rankdata(np.abs(given))).astype(int)
    chance = np.zeros(int(doubled.sum()) + 1)
    chance[0] = 1.0
    for rank in doubled.tolist():
        chance[rank:] += chance[: chance.size - rank].copy()
        chance *= 0.5
    positive = int(doubled[given > 0.0].sum())
    tail = min(float(chance[: positive + 1].sum()), float(chance[positive:].sum()))
    return min(1.0, 2.0 * tail)


def _paired(pair: tuple[str, str], log_ratios: Array, p: float, p_holm: float) -> PairedRecord:
    with np.errstate(invalid="ignore"):  # of two infinite ratios of either sign the median is no number
        median = float(np.median(log_ratios))
    better, worse = int((log_ratios < 0.0).sum()), int((log_ratios > 0.0).sum())
    return PairedRecord(
        estimator=pair[0],
        other=pair[1],
        better=better,
        worse=worse,
        tied=log_ratios.size - better - worse,
        median_ratio=float(np.exp(median)) if np.isfinite(median) else None,
        p=p,
        p_holm=p_holm,
    )


def _over_sequences(cells: Sequence[OverRuns], metric: Metric) -> Quartiles | None:
    """Return the quartiles of the medians of sequences; those where every ok run lacks the metric take no part."""
    due = [cell for cell in cells if cell.metrics[metric.key] is not None]
    medians = [median for cell in due if (median := cell.median(metric)) is not None]
    return _quartiles(medians, len(due) - len(medians), metric) if medians else None


def _quartiles(good: Iterable[float], bad: int, metric: Metric) -> Quartiles | None:
    found = quantiles_of_all(good, bad, metric.best or "most")
    return None if found is None else of_attributes(Quartiles, found)


class TermsRecord(Struct, frozen=True, kw_only=True):
    """How trajectories were scored."""

    max_dt_s: Annotated[float | None, Meta(description="nearest poses no farther apart in time; null: interpolated")]
    offset_s: Annotated[float, Meta(description="added to the stamps of the trajectories")]
    gap_s: Annotated[float, Meta(description="the longest time between two poses that counts as covered", gt=0)]
    level: Annotated[bool, Meta(description="whether the vertical is measured: first poses turn about it alone")]
    least_coverage_percent: Annotated[float, Meta(description="of the time, below which a run counts as failed")]


class SequenceScored(Struct, frozen=True, kw_only=True):
    """The truth of a sequence."""

    sequence: str
    truth: Annotated[str, Meta(description="the truth's file, as it was given")]
    truth_hash: Annotated[str, Meta(description="of the truth's stamps and poses, to nine digits")]
    poses: Count
    duration_s: Annotated[float, Meta(ge=0)]
    path_m: Annotated[float, Meta(ge=0)]


class EvaluationRecord(Struct, frozen=True, kw_only=True):
    """Every run of every system, and what they say together."""

    schema: Literal["vislam.evaluation/1"]
    terms: TermsRecord
    ranked_by: Annotated[str, Meta(description="key of the metric that ranks and tests")]
    sequences: Annotated[tuple[SequenceScored, ...], Meta(min_length=1)]
    runs: Annotated[tuple[RunRecord, ...], Meta(min_length=1)]
    over_runs: tuple[OverRuns, ...]
    leaderboard: tuple[StandingRecord, ...]
    paired: Annotated[tuple[PairedRecord, ...], Meta(description="every pair of systems; empty for one sequence")]
    notes: tuple[str, ...]
    figures: Annotated[tuple[str, ...], Meta(description="files in the folder of figures")] | UnsetType = UNSET

    def __post_init__(self) -> None:
        known = {one.sequence for one in self.sequences}
        for i, run in enumerate(self.runs):
            if run.sequence not in known:
                raise ValueError(f"runs[{i}].sequence is none of sequences")


def evaluation_document(evaluation: EvaluatedSystems) -> EvaluationRecord:
    sequences = [
        of_attributes(
            SequenceScored, one, sequence=name, truth=one.path.as_posix(), truth_hash=one.digest, poses=len(one.poses)
        )
        for name, one in evaluation.truths.items()
    ]
    return of_attributes(
        EvaluationRecord,
        evaluation,
        schema="vislam.evaluation/1",
        terms=of_attributes(TermsRecord, evaluation.terms),
        ranked_by=evaluation.ranked_by.key,
        sequences=tuple(sequences),
        over_runs=tuple(evaluation.cells.values()),
        figures=UNSET,
    )


# Reads an ``evaluation.json``; raises DataError, in one line with the place, where it is not one.
read_evaluation = documents.reader(EvaluationRecord, "make it with vislam evaluate --out")
