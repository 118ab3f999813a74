"""What is said of a comparison: notes on statuses, findings and missing values, and the verdict.

The verdict says who is most accurate, how certain that is, whose covariance holds, at what cost. Only what a paired
test supports is called a difference (:mod:`toolkit.experiment.contests`).
"""

import math
import re
import shlex
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Annotated

import numpy as np
from msgspec import Meta, Struct

from toolkit.answers import Output
from toolkit.audit import Finding, faults
from toolkit.experiment.comparison import NEES, Comparison, Row
from toolkit.experiment.contests import CONFIDENCE, COST, HELD_OUT, Contest, Question, cheaper_near, too_far
from toolkit.experiment.statistics import ratio_of_means
from toolkit.files.documents import rounded
from toolkit.metrics import is_on_request, metrics_called, unavailable
from toolkit.metrics.innovations import ACCEPTED, refuses_much
from toolkit.metrics.reprojection import RATIO
from toolkit.registry import discover
from toolkit.report.headers import Columns, explained_metrics, shown_metrics
from toolkit.report.text import cell, listed, number

# A consistent estimator is in its band at 95 % of the frames on average; a share below this is remarked on.
_MOSTLY_PERCENT = 80.0
# What a mark says, and what to do about it.
_MARK = {
    "overconfident": "overconfident, its errors are larger than its covariance states",
    "timid": "timid, its errors are smaller than its covariance states",
    "heavy-tailed": "heavy-tailed, its innovations have no single covariance",
    "contradicted": "contradicted, the corrections by its tracks have one direction",
}
_REMEDY = {
    "overconfident": "do not use its covariance",
    "heavy-tailed": "look for mismatched tracks",
    "timid": "its covariance, or the stated noise, is too large",
}

# Remarks on these are notes, the others stand at the end of the report only.
_AGAINST_TRUTH = "ate_"
_BLIND = "the recording has no image features: every estimator can only integrate the measured motion"


def finding_lines(comparison: Comparison) -> Iterator[str]:
    if not comparison.findings:
        yield "no fault found in the recording"
    for finding in comparison.findings:
        yield f"{finding.fault} ({outcome(finding)}): {finding.detail}"
    yield from undecided_lines(comparison.undecided)


def undecided_lines(undecided: Mapping[str, str]) -> Iterator[str]:
    by_reason: dict[str, list[str]] = {}
    for fault, why in undecided.items():
        by_reason.setdefault(why, []).append(fault)
    for why, names in by_reason.items():
        yield f"not decidable: {', '.join(names)}: {why}"


def outcome(finding: Finding) -> str:
    if finding.repaired:
        return "too much lost" if finding.blocking else "repaired"
    if finding.blocking:
        return "not repaired"
    return "warning" if finding.warning else "for information"


def note_lines(comparison: Comparison, columns: Columns = None) -> Iterator[str]:
    """Yield what must be known before a table is believed, the most harmful first.

    First what makes results void: runs that did not end well, faults of the recording, vision that contradicts the
    motion. Then doubts about an estimator, about its stated uncertainty, about single numbers, and what is missing.
    """
    yield from _ends_over_seeds(comparison) if comparison.over_seeds else _ends(comparison)
    if not len(comparison.sequence.observations):
        yield _BLIND
    yield from _faults(comparison)
    yield from _far_from_motion(comparison)
    yield from _harm_by_vision(comparison)
    yield from _contradicted(comparison)
    yield from _refusals(comparison)
    yield from _remarks(comparison, lambda key: key.startswith(_AGAINST_TRUTH))
    yield from _marks(comparison)
    yield from missing_lines(comparison, columns)


def _ends(comparison: Comparison) -> Iterator[str]:
    for outcome in comparison.outcomes:
        if outcome.status != "ok":
            yield f"{outcome.estimator} {outcome.status}{f': {outcome.why}' if outcome.why else ''}"


