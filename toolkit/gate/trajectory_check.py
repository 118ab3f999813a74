"""Compare a folder of trajectories with a baseline, or make the baseline of one."""

import time
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path, PurePath
from typing import Protocol

import numpy as np

from toolkit.errors import DataError, no_such, printable
from toolkit.gate.baseline import Criterion, Values
from toolkit.gate.case_check import check_recorded
from toolkit.gate.measuring import place_of
from toolkit.gate.significance import FEWEST_RUNS, Compared, MeanChange, Where, geometric_mean, holm, percent_text
from toolkit.gate.trajectory_baseline import BOUND_PERCENT, ScoredSequence, TrajectoryBaseline
from toolkit.gate.trajectory_files import TIME_COVERAGE, Poses, Scoring, files_by_sequence, read_stamped, scores
from toolkit.gate.verdict import Check, Finding, Verdict
from toolkit.geometry import Array

_SEQUENCE = "sequence"


@dataclass(frozen=True)
class Truths:
    """Where the truth of a sequence is: in a file named for it in a folder, or in one that was named."""

    folder: Path | None = None
    files: Mapping[str, Path] | None = None

    def check(self, sequences: Iterable[str]) -> None:
        """Raise DataError where a truth is named for none of the sequences, as for a misspelt one, or is not there."""
        known = sorted(sequences)
        for name, file in (self.files or {}).items():
            if name not in known:
                raise DataError(f"--truth names the truth of {name}: {no_such('sequence', name, known)}")
            if not file.exists():
                raise DataError(f"--truth {name}={file}: there is no such file; check the path")
        if self.folder is not None and not self.folder.is_dir():
            raise DataError(f"--truth {self.folder}: it is no folder; name one that has SEQUENCE.tum, or SEQUENCE=FILE")

    def of(self, sequence: str) -> Path:
        """Return the truth's file; raises DataError where there is none."""
        if self.files and sequence in self.files:
            return self.files[sequence]
        if self.folder is None:
            raise DataError(f"{sequence}: no truth is given; name it with --truth {sequence}=FILE.tum or --truth DIR")
        found = files_by_sequence(self.folder).get(sequence, ())
        if len(found) != 1:
            raise DataError(f"{sequence}: {self.folder} has {len(found)} truths for it; give one, {sequence}.tum")
        return found[0]


class GivenRuns(Protocol):
    """Runs of a system on sequences, from a folder or scored before."""

    @property
    def sequences(self) -> tuple[str, ...]:
        """Return the sequences there are; raises DataError where there are none."""

    def scored(self, sequence: str, scoring: Scoring, before: ScoredSequence | None) -> ScoredSequence:
        """Return the scores of a sequence; ``before`` is what the baseline has of it.

        Raises DataError where there is no run, or one cannot be used.
        """


@dataclass(frozen=True)
class FolderOfRuns:
    """The trajectory files in a folder, with their truths."""

    folder: Path
    truths: Truths

    @property
    def sequences(self) -> tuple[str, ...]:
        """Return the sequences there are files of; raises DataError where there are none."""
        return tuple(self._files)

    def scored(self, sequence: str, scoring: Scoring, before: ScoredSequence | None) -> ScoredSequence:
        """Score the files of a sequence; the truth is where it is given, or else where the baseline had it."""
        files = self._files.get(sequence, ())
        if not files:
            had = ", ".join(before.files if before else ())
            raise DataError(f"no trajectory of it is in {self.folder}; the baseline has {had}")
        given = before is None or self.truths.folder is not None or sequence in (self.truths.files or {})
        path = self.truths.of(sequence) if before is None or given else place_of(before.truth) or Path(before.truth)
        if not given and not path.is_file():
            raise DataError(f"its truth is not at {path}, where the baseline had it; name another place with --truth")
        truth = read_stamped(path)
        names = tuple(str(file.relative_to(self.folder)) for file in files)
        if before is not None and truth.digest != before.truth_hash:
            return ScoredSequence(path.as_posix(), truth.digest, names, {})
        return ScoredSequence(path.as_posix(), truth.digest, names, _scores_of(files, truth, scoring))

    @cached_property
    def _files(self) -> dict[str, tuple[Path, ...]]:
        return files_by_sequence(self.folder)


