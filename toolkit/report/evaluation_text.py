"""An evaluation of trajectory files for people: who is ahead, by how much, what failed and what to know before."""

import csv
import io
from collections.abc import Callable, Iterator, Mapping
from typing import NamedTuple

from toolkit.evaluation.scoring import METRICS
from toolkit.evaluation.standings import Cell, EvaluatedSystems, PairedTest, Standing
from toolkit.experiment.statistics import QuantilesOfAll
from toolkit.gate.baseline import FALSE_ALARM_RATE
from toolkit.metrics import Metric
from toolkit.report.text import (
    MISSING,
    WIDTH,
    ShownUnit,
    Table,
    Width,
    as_latex,
    as_markdown,
    as_text,
    cell,
    filled,
    heading,
    in_markdown,
    markdown_section,
    number,
    section,
    unit_of,
    unrivalled,
)

# Beside the metric that ranks, where there are values.
_USUAL = (
    *("ate_se3_m", "ate_yaw_m", "ate_se3_deg", "rpe_1s_m", "rpe_100m_percent", "kitti_t_percent"),
    *("nees_ori_mean", "nees_pos_mean", "time_coverage_percent"),
)
# What a terminal shows of long lists; evaluation.json has all.
_MOST_FAILURES, _MOST_REMARKS = 20, 8


def shown_metrics(evaluation: EvaluatedSystems, columns: tuple[Metric, ...] = ()) -> tuple[Metric, ...]:
    """Return the metrics that have a column: those asked for, or the one that ranks and the usual ones with values."""
    if columns:
        return columns
    usual = [metric for metric in evaluation.scored_metrics if metric.key in _USUAL and metric != evaluation.ranked_by]
    return (evaluation.ranked_by, *usual)


def leaderboard_table(evaluation: EvaluatedSystems, columns: tuple[Metric, ...] = ()) -> Table:
    """Return a row a system, the lowest mean rank first: how many runs ended well, and the median of each metric.

    Over several sequences it is the median of the sequences' medians, with rank and wins before it; on a single one
    that of its runs. Failed runs are infinitely bad in each.
    """
    several, metrics = len(evaluation.sequences) > 1, shown_metrics(evaluation, columns)
    heads: list[tuple[str, ...]] = [("system", "", ""), ("runs", "ok", "")]
    heads += [("mean", "rank", ""), ("first", f"of {len(evaluation.ranked_sequences)}", "")] if several else []
    medians = {metric: _medians(evaluation, metric, several=several) for metric in (evaluation.ranked_by, *metrics)}
    units = {metric: unit_of(metric, values) for metric, values in medians.items()}
    heads += [(evaluation.ranked_by.heading[0], "quartiles", units[evaluation.ranked_by].name)]
    heads += [heading(metric, units[metric]) for metric in metrics]
    rows = []
    for i, standing in enumerate(evaluation.leaderboard):
        counts = [f"{standing.mean_rank:.2f}", str(standing.wins)] if several else []
        spread = _quartiles_of(evaluation, standing, evaluation.ranked_by, several=several)
        values = [cell(medians[metric][i], metric, units[metric]) for metric in metrics]
        ends, ranked_by = f"{standing.ok} of {standing.runs}", evaluation.ranked_by
        rows.append((standing.system, ends, *counts, _quartiles(spread, ranked_by, units[ranked_by]), *values))
    before = len(heads) - len(metrics)
    best = {(i, before + j) for j, metric in enumerate(metrics) for i in _best(medians[metric], metric)}
    return Table(tuple(heads), tuple(rows), labels=1, best=frozenset(best))


def _medians(evaluation: EvaluatedSystems, metric: Metric, *, several: bool) -> list[float | None]:
    found = [_quartiles_of(evaluation, one, metric, several=several) for one in evaluation.leaderboard]
    return [None if quartiles is None else quartiles.median for quartiles in found]


def _quartiles_of(
    evaluation: EvaluatedSystems, standing: Standing, metric: Metric, *, several: bool
) -> QuantilesOfAll | None:
    if several:
        return standing.quantiles.get(metric.key)
    return evaluation.cells[standing.system, evaluation.sequences[0]].quantiles(metric)