def _faults(comparison: Comparison) -> Iterator[str]:
    summaries, elapsed_s = faults(), comparison.sequence.elapsed_s
    for found in sorted(comparison.findings, key=lambda finding: not finding.blocking):
        if not (found.blocking or found.warning):
            continue
        spans = [elapsed_s(np.array(span)).tolist() for span in found.spans_ns]
        more = f" (first of {len(spans)})" if spans[1:] else ""
        when = f"{spans[0][0]:.0f}-{spans[0][1]:.0f} s{more}" if spans else "every result"
        what = re.split("[,:;]", summaries.get(found.fault, found.detail))[0]
        yield f"{found.fault}: {what}; distrust {when}"


def log_lines(comparison: Comparison) -> Iterator[str]:
    """Yield what each run had to recover from, and what it measured of the recording, in its own words."""
    for run in comparison.runs:
        yield from (f"{run.estimator}: {' '.join(entry.split())}" for entry in run.log)


def _ends_over_seeds(comparison: Comparison) -> Iterator[str]:
    """Yield the runs that did not end well, with the log of the first of each kind."""
    for estimator in comparison.estimators:
        for status in ("diverged", "failed"):
            bad = [o for o in comparison.outcomes if o.estimator == estimator and o.status == status]
            if bad:
                why = f": {bad[0].why}" if bad[0].why else ""
                yield f"{estimator} {status} under {_seeds(o.seed for o in bad)}{why}"
    if not comparison.all_ok:
        yield "means are over the runs that ended well; seeds.json has every run"
        yield from _medians_of_all(comparison)


def _medians_of_all(comparison: Comparison) -> Iterator[str]:
    """Yield the median of the first metric over all runs, in which one that did not end well is infinitely bad."""
    metric = next((metric for metric in shown_metrics(comparison) if metric.best), None)
    if metric is None:
        return
    medians = []
    for row in comparison.lines:
        found = row.quantiles_of_all(metric)
        if found is not None:
            ended = f"{100.0 * row.counts['ok'] / len(row.outcomes):.0f} % ok"
            median = f"none, {found.reason}" if found.median is None else f"{cell(found.median, metric)} {metric.unit}"
            medians.append(f"{_name_of(row)} {median} ({ended})")
    if medians:
        what = f"median {metric.name} with bad runs as infinitely bad"
        yield f"{what}: {'; '.join(medians)}"


def _contradicted(comparison: Comparison) -> Iterator[str]:
    rows = [row for row in comparison.lines if row.mark == "contradicted"]
    found = [(_name_of(row), one) for row in rows if (one := row.consistency) is not None]
    if found:
        names, trends = listed(name for name, _ in found), listed(number(one.mean) for _, one in found)
        limit = number(max(one.band[1] for _, one in found))
        yield f"contradicted: tracks push {names} one way, trend {trends} (limit {limit}); check calibration and stamps"


def _marks(comparison: Comparison) -> Iterator[str]:
    """Yield a line for the rows of each other mark: by which figures, against which band."""
    by_band: dict[tuple[str, str, str], list[tuple[Row, str]]] = {}
    for row in comparison.lines:
        found = row.consistency
        if found is not None and row.mark in _REMEDY:
            name, band = metrics_called((found.metric,))[0].name, f"{number(found.band[0])} to {number(found.band[1])}"
            by_band.setdefault((row.mark, name, band), []).append((row, number(found.mean)))
    for (mark, name, band), marked in sorted(by_band.items(), key=lambda item: list(_REMEDY).index(item[0][0])):
        names, values = listed(_name_of(row) for row, _ in marked), listed(value for _, value in marked)
        yield f"{mark}: {names}, {name} {values} (consistent: {band}); {_REMEDY[mark]}"


def _refusals(comparison: Comparison) -> Iterator[str]:
    accepted = {row.estimator: row.value(ACCEPTED) for row in comparison.rows if row.output == "causal"}
    refused = {name: 100.0 - share for name, share in accepted.items() if share is not None and refuses_much(share)}
    if refused:
        given = listed(f"{name} {share:.0f} %" for name, share in refused.items())
        yield f"the outlier gate rejected much ({given}): look for mismatches, or a wrong calibration or noise"