def new_trajectory_baseline(given: GivenRuns, scoring: Scoring, made_by: Mapping[str, str]) -> TrajectoryBaseline:
    """Score every run there is; raises DataError for the first that cannot be used."""
    found = {sequence: given.scored(sequence, scoring, None) for sequence in given.sequences}
    bounds = {key: BOUND_PERCENT for key in scoring.metrics if key != TIME_COVERAGE}
    return TrajectoryBaseline(found, scoring, bounds, made_by=made_by)


def check_trajectories(
    baseline: TrajectoryBaseline, name: str, given: GivenRuns, *, accept_better: bool = False
) -> Check:
    """Judge the runs of a system; one that cannot be used is a verdict, not an error.

    Raises DataError where there is no run at all.
    """
    began, there = time.monotonic(), given.sequences
    verdicts: list[Verdict] = []
    compared: list[Compared] = []
    for sequence, before in baseline.sequences.items():
        try:
            now = _now(sequence, before, given, baseline.scoring)
        except DataError as error:
            verdicts.append(Verdict(sequence, "", "", _SEQUENCE, "missing", printable(" ".join(str(error).split()))))
            continue
        verdicts += _missing(sequence, before, now, (*baseline.bounds, TIME_COVERAGE))
        verdicts += _coverage(sequence, before, now, baseline.coverage_points)
        for key, percent in baseline.bounds.items():
            sides = _array(before.scores[key]), _array(now.scores[key])
            if all(side.size for side in sides):
                compared.append(Compared(Where(sequence, "", "", key), Criterion("larger", percent), *sides))
    tested = _tested_together(compared, baseline.false_alarm_rate, accept_better=accept_better)
    order = list(baseline.sequences)
    verdicts = sorted([*verdicts, *tested], key=lambda verdict: order.index(verdict.sequence))
    unknown = sorted(set(there) - set(order))
    notes = [f"not in the baseline, and not checked: {', '.join(unknown)}"] if unknown else []
    tests = sum(_is_tested(one) for one in compared)
    seconds = time.monotonic() - began
    notes += dict.fromkeys(map(_other_rule, filter(_lost_its_test, compared)))
    return Check(name, tuple(verdicts), tuple(notes), baseline.false_alarm_rate, tests, {}, seconds, accept_better)


def _lost_its_test(one: Compared) -> bool:
    """Say whether a metric that the baseline has runs enough to test has too few now."""
    return one.before.size >= FEWEST_RUNS > one.after.size


def _other_rule(one: Compared) -> str:
    return (
        f"{one.where.sequence}: {one.after.size} of the baseline's {one.before.size} runs are left, too few to test; "
        "they are held to the bound instead"
    )


def _is_tested(one: Compared) -> bool:
    """Say whether there are runs enough to tell chance by."""
    return min(one.before.size, one.after.size) >= FEWEST_RUNS


def _now(sequence: str, before: ScoredSequence, given: GivenRuns, scoring: Scoring) -> ScoredSequence:
    """Return a sequence's runs; raises DataError where one cannot be used, or the truth is another."""
    now = given.scored(sequence, scoring, before)
    if now.truth_hash != before.truth_hash:
        raise DataError(f"{now.truth} differs from the baseline's truth; make a new baseline")
    return now


def _missing(sequence: str, before: ScoredSequence, now: ScoredSequence, keys: Iterable[str]) -> Iterator[Verdict]:
    """Fail where a run of the baseline is not there by its file's name, or has no value where it had one."""
    had, has = _names(before.files), _names(now.files)
    missing, new = had - has, has - had
    if missing:
        words = f"{_listed(missing)} not there, of {len(before.files)} runs in the baseline"
        if new:
            words += f"; {_listed(new)} not in it: a run has the name of a file of the baseline"
        yield Verdict(sequence, "", "", "run", "missing", words)
    for key in keys:
        lost = _with_value(before, key) - missing - _with_value(now, key)
        if lost:
            words = f"{_listed(lost)} without a value any more, of {len(before.files)} runs in the baseline"
            yield Verdict(sequence, "", "", key, "missing", words)