def _best(medians: list[float | None], metric: Metric) -> set[int]:
    """Return which median is best, or are: none of one alone, nor where another that prints alike is worse."""
    costs: Mapping[str, Callable[[float], float]] = {"least": float, "most": lambda v: -v, "one": lambda v: abs(v - 1)}
    known = [(costs[metric.best](v), i) for i, v in enumerate(medians) if v is not None] if metric.best else []
    text = unrivalled((cost, number(medians[i] or 0.0)) for cost, i in known) if len(medians) > 1 else None
    return {i for _, i in known if number(medians[i] or 0.0) == text}


def sequences_table(evaluation: EvaluatedSystems) -> Table:
    """Return a row a sequence and a column a system: the median over the runs of the metric that ranks."""
    metric, systems = evaluation.ranked_by, [standing.system for standing in evaluation.leaderboard]
    unit = unit_of(metric, (one.median(metric) for one in evaluation.cells.values()))
    heads = (("sequence", "", ""), *((system, "", unit.name) for system in systems))
    rows, best = [], set()
    for i, sequence in enumerate(evaluation.sequences):
        cells = [evaluation.cells[system, sequence] for system in systems]
        rows.append((sequence, *(_median_and_failures(one, metric, unit) for one in cells)))
        best |= {(i, 1 + j) for j in _best([one.median(metric) for one in cells], metric)}
    return Table(heads, tuple(rows), labels=1, best=frozenset(best))


def _median_and_failures(runs: Cell, metric: Metric, unit: ShownUnit) -> str:
    """Return the median of the runs of a system on a sequence, and how many of them failed."""
    failed = f"{runs.failed} of {len(runs.runs)} failed" if runs.failed else ""
    median = runs.median(metric)
    if median is None:
        return failed or MISSING
    return f"{cell(median, metric, unit)} ({failed})" if failed else cell(median, metric, unit)


def _quartiles(found: QuantilesOfAll | None, metric: Metric, unit: ShownUnit) -> str:
    if found is None or found.n < 2:
        return MISSING
    return " .. ".join(cell(q, metric, unit) for q in (found.lower_quartile, found.upper_quartile))


def header_lines(evaluation: EvaluatedSystems) -> Iterator[str]:
    """Yield what is evaluated and on which terms."""
    truths = evaluation.truths
    if len(truths) == 1:
        ((name, truth),) = truths.items()
        time = f"{truth.duration_s:.1f} s" if truth.is_timed else "no stamps"
        yield f"{name}: {len(truth.poses)} true poses, {time}, {truth.path_m:.1f} m"
    else:
        yield f"{len(truths)} sequences, {len(evaluation.systems)} systems, {len(evaluation.runs)} runs"
    terms = evaluation.terms
    rule = "interpolated between stamps" if terms.max_dt_s is None else f"nearest within {terms.max_dt_s:g} s"
    offset = f", {terms.offset_s:+g} s added to the stamps" if terms.offset_s else ""
    first = "heading and position" if terms.level else "the whole first pose"
    yield (
        f"poses {rule}{offset}; gaps up to {terms.gap_s:g} s count as covered, and a run that covers less than "
        f"{terms.least_coverage_percent:g} % of the truth's time as failed; placed by {first} where nothing is fitted"
    )


def paired_lines(evaluation: EvaluatedSystems) -> Iterator[str]:
    """Yield how the systems differ over the sequences, the leader against each other, and what is more than chance."""
    tests = evaluation.paired
    leader = evaluation.leaderboard[0].system
    for test in tests:
        if test.system == leader or test.is_significant:
            yield _paired_line(test, len(tests), evaluation.ranked_by)
    count = len(evaluation.ranked_sequences)
    if tests and 2.0 ** (1 - count) * len(tests) > FALSE_ALARM_RATE:
        yield f"{count} sequences cannot distinguish {len(evaluation.systems)} systems at 5 %, whatever the errors are"


def _paired_line(test: PairedTest, pairs: int, metric: Metric) -> str:
    counts = f"better on {test.better}, worse on {test.worse}" + (f", equal on {test.tied}" if test.tied else "")
    ratio = "" if test.median_ratio is None else f", {metric.name} {test.median_ratio:.3g} times as large in the median"
    corrected = f", {test.p_holm:.2g} with Holm's correction for {pairs} pairs" if pairs > 1 else ""
    verdict = "" if test.is_significant else ": may be chance"
    return f"{test.system} against {test.other}: {counts} of the sequences{ratio}; p = {test.p:.2g}{corrected}{verdict}"