def _harm_by_vision(comparison: Comparison) -> Iterator[str]:
    for row in comparison.lines:
        given = [(o.seed, o.outputs[row.output].scores) for o in row.outcomes if row.output in o.outputs]
        valued = [(seed, scores.notes) for seed, scores in given if scores.values.get(RATIO) is not None]
        harmed = [(seed, notes[RATIO]) for seed, notes in valued if notes.get(RATIO)]
        if harmed and comparison.over_seeds:
            seeds = _seeds(seed for seed, _ in harmed)
            yield f"{_name_of(row)} explains withheld tracks worse than dead reckoning under {seeds}"
        elif harmed:
            yield f"{_name_of(row)} {harmed[0][1]}"


def _far_from_motion(comparison: Comparison) -> Iterator[str]:
    found = too_far(comparison.lines)
    if found:
        worst = max(found, key=lambda one: one.squared)
        apart = f"{number(worst.distance_m)} m and {number(worst.angle_deg)} deg apart at {worst.t_s:.0f} s"
        more = f" (and {len(found) - 1} more)" if found[1:] else ""
        yield (
            f"{_name_of(worst.row)}{more} and the measured motion disagree, {apart}: look for slip, moving objects or "
            "a wrong calibration"
        )


def _name_of(row: Row) -> str:
    """Name a row: by its estimator alone where one line serves for both outputs."""
    return row.estimator if row.label == "both" else f"{row.estimator} {row.output}"


def _seeds(seeds: Iterable[int]) -> str:
    given = list(map(str, seeds))
    return f"seed{'s' if len(given) > 1 else ''} {listed(given)}"


def consistency_lines(comparison: Comparison) -> Iterator[str]:
    """Yield, over seeds, a verdict a line of the table on whether its stated covariance is honest."""
    for row in comparison.lines if comparison.over_seeds else ():
        nees = row.mean_nees
        if nees is None:
            yield f"{_name_of(row)}: {row.reason('nees_pose_mean')}"
            continue
        verdict = f"{_name_of(row)}: in its band at {nees.in_band_percent:.0f} % of the frames"
        if nees.in_band_percent < _MOSTLY_PERCENT:
            above, below = nees.too_sure_percent, 100.0 - nees.in_band_percent - nees.too_sure_percent
            how = _MARK.get(row.mark, "over the whole run no more than errors that last from frame to frame explain")
            verdict += f", above it at {above:.0f} %, below at {below:.0f} %: {how}"
        # The true variance is the bound and its excess over it, where both are known.
        true = [None if excess is None else 1.0 + excess for excess in row.good_values("excess_variance")]
        found = ratio_of_means(row.good_values("claimed_variance"), true)
        of_true = "" if found is None else f"; it states {found.mean:.2f} ± {found.error:.2f} of its true variance"
        yield verdict + of_true


def missing_lines(comparison: Comparison, columns: Columns = None) -> Iterator[str]:
    """Yield, for each reason, the metrics of the table without a value for it, and whose where not everybody's.

    A run without any answer is explained by its status already and left out here. Last come metric files that
    could not be imported.
    """
    rows = [row for row in comparison.lines if row.answered]
    metrics = [(metric, row) for metric in explained_metrics(comparison, columns) for row in rows]
    lacking = ((row, metric.name, row.reason(metric.key)) for metric, row in metrics if row.value(metric.key) is None)
    for about, reason in _each_once(rows, (one for one in lacking if not is_on_request(one[2]))):
        yield f"no {about}: {reason}"
    for name, why in unavailable().items():
        yield f"the metrics of {name} are unavailable: {why}"


def _each_once(rows: list[Row], found: Iterable[tuple[Row, str, str]]) -> Iterator[tuple[str, str]]:
    """Yield each text once, behind the names that it is about, with whose they are where they are not everybody's."""
    by_text: dict[str, dict[str, list[Row]]] = {}
    for row, name, text in found:
        by_text.setdefault(text, {}).setdefault(name, []).append(row)
    for text, rows_of in by_text.items():
        names_of: dict[str, list[str]] = {}
        for name, affected in rows_of.items():
            names_of.setdefault(_whose(affected, rows), []).append(name)
        yield "; ".join(f"{listed(names)}{whose}" for whose, names in names_of.items()), text


def _whose(affected: list[Row], rows: list[Row]) -> str:
    """Name the rows affected: no name where all are, the estimator alone where all of its outputs are."""
    if len(affected) == len(rows):
        return ""
    of_all, of_affected = (Counter(row.estimator for row in some) for some in (rows, affected))
    names = (
        row.estimator if of_affected[row.estimator] == of_all[row.estimator] else _name_of(row) for row in affected
    )
    return f" for {', '.join(dict.fromkeys(names))}"


