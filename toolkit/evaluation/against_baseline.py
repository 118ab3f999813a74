"""Trajectories of another system against a baseline of its earlier ones, for the accuracy gate; nothing is run.

The baseline holds the scores of each sequence's runs (:mod:`toolkit.evaluation.scoring`), never the trajectories, and
the hash of the truth they were scored against: the contract is ``vislam.trajectory-baseline/1`` (docs/gate.md).

How many runs it needs is planned from the scatter of the first ones. The tests are those of a check
(:mod:`toolkit.gate.significance`) of as many runs as the baseline has, each at the share of the rate that Holm's
correction leaves to the smallest p-value of all. The power of Welch's at a standard deviation s is a noncentral t
probability (Cohen, "Statistical power analysis for the behavioral sciences", 1988, chapter 2). The s of few runs is
itself uncertain, so that the power is averaged over the chi-square distribution of s^2 given them (O'Hagan, Stevens and
Campbell, "Assurance in clinical trial design", Pharmaceutical Statistics 4, 2005).
"""

import time
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path, PurePath
from typing import Annotated, Literal

import numpy as np
from msgspec import Meta, Struct, to_builtins
from scipy.special import chdtri, nctdtr, stdtrit

from toolkit.errors import DataError, no_such, one_line, printable
from toolkit.evaluation.gathering import Item, files_by_sequence, truths_in
from toolkit.evaluation.scoring import TIME_COVERAGE, Terms, read_truth
from toolkit.evaluation.standings import EvaluationRecord, RunRecord, evaluated_run, read_evaluation
from toolkit.files import documents
from toolkit.gate.baseline import FALSE_ALARM_RATE, BaselineError, Criterion, MetricValues, Percent, Values, json_text
from toolkit.gate.checking import check_recorded
from toolkit.gate.measuring import place_of
from toolkit.gate.significance import FEWEST_RUNS, Everywhere, Repeats, check_metrics
from toolkit.gate.verdict import Check, Finding, Verdict, Where, verdict_on
from toolkit.geometry import Array
from toolkit.settings import SettingsError

Align = Literal["se3", "yaw", "sim3"]
# Growth of an error that is no regression (percent), and loss of time coverage that is accepted (percentage points).
BOUND_PERCENT, COVERAGE_POINTS = 5.0, 2.0
# Failed runs whose reasons are told.
_NAMED = 3
# In the place of a sequence's name, where all of them are judged together.
EVERYWHERE = "all sequences"
# Growths whose chance of being found is told; the chance that is wanted; and the most runs that are thought of for it.
CHANGES_PERCENT = (5.0, 10.0, 20.0)
WANTED, MOST_RUNS = 0.9, 200
_QUANTILES = (np.arange(20) + 0.5) / 20.0


class SequenceRecord(Struct, frozen=True, kw_only=True):
    """The truth of a sequence, and the scores of its runs."""

    sequence: str
    truth: Annotated[str, Meta(description="the truth's file, from where the baseline was made")]
    truth_hash: Annotated[str, Meta(description="of the truth's stamps and poses, to nine digits")]
    files: Annotated[tuple[str, ...], Meta(description="a run each", min_length=1)]
    scores: MetricValues

    def __post_init__(self) -> None:
        for key, values in self.scores.items():
            if len(values) != len(self.files):
                raise ValueError(f"scores.{key} does not have an entry a file")


# The runs of a sequence, and why some failed, by their files.
ScoredSequence = tuple[SequenceRecord, Mapping[str, str]]


class TrajectoryBaselineRecord(Struct, frozen=True, kw_only=True):
    """How trajectories are scored, what came of it, and what counts as worse."""

    schema: Literal["vislam.trajectory-baseline/1"]
    made_by: Annotated[dict[str, str], Meta(description="how, when and where it was made")]
    align: Annotated[Align, Meta(description="what is fitted before positions are compared")]
    gap_s: Annotated[float, Meta(description="the longest time between two poses that counts as covered", gt=0)]
    bounds: Annotated[dict[str, Percent], Meta(description="by metric key, the growth in percent that is allowed")]
    coverage_points: Annotated[float, Meta(description="percent of the time that may be lost", ge=0)]
    false_alarm_rate: Annotated[float, Meta(description="of all statistical tests of a check together", gt=0, lt=1)]
    sequences: Annotated[tuple[SequenceRecord, ...], Meta(min_length=1)]

    def __post_init__(self) -> None:
        scored = scored_metrics(self.align)
        for key in self.bounds:
            if key not in scored or key == TIME_COVERAGE:
                raise ValueError(f"bounds.{key} is not among what is scored: {', '.join(scored)}")
        for one in self.sequences:
            lacking = [key for key in (*self.bounds, TIME_COVERAGE) if key not in one.scores]
            if lacking:
                raise ValueError(f"{one.sequence} has no scores.{lacking[0]}")