def failure_lines(evaluation: EvaluatedSystems, most: int | None = _MOST_FAILURES) -> Iterator[str]:
    """Yield each run that failed, with the reason; no more than ``most``."""
    failed = [run for run in evaluation.runs if run.status != "ok"]
    shown = failed if most is None else failed[:most]
    for run in shown:
        yield f"{run.item.system}, {run.item.sequence}, {run.item.run}: {run.log[0]}"
    if len(shown) < len(failed):
        yield f"{len(failed) - len(shown)} more runs failed; evaluation.json and --format csv have all"


def note_lines(evaluation: EvaluatedSystems) -> Iterator[str]:
    """Yield what a reader must know: what was left out, why values are missing, remarks on values, each once."""
    yield from evaluation.notes
    scored = {metric.key for metric in evaluation.scored_metrics}
    remarks: dict[str, _RemarkScope] = {}
    for run in evaluation.runs:
        for key in run.notes.keys() & scored:
            text = run.notes[key] if run.values.get(key) is not None else f"no value: {run.notes[key]}"
            about = remarks.setdefault(text, _RemarkScope({}, {}))
            about.keys[key] = about.whose[f"{run.item.system} on {run.item.sequence}"] = None
    for text, about in list(remarks.items())[:_MOST_REMARKS]:
        first, *others = about.whose
        more = f" and {len(others)} more" if others else ""
        whose = "" if len(about.whose) == len(evaluation.cells) else f" of {first}{more}"
        yield f"{', '.join(metric.key for metric in METRICS if metric.key in about.keys)}{whose}: {text}"


class _RemarkScope(NamedTuple):
    """The metrics, and the systems on sequences, that a remark is about, in order."""

    keys: dict[str, None]
    whose: dict[str, None]


def evaluation_text(evaluation: EvaluatedSystems, columns: tuple[Metric, ...] = (), width: Width = WIDTH) -> str:
    """Return an evaluation as plain text: the leaderboard, the sequences, the tests, what failed and what to know."""
    lines = [filled(line, width) for line in header_lines(evaluation)]
    lines += ["", as_text(leaderboard_table(evaluation, columns)), ""]
    if len(evaluation.sequences) > 1:
        lines += [f"{evaluation.ranked_by.name}, median over the runs", "", as_text(sequences_table(evaluation)), ""]
    lines += section("pairs", paired_lines(evaluation), width)
    lines += section("fails", failure_lines(evaluation), width)
    lines += section("notes", note_lines(evaluation), width)
    return "\n".join(lines).rstrip()


def evaluation_markdown(evaluation: EvaluatedSystems, columns: tuple[Metric, ...] = ()) -> str:
    """Return the same as Markdown, the best of each column in bold."""
    parts = ["## Leaderboard", *(f"{in_markdown(line)}." for line in header_lines(evaluation))]
    parts.append(as_markdown(leaderboard_table(evaluation, columns)))
    if len(evaluation.sequences) > 1:
        parts += [f"## {evaluation.ranked_by.name} by sequence", as_markdown(sequences_table(evaluation))]
    parts += markdown_section("Pairs", paired_lines(evaluation))
    parts += markdown_section("Failed", failure_lines(evaluation))
    parts += markdown_section("Notes", note_lines(evaluation))
    return "\n\n".join(parts) + "\n"


def evaluation_latex(evaluation: EvaluatedSystems, columns: tuple[Metric, ...] = ()) -> str:
    """Return the tables for a paper, after a comment that says on which terms; the package booktabs is needed."""
    parts = ["\n".join(f"% {line}" for line in (*header_lines(evaluation), *paired_lines(evaluation)))]
    parts.append(as_latex(leaderboard_table(evaluation, columns)))
    if len(evaluation.sequences) > 1:
        parts.append(as_latex(sequences_table(evaluation)))
    return "\n\n".join(parts) + "\n"


def evaluation_csv(evaluation: EvaluatedSystems) -> str:
    """Return a line a run, failed ones too, with every metric; the last column says why a run failed."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(["sequence", "system", "run", "status", *(metric.key for metric in METRICS), "why"])
    for run in evaluation.runs:
        values = [run.values.get(metric.key) for metric in METRICS]
        texts = ["" if value is None else repr(value) for value in values]
        why = run.log[0] if run.log else ""
        writer.writerow([run.item.sequence, run.item.system, run.item.run, run.status, *texts, why])
    return out.getvalue()