def remark_lines(comparison: Comparison) -> Iterator[str]:
    """Yield what the metrics remark on the values they did compute, without what :func:`note_lines` says."""
    return _remarks(comparison, lambda key: not key.startswith(_AGAINST_TRUTH) and key != RATIO)


def _remarks(comparison: Comparison, wanted: Callable[[str], bool]) -> Iterator[str]:
    rows = [] if comparison.over_seeds else [row for row in comparison.lines if row.answered]  # over seeds too many
    notes = ((row, key, note) for row in rows for key, note in row.scores.notes.items())
    told = (one for one in notes if wanted(one[1]) and one[0].scores.values.get(one[1]) is not None)
    yield from (f"{about}: {note}" for about, note in _each_once(rows, told))


# An estimator is named as nearly as good where its error is within this factor, and it saves this share of the time.
_NEAR, _SAVES = 1.25, 0.2


class Rival(Struct, frozen=True, kw_only=True):
    """A row of a contest; of the first one, its advantage is null."""

    estimator: str
    output: Output
    value: Annotated[float, Meta(description="of the metric; over seeds the mean")]
    ratio: Annotated[float | None, Meta(description="how many times as much it drifts, or errs, as the first")]
    interval: Annotated[tuple[float, float] | None, Meta(description="99 % of the ratio; null with too few data")]


class ContestRecord(Struct, frozen=True, kw_only=True):
    """Rows ranked by an error, and whether any is better than all others by more than chance."""

    question: Question
    metric: Annotated[str, Meta(description="key of the error they are ranked by")]
    by: Annotated[str, Meta(description="what the test is over: stretches of the path or of time, or seeds")]
    rivals: Annotated[tuple[Rival, ...], Meta(description="from the least error up")]
    leaders: Annotated[tuple[str, ...], Meta(description="estimators that may be the best; one where it is decided")]
    winner: Annotated[str | None, Meta(description="the only leader, unless its uncertainty is marked; else null")]


# The contest that the verdict is about is the first of these that there is.
_VERDICT_ABOUT: tuple[Question, ...] = ("accuracy in the end", "accuracy at each frame", "withheld tracks")


def verdict(comparison: Comparison) -> str:
    by_question = {contest.question: contest for contest in comparison.contests}
    contest = next((by_question[about] for about in _VERDICT_ABOUT if about in by_question), None)
    if contest is None:
        ended = [row.estimator for row in comparison.lines if row.answered and row.counts["ok"] == len(row.outcomes)]
        if not ended:
            return "No run ended well: there is nothing to compare."
        return f"Nothing to compare: only {listed(ended)} can be scored here. {_trust(comparison)}".strip()
    runs = f"{len(comparison.seeds)} seeds" if comparison.over_seeds else "one run"
    best = contest_text(contest_record(contest), runs, contest.rows[0].mark)
    limits = "Withheld tracks show errors over a few frames, not the distance from the true path."
    sentences = (
        *(best, limits if contest.metric == HELD_OUT else ""),
        *(_trust(comparison), _cost(contest), why_sentence(contest, comparison.source, len(comparison.seeds))),
    )
    return " ".join(filter(None, sentences))


def contest_record(contest: Contest) -> ContestRecord:
    found = (None, *contest.advantages)
    return ContestRecord(
        question=contest.question,
        metric=contest.metric,
        by=next((one.parts for one in contest.advantages if one is not None), "nothing: too few data"),
        rivals=tuple(
            Rival(
                estimator=row.estimator,
                output=row.output,
                value=row.value(contest.metric) or 0.0,
                ratio=None if one is None else rounded(one.ratio),
                interval=None if one is None else (rounded(one.low), rounded(one.high)),
            )
            for row, one in zip(contest.rows, found, strict=True)
        ),
        leaders=tuple(row.estimator for row in contest.leaders),
        winner=None if contest.winner is None else contest.winner.estimator,
    )