def _names(files: Iterable[str]) -> "Counter[str]":
    """Count the names of files, whose folder may be another than the baseline's."""
    return Counter(PurePath(file).name for file in files)


def _with_value(scored: ScoredSequence, key: str) -> "Counter[str]":
    values = zip(scored.files, scored.scores[key], strict=True)
    return _names(file for file, value in values if value is not None)


def _listed(names: "Counter[str]") -> str:
    return f"{', '.join(names.elements())} {'is' if names.total() == 1 else 'are'}"


def _scores_of(files: tuple[Path, ...], truth: Poses, scoring: Scoring) -> dict[str, Values]:
    by_file = [scores(read_stamped(file, truth), truth, scoring) for file in files]
    return {key: tuple(one[key] for one in by_file) for key in scoring.metrics}


def _array(values: Values) -> Array:
    return np.array([value for value in values if value is not None])


def _coverage(sequence: str, before: ScoredSequence, now: ScoredSequence, allowed: float) -> Iterator[Verdict]:
    """Fail where the runs, from the least coverage to the largest, cover less of the time than the baseline's."""
    was, is_ = (np.sort(_array(side.scores[TIME_COVERAGE])) for side in (before, now))
    if not (was.size and is_.size):
        return
    in_order = np.quantile(is_, np.linspace(0.0, 1.0, was.size))
    worst = int(np.argmax(was - in_order))
    old, new = float(was[worst]), float(in_order[worst])
    worse = old - new > allowed
    message = f"a run covered {old:.1f} percent of the time, and {new:.1f} now; {allowed:g} less is allowed"
    finding: Finding = "regressed" if worse else "same"
    yield Verdict(sequence, "", "", TIME_COVERAGE, finding, message if worse else "", old, new)


def _tested_together(compared: list[Compared], rate: float, *, accept_better: bool) -> Iterator[Verdict]:
    """Yield a verdict for each metric: by a test where there are runs enough, else by its bound alone."""
    tested = [one for one in compared if _is_tested(one)]
    spreads = [MeanChange.of(one.before, one.after) for one in tested]
    with_margins = [(spread, one.criterion.margin) for spread, one in zip(spreads, tested, strict=True)]
    up, down = (
        holm(np.array([spread.beyond_p(margin, sign) for spread, margin in with_margins])) for sign in (1.0, -1.0)
    )
    for one, spread, p_up, p_down in zip(tested, spreads, up.tolist(), down.tolist(), strict=True):
        yield _tested(one, spread, (p_up, p_down), rate / 2.0, rate / len(tested) / 2.0, accept_better=accept_better)
    for one in compared:
        if not _is_tested(one):
            was, is_ = float(np.median(one.before)), float(np.median(one.after))
            yield check_recorded(one.where, one.criterion, was, is_, accept_better=accept_better)


def _tested(
    one: Compared, spread: MeanChange, p_values: tuple[float, float], rate: float, each: float, *, accept_better: bool
) -> Verdict:
    worse, better = (p <= rate for p in p_values)
    finding: Finding = "regressed" if worse else "same"
    if better:
        finding = "better" if accept_better else "moved"
    change = 100.0 * float(np.expm1(spread.change))
    runs = f"{one.before.size} runs before, {one.after.size} now"
    p = min(p_values)
    message = "" if finding == "same" else f"{percent_text(change)}, {runs}; chance explains that with p = {p:.2g}"
    where = one.where
    return Verdict(
        where.sequence, where.estimator, where.output, where.metric, finding, message,
        before=geometric_mean(one.before), after=geometric_mean(one.after),
        change_percent=change, allowed_percent=one.criterion.percent, p=p,
        seen_percent=100.0 * float(np.expm1(spread.detectable(one.criterion.margin, each))),
    )  # fmt: skip