def scored_metrics(align: Align) -> tuple[str, ...]:
    """Return what is scored; a scale that is fitted leaves no drift in metres to speak of."""
    drift = () if align == "sim3" else ("rpe_100m_percent",)
    return (f"ate_{align}_m", "ate_se3_deg", *drift, TIME_COVERAGE)


def load_trajectory_baseline(path: Path) -> TrajectoryBaselineRecord:
    """Read the file; raises BaselineError where there is none, or it is not one."""
    remedy = "make the baseline with vislam baseline --trajectories"
    try:
        return documents.read(path, TrajectoryBaselineRecord, remedy=remedy, error=BaselineError)
    except BaselineError as error:
        if "'vislam.baseline/" not in str(error):
            raise
        why = "is a baseline of estimators, which are run to check it; leave --trajectories out"
        raise BaselineError(f"{path} {why}") from error


def to_text(baseline: TrajectoryBaselineRecord) -> str:
    return json_text(to_builtins(baseline))


def truths_given(words: Sequence[str], sequences: Iterable[str]) -> dict[str, Path]:
    """Return the truths that words name, a folder that has SEQUENCE.tum or SEQUENCE=FILE, by sequence.

    Raises DataError where one is of none of the sequences, as of a misspelt one, or is not there, SettingsError where
    two folders are named.
    """
    folders, known = [text for text in words if "=" not in text or Path(text).is_dir()], sorted(sequences)
    if len(folders) > 1:
        raise SettingsError(f"--truth names two folders, {folders[0]} and {folders[1]}; give one")
    named = [text.partition("=") for text in words if text not in folders]
    for name, _, file in named:
        if name not in known:
            raise DataError(f"--truth names the truth of {name}: {no_such('sequence', name, known)}")
        if not Path(file).exists():
            raise DataError(f"--truth {name}={file}: there is no such file; check the path")
    in_folder = truths_in(Path(folders[0])) if folders else {}
    return in_folder | {name: Path(file) for name, _, file in named}


@dataclass(frozen=True)
class FolderOfRuns:
    """The trajectory files in a folder, with truths by sequence."""

    folder: Path
    truths: Mapping[str, Path]

    @property
    def sequences(self) -> tuple[str, ...]:
        """The sequences there are files of; raises DataError where there are none."""
        return tuple(self._files)

    def scored(self, sequence: str, align: Align, gap_s: float, before: SequenceRecord | None) -> ScoredSequence:
        """Score the files of a sequence; the truth is where it is given, or else where the baseline had it.

        ``before`` is what the baseline has of it; beside it a file that cannot be used is a run that failed, which has
        no scores. Raises DataError where there is no file, or none can be used, or one cannot of which a baseline is
        made.
        """
        files = self._files.get(sequence, ())
        if not files:
            had = ", ".join(before.files if before else ())
            raise DataError(f"no trajectory of it is in {self.folder}; the baseline has {had}")
        if sequence in self.truths:
            path = self.truths[sequence]
        elif before is None:
            raise DataError(f"{sequence}: no truth is given; name it with --truth {sequence}=FILE.tum or --truth DIR")
        elif not (path := place_of(before.truth) or Path(before.truth)).is_file():
            where = f"its truth is not at {path}, where the baseline had it"
            raise DataError(f"{where}; name another place with --truth")
        truth, terms = read_truth(sequence, path), Terms(gap_s=gap_s, least_coverage_percent=0.0)
        names = {file: str(file.relative_to(self.folder)) for file in files}
        runs = {name: evaluated_run(Item("", sequence, name, file), truth, terms) for file, name in names.items()}
        return _record(sequence, (path.as_posix(), truth.digest), runs, align, before)

    @cached_property
    def _files(self) -> dict[str, tuple[Path, ...]]:
        return files_by_sequence(self.folder)