def contest_text(contest: ContestRecord, runs: str, mark: str) -> str:
    """Say who is best, or that nobody is by more than chance, and how much worse the next one is.

    ``runs`` says over how many runs the contest is, as in "one run", and ``mark`` what the first row is marked as.
    """
    first, *others = contest.rivals
    metric = metrics_called((contest.metric,))[0]
    leaders = [one for one in contest.rivals if one.estimator in contest.leaders]

    def value_of(one: Rival) -> str:
        return f"{number(one.value)} {metric.unit}"

    if len(leaders) == 1 and mark:
        return f"No winner: {first.estimator} leads ({metric.column} {value_of(first)}) but is {mark}."
    if len(leaders) == 1:
        claim = "predicts withheld tracks best" if contest.metric == HELD_OUT else "is most accurate"
        text = f"{first.estimator} {claim} ({metric.column} {value_of(first)}, {runs})"
    else:
        given = f"{number(first.value)} to {value_of(leaders[-1])}"
        text = f"No clear winner between {listed(contest.leaders)} ({metric.column} {given}, {runs})"
    # The next one that is worse by more than chance, if possible one that is not nearly as good.
    worse = [one for one in others if one not in leaders]
    next_one = next((one for one in worse if one.value > _NEAR * first.value), worse[0] if worse else None)
    if next_one is None or next_one.ratio is None or next_one.interval is None:
        return f"{text}."
    does = "errs" if contest.metric == HELD_OUT or contest.by == "seeds" else "drifts"
    low, high = map(number, next_one.interval)
    factor = f"{number(next_one.ratio)} times ({100 * CONFIDENCE:.0f} %: {low} to {high})"
    return f"{text}; {next_one.estimator} ({value_of(next_one)}) {does} {factor} as much."


def why_sentence(contest: Contest, source: str, seeds: int) -> str:
    """Return the command that says why the first is better than the worst of the others; nothing where none can.

    It can be pasted, and so has no full stop behind it.
    """
    explained = {name for name, entry in discover().items() if entry.ingredients()}  # that say what they have
    rows = (contest.rows[0], *(row for row, _ in contest.worse))
    able = [row.estimator for row in rows if row.estimator in explained]
    if len(able) < 2 or able[0] != contest.rows[0].estimator:
        return ""
    repeated = ["--seeds", str(seeds)] if seeds > 1 else []
    return f"Why: {shlex.join(['vislam', 'explain', source, '--from', able[-1], '--to', able[0], *repeated])}"


def _trust(comparison: Comparison) -> str:
    ended = [row for row in comparison.lines if row.counts["ok"]]
    judged = [row for row in ended if row.consistency is not None]
    if not judged:
        return ""
    sound = [row.estimator for row in judged if not row.mark]
    untested = listed(row.estimator for row in ended if row.consistency is None)
    if sound:
        trusted = f"Trust the stated uncertainty of {listed(sound)}"
    elif untested:
        trusted = f"Trust nobody's stated uncertainty (untested: {untested})"
    else:
        trusted = "Trust nobody's stated uncertainty"
    worst = max(judged, key=_overconfidence)
    errs = _overconfidence(worst)
    return trusted + (f"; {worst.estimator} errs {number(errs, 2)} times what it states." if errs else ".")


def _overconfidence(row: Row) -> float:
    """Return how many times as large errors are as a row states, by its NEES; 0 where there is none."""
    found = row.consistency
    return math.sqrt(found.mean) if found is not None and found.metric == NEES and found.mean > found.band[1] else 0.0


def _cost(contest: Contest) -> str:
    first, near = contest.rows[0], cheaper_near(contest, _NEAR, _SAVES)
    cost = first.value(COST)
    if not cost:
        return ""
    if near is not None:
        more = 100.0 * ((near.value(contest.metric) or 0.0) / (first.value(contest.metric) or 1.0) - 1.0)
        share = number((near.value(COST) or 0.0) / cost, 2)
        return f"{near.estimator} comes within {max(1, math.ceil(more))} % of {first.estimator} in {share} of its time."
    other = contest.worse[0][0] if contest.worse else first
    times = cost / (other.value(COST) or cost)
    return f"{first.estimator} takes {number(times, 2)} times the time of {other.estimator}." if times > 1.0 else ""