@dataclass(frozen=True)
class EvaluatedRuns:
    """The runs of an ``evaluation.json``: a sequence is SYSTEM/SEQUENCE where there are several systems.

    Coverage and errors must be by the gate's own rules, so that the nearest poses of ``--max-dt`` are refused.
    """

    path: Path

    @property
    def sequences(self) -> tuple[str, ...]:
        return tuple(self._runs)

    def scored(self, sequence: str, align: Align, gap_s: float, before: SequenceRecord | None) -> ScoredSequence:
        """Return the scores of a sequence's runs; raises DataError as a folder does, or where they have other terms."""
        terms = self._record.terms
        if terms.max_dt_s is not None:
            raise DataError(f"{self.path}: it pairs nearest poses; evaluate again without --max-dt")
        if terms.gap_s != gap_s:
            gaps = f"its longest covered gap is {terms.gap_s:g} s, the baseline's {gap_s:g} s"
            raise DataError(f"{self.path}: {gaps}; evaluate again with --gap {gap_s:g}")
        runs = self._runs.get(sequence, ())
        if not runs:
            raise DataError(f"no run is in {self.path}; the baseline has {', '.join(before.files if before else ())}")
        truth = next(one for one in self._record.sequences if one.sequence == runs[0].sequence)
        by_file = {run.file or run.run: run for run in runs}
        return _record(sequence, (truth.truth, truth.truth_hash), by_file, align, before)

    @cached_property
    def _record(self) -> EvaluationRecord:
        return read_evaluation(self.path)

    @cached_property
    def _runs(self) -> dict[str, list[RunRecord]]:
        several = len({run.estimator for run in self._record.runs}) > 1
        found: dict[str, list[RunRecord]] = {}
        for run in self._record.runs:
            found.setdefault(f"{run.estimator}/{run.sequence}" if several else run.sequence, []).append(run)
        return found


def _record(
    sequence: str, truth: tuple[str, str], runs: Mapping[str, RunRecord], align: Align, before: SequenceRecord | None
) -> ScoredSequence:
    """Return the scores of a sequence's runs, and why there are none, by file; ``truth`` is its place and its hash.

    Raises DataError where the truth is not the baseline's, all failed, or any where a baseline is made of them.
    """
    if before is not None and truth[1] != before.truth_hash:
        raise DataError(f"{truth[0]} differs from the baseline's truth; make a new baseline")
    why = {
        file: run.log[0] if run.file else f"{run.run}: {run.log[0]}" for file, run in runs.items() if run.status != "ok"
    }
    failed = {file: printable(words) for file, words in why.items()}
    if failed and (before is None or len(failed) == len(runs)):
        raise DataError(next(iter(failed.values())))
    scores = {
        key: tuple(None if file in failed else run.metrics.get(key) for file, run in runs.items())
        for key in scored_metrics(align)
    }
    files = tuple(runs)
    return SequenceRecord(sequence=sequence, truth=truth[0], truth_hash=truth[1], files=files, scores=scores), failed


# Runs of a system on sequences, in a folder or scored before.
GivenRuns = FolderOfRuns | EvaluatedRuns


def new_trajectory_baseline(
    given: GivenRuns, align: Align, gap_s: float, made_by: Mapping[str, str], bound_percent: float = BOUND_PERCENT
) -> TrajectoryBaselineRecord:
    """Score every run there is; raises DataError for the first that cannot be used."""
    sequences = tuple(given.scored(sequence, align, gap_s, None)[0] for sequence in given.sequences)
    # What has no value, as orientations beside a truth of positions, has no bound either.
    valued = {key for one in sequences for key, values in one.scores.items() if any(v is not None for v in values)}
    return TrajectoryBaselineRecord(
        schema="vislam.trajectory-baseline/1",
        made_by=dict(made_by),
        align=align,
        gap_s=gap_s,
        bounds={key: bound_percent for key in scored_metrics(align) if key in valued - {TIME_COVERAGE}},
        coverage_points=COVERAGE_POINTS,
        false_alarm_rate=FALSE_ALARM_RATE,
        sequences=sequences,
    )


def check_trajectories(
    baseline: TrajectoryBaselineRecord, name: str, given: GivenRuns, *, accept_better: bool = False
) -> Check:
    """Judge the runs of a system; one that cannot be used is a verdict, not an error.

    Raises DataError where there is no run at all.
    """
    began, there = time.monotonic(), given.sequences
    order = [one.sequence for one in baseline.sequences]
    unknown = sorted(set(there) - set(order))
    notes = [f"not in the baseline, and not checked: {', '.join(unknown)}"] if unknown else []
    verdicts: list[Verdict] = []
    tests: list[Repeats] = []
    for before in baseline.sequences:
        try:
            now, failed = given.scored(before.sequence, baseline.align, baseline.gap_s, before)
        except DataError as error:
            verdicts.append(_verdict(before, "sequence", "missing", printable(one_line(str(error)))))
            continue
        if failed:
            words = f"{len(failed)} of {len(now.files)} runs failed: {'; '.join(list(failed.values())[:_NAMED])}"
            verdicts.append(_verdict(before, "run", "regressed", words))
        verdicts += _missing(before, now, (*baseline.bounds, TIME_COVERAGE), _names(failed))
        verdicts += _coverage(before, now, baseline.coverage_points)
        for key, percent in baseline.bounds.items():
            was, is_ = _known(before.scores[key]), _known(now.scores[key])
            where, criterion = Where(before.sequence, "", "", key), Criterion("larger", percent)
            if min(was.size, is_.size) >= FEWEST_RUNS:
                tests.append(Repeats(where, criterion, was, is_))
            elif was.size and is_.size:
                medians = float(np.median(was)), float(np.median(is_))
                verdicts.append(check_recorded(where, criterion, *medians, accept_better=accept_better))
                if was.size >= FEWEST_RUNS:
                    left = f"{is_.size} of the baseline's {was.size} runs are left"
                    notes.append(f"{before.sequence}: {left}, too few to test; they are held to the bound instead")
    tests += list(everywhere(tests))
    rate = baseline.false_alarm_rate
    verdicts += check_metrics(tests, rate, accept_better=accept_better)
    verdicts.sort(key=lambda verdict: [*order, EVERYWHERE].index(verdict.sequence))
    return Check.of(
        verdicts, baseline=name, notes=tuple(dict.fromkeys(notes)), false_alarm_rate=rate, tests=len(tests),
        releases={}, seconds=time.monotonic() - began, accept_better=accept_better,
    )  # fmt: skip


def everywhere(tests: Iterable[Repeats]) -> Iterator[Repeats]:
    """Yield the test of each metric on all sequences together, where it is tested on two or more."""
    by_metric: dict[str, list[Repeats]] = {}
    for one in tests:
        by_metric.setdefault(one.where.metric, []).append(one)
    for key, parts in by_metric.items():
        if len(parts) > 1:
            yield Everywhere.of(Where(EVERYWHERE, "", "", key), parts)


def _verdict(before: SequenceRecord, metric: str, finding: Finding, words: str, *values: float) -> Verdict:
    return verdict_on(Where(before.sequence, "", "", metric), finding, words, *values)


def _missing(
    before: SequenceRecord, now: SequenceRecord, keys: Iterable[str], failed: "Counter[str]"
) -> Iterator[Verdict]:
    """Fail where a run of the baseline is not there by its file's name, or has no value where it had one.

    Those that ``failed`` are told by themselves.
    """
    had, has = _names(before.files), _names(now.files)
    missing, new = had - has, has - had
    if missing:
        words = f"{_listed(missing)} not there, of {len(before.files)} runs in the baseline"
        if new:
            words += f"; {_listed(new)} not in it: a run has the name of a file of the baseline"
        yield _verdict(before, "run", "missing", words)
    for key in keys:
        lost = _with_value(before, key) - missing - failed - _with_value(now, key)
        if lost:
            words = f"{_listed(lost)} without a value any more, of {len(before.files)} runs in the baseline"
            yield _verdict(before, key, "missing", words)


def _names(files: Iterable[str]) -> "Counter[str]":
    """Count the names of files, whose folder may be another than the baseline's."""
    return Counter(PurePath(file).name for file in files)


def _with_value(scored: SequenceRecord, key: str) -> "Counter[str]":
    values = zip(scored.files, scored.scores[key], strict=True)
    return _names(file for file, value in values if value is not None)


def _listed(names: "Counter[str]") -> str:
    return f"{', '.join(names.elements())} {'is' if names.total() == 1 else 'are'}"


def _known(values: Values) -> Array:
    return np.array([value for value in values if value is not None])


def _coverage(before: SequenceRecord, now: SequenceRecord, allowed: float) -> Iterator[Verdict]:
    """Fail where the runs, from the least coverage to the largest, cover less of the time than the baseline's."""
    was, is_ = (np.sort(_known(side.scores[TIME_COVERAGE])) for side in (before, now))
    if not (was.size and is_.size):
        return
    in_order = np.quantile(is_, np.linspace(0.0, 1.0, was.size))
    worst = int(np.argmax(was - in_order))
    old, new = float(was[worst]), float(in_order[worst])
    worse = old - new > allowed
    words = f"a run covered {old:.1f} percent of the time, and {new:.1f} now; {allowed:g} less is allowed"
    yield _verdict(before, TIME_COVERAGE, "regressed" if worse else "same", words if worse else "", old, new)


# How many runs a gate needs ------------------------------------------------------------------------------------------


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
    tests: list[Repeats] = []
    for one in baseline.sequences:
        for key, percent in baseline.bounds.items():
            values = _known(one.scores[key])
            if values.size >= FEWEST_RUNS:  # as if the baseline's own runs came again
                tests.append(Repeats(Where(one.sequence, "", "", key), Criterion("larger", percent), values, values))
    if not tests:
        raise DataError(
            f"no sequence has {FEWEST_RUNS} runs, of which the scatter is known; give the files of repeated runs, "
            "SEQUENCE/RUN.tum"
        )
    tests += everywhere(tests)
    rate = baseline.false_alarm_rate / 2.0 / len(tests)
    return tuple(_planned(one, rate) for one in tests)


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
