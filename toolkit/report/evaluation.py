"""An evaluation of trajectory files for people: who is ahead, by how much, what failed and what to know before.

As text, Markdown, LaTeX and CSV, and as the directory of ``vislam evaluate --out``: ``evaluation.json``, runs as CSV,
figures, and the leaderboard in Markdown and as a page, one HTML file that opens from disk in the style of the report's
page.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
from msgspec.structs import replace

from toolkit.errors import DataError
from toolkit.evaluation.scoring import METRICS, NO_COVARIANCE, OF_THE_BODY
from toolkit.evaluation.standings import EvaluatedSystems, OverRuns, PairedRecord, evaluation_document, read_evaluation
from toolkit.experiment.statistics import mean_interval
from toolkit.files.documents import to_text
from toolkit.files.writing import check_replaceable, replaced_directory, with_folders
from toolkit.gate.baseline import FALSE_ALARM_RATE
from toolkit.metrics import Metric
from toolkit.metrics.parts.consistency import nees_band
from toolkit.metrics.uncertainty import REGIONS_PERCENT
from toolkit.report import FigureChoice, FigureFormat
from toolkit.report.html import card, filled_page, source
from toolkit.report.text import (
    MISSING,
    WIDTH,
    ShownUnit,
    Table,
    Width,
    as_csv,
    as_latex,
    as_markdown,
    as_text,
    cell,
    filled,
    heading,
    in_html,
    in_markdown,
    listed,
    markdown_section,
    number,
    section,
    unit_of,
)

# Beside the metric that ranks, where there are values.
_USUAL = (
    *("ate_se3_m", "ate_yaw_m", "ate_se3_deg", "rpe_1s_m", "rpe_100m_percent", "kitti_t_percent"),
    *("nees_pose_mean", "nees_ori_mean", "nees_pos_mean", "time_coverage_percent"),
)
# Blocks of a stated covariance: in words, degrees of freedom, and the metric that is its energy score.
_BLOCKS = {"pose": ("pose", 6, ""), "ori": ("orientation", 3, "energy_ori_deg"), "pos": ("position", 3, "energy_pos_m")}
_UNCERTAINTY = "Stated uncertainty: means over the runs (95 % interval over the runs)"
# A part of what is told: its title, and a table or lines.
Part = tuple[str, Table | tuple[str, ...]]
# What is told of long lists; evaluation.json has all.
_MOST_FAILURES, _MOST_REMARKS = 20, 8

EVALUATION = "evaluation.json"
_FILES = (EVALUATION, "leaderboard.html", "leaderboard.md", "runs.csv")


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
    whole = [
        standing if several else evaluation.cells[standing.estimator, evaluation.sequences[0]]
        for standing in evaluation.leaderboard
    ]
    found = {metric: [one.metrics.get(metric.key) for one in whole] for metric in (evaluation.ranked_by, *metrics)}
    medians = {
        metric: [None if one is None else one.median for one in quartiles] for metric, quartiles in found.items()
    }
    units = {metric: unit_of(metric, values) for metric, values in medians.items()}
    heads += [(evaluation.ranked_by.heading[0], "quartiles", units[evaluation.ranked_by].name)]
    heads += [heading(metric, units[metric]) for metric in metrics]
    rows = []
    for i, standing in enumerate(evaluation.leaderboard):
        counts = [f"{standing.mean_rank:.2f}", str(standing.wins)] if several else []
        ranked_by = evaluation.ranked_by
        spread = found[ranked_by][i]
        cells = [evaluation.cells[standing.estimator, sequence] for sequence in evaluation.sequences]
        count = sum(one.metrics.get(ranked_by.key) is not None for one in cells) if several else standing.runs
        ends = () if spread is None or count < 2 else (spread.lower_quartile, spread.upper_quartile)
        quartiles = " .. ".join(cell(end, ranked_by, units[ranked_by]) for end in ends) or MISSING
        values = [cell(medians[metric][i], metric, units[metric]) for metric in metrics]
        rows.append((standing.estimator, f"{standing.ok} of {standing.runs}", *counts, quartiles, *values))
    before = len(heads) - len(metrics)
    best = {(i, before + j) for j, metric in enumerate(metrics) for i in best_of(medians[metric], metric)}
    return Table(tuple(heads), tuple(rows), labels=1, best=frozenset(best))


def best_of(medians: list[float | None], metric: Metric) -> set[int]:
    """Return which median is best, or are: none of one alone, nor where another that prints alike is worse."""
    costs: Mapping[str, Callable[[float], float]] = {"least": float, "most": lambda v: -v, "one": lambda v: abs(v - 1)}
    known = [(costs[metric.best](v), i, number(v)) for i, v in enumerate(medians) if v is not None and metric.best]
    least = min(known, default=None)
    if least is None or len(medians) < 2 or any(cost != least[0] for cost, _, text in known if text == least[2]):
        return set()
    return {i for _, i, text in known if text == least[2]}


def sequences_table(evaluation: EvaluatedSystems) -> Table:
    metric, systems = evaluation.ranked_by, [standing.estimator for standing in evaluation.leaderboard]
    unit = unit_of(metric, (one.median(metric) for one in evaluation.cells.values()))
    heads = (("sequence", "", ""), *((system, "", unit.name) for system in systems))
    rows, best = [], set()
    for i, sequence in enumerate(evaluation.sequences):
        cells = [evaluation.cells[system, sequence] for system in systems]
        rows.append((sequence, *(_median_and_failures(one, metric, unit) for one in cells)))
        best |= {(i, 1 + j) for j in best_of([one.median(metric) for one in cells], metric)}
    return Table(heads, tuple(rows), labels=1, best=frozenset(best))


def _median_and_failures(over: OverRuns, metric: Metric, unit: ShownUnit) -> str:
    failed = f"{over.runs - over.ok} of {over.runs} failed" if over.ok < over.runs else ""
    median = over.median(metric)
    if median is None:
        return failed or MISSING
    return f"{cell(median, metric, unit)} ({failed})" if failed else cell(median, metric, unit)


def uncertainty_table(evaluation: EvaluatedSystems) -> Table | None:
    """Return how well stated covariances fit the errors, a row a system and block; None where none is stated.

    Values are means over all runs that are ok, with their 95 % intervals over the runs by Student's t. The band is that
    of a consistent system's NEES of one pose, averaged over as many runs.
    """
    rows = []
    for system in evaluation.systems:
        runs = [run.metrics for run in evaluation.runs if run.estimator == system and run.status == "ok"]
        for block, (name, dof, energy) in _BLOCKS.items():
            values = [run[f"nees_{block}_mean"] for run in runs if run.get(f"nees_{block}_mean") is not None]
            if not values:
                continue
            low, high = nees_band(dof, len(values))
            keys = [f"inside_{percent}_{block}_percent" for percent in REGIONS_PERCENT]
            means = [_over_runs(runs, key).partition(" ")[0] for key in keys]
            scores = (_over_runs(runs, f"log_score_{block}"), _over_runs(runs, energy) if energy else MISSING)
            nees = _over_runs(runs, f"nees_{block}_mean")
            rows.append((system, name, str(len(values)), nees, f"{low:.2f} .. {high:.2f}", *means, *scores))
    heads = [("system", "", ""), ("of the", "", ""), ("runs", "", ""), ("NEES", "", ""), ("band", "95 %", "")]
    heads += [("inside", f"{percent} %", "%") for percent in REGIONS_PERCENT]
    heads += [("log", "score", ""), ("energy", "score", "deg, m")]
    return Table(tuple(heads), tuple(rows), labels=2) if rows else None


def _over_runs(runs: Sequence[Mapping[str, float | int | None]], key: str) -> str:
    values = np.array([value for run in runs if (value := run.get(key)) is not None], dtype=float)
    if not values.size:
        return MISSING
    found = mean_interval(values)
    if values.size == 1:
        return number(found.value)
    return f"{number(found.value)} ({number(found.low)} .. {number(found.high)})"


def header_lines(evaluation: EvaluatedSystems) -> Iterator[str]:
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
    tests = evaluation.paired
    leader = evaluation.leaderboard[0].estimator
    for test in tests:
        if test.estimator == leader or test.is_significant:
            yield _paired_line(test, len(tests), evaluation.ranked_by)
    count = len(evaluation.ranked_sequences)
    if tests and 2.0 ** (1 - count) * len(tests) > FALSE_ALARM_RATE:
        yield f"{count} sequences cannot distinguish {len(evaluation.systems)} systems at 5 %, whatever the errors are"


def _paired_line(test: PairedRecord, pairs: int, metric: Metric) -> str:
    counts = f"better on {test.better}, worse on {test.worse}" + (f", equal on {test.tied}" if test.tied else "")
    ratio = "" if test.median_ratio is None else f", {metric.name} {test.median_ratio:.3g} times as large in the median"
    corrected = f", {test.p_holm:.2g} with Holm's correction for {pairs} pairs" if pairs > 1 else ""
    verdict = "" if test.is_significant else ": may be chance"
    return (
        f"{test.estimator} against {test.other}: {counts} of the sequences{ratio}; p = {test.p:.2g}{corrected}{verdict}"
    )


def failure_lines(evaluation: EvaluatedSystems) -> Iterator[str]:
    failed = [run for run in evaluation.runs if run.status != "ok"]
    for run in failed[:_MOST_FAILURES]:
        yield f"{run.estimator}, {run.sequence}, {run.run}: {run.log[0]}"
    if len(failed) > _MOST_FAILURES:
        yield f"{len(failed) - _MOST_FAILURES} more runs failed; evaluation.json and --format csv have all"


def note_lines(evaluation: EvaluatedSystems) -> Iterator[str]:
    """Yield what a reader must know: what was left out, why values are missing, remarks on values, each once."""
    yield from evaluation.notes
    scored = [metric.key for metric in evaluation.scored_metrics]
    remarks: dict[str, tuple[set[str], dict[str, None]]] = {}  # the metrics, and the systems on sequences
    for run in evaluation.runs:
        # Whatever the file's orientations lack is told, though nothing that needs them has a value. Why a run failed is
        # listed already.
        lacks = run.notes.get("ate_se3_deg")
        told = [key for key in scored if run.notes.get(key)] + [
            k for k in OF_THE_BODY if lacks and run.notes.get(k) == lacks
        ]
        told += ["nees_pose_mean"] if run.notes.get("nees_pose_mean", NO_COVARIANCE) != NO_COVARIANCE else []
        for key in (key for key in dict.fromkeys(told) if run.notes[key] not in run.log):
            text = run.notes[key] if run.metrics.get(key) is not None else f"no value: {run.notes[key]}"
            keys, systems = remarks.setdefault(text, (set(), {}))
            keys.add(key)
            systems[f"{run.estimator} on {run.sequence}"] = None
    for text, (keys, systems) in list(remarks.items())[:_MOST_REMARKS]:
        first, *others = systems
        more = f" and {len(others)} more" if others else ""
        whose = "" if len(systems) == len(evaluation.cells) else f" of {first}{more}"
        yield f"{listed(metric.key for metric in METRICS if metric.key in keys)}{whose}: {text}"


def _parts(evaluation: EvaluatedSystems, columns: tuple[Metric, ...] = ()) -> Iterator[Part]:
    """Yield what is told of an evaluation: tables, then what is more than chance, what failed and what to know."""
    yield "Leaderboard", leaderboard_table(evaluation, columns)
    if len(evaluation.sequences) > 1:
        yield f"{evaluation.ranked_by.name}, median over the runs", sequences_table(evaluation)
    if (stated := uncertainty_table(evaluation)) is not None:
        yield _UNCERTAINTY, stated
    yield "Pairs", tuple(paired_lines(evaluation))
    yield "Fails", tuple(failure_lines(evaluation))
    yield "Notes", tuple(note_lines(evaluation))


def evaluation_text(evaluation: EvaluatedSystems, columns: tuple[Metric, ...] = (), width: Width = WIDTH) -> str:
    lines = [*(filled(line, width) for line in header_lines(evaluation)), ""]
    for title, body in _parts(evaluation, columns):
        lines += [title, "", as_text(body), ""] if isinstance(body, Table) else section(title.lower(), body, width)
    return "\n".join(lines).rstrip()


def evaluation_markdown(evaluation: EvaluatedSystems, columns: tuple[Metric, ...] = ()) -> str:
    lines = [f"{in_markdown(line)}." for line in header_lines(evaluation)]
    for title, body in _parts(evaluation, columns):
        head = f"## {in_markdown(title)}"
        lines += (head, as_markdown(body)) if isinstance(body, Table) else markdown_section(title, body)
    return "\n\n".join(lines) + "\n"


def evaluation_latex(evaluation: EvaluatedSystems, columns: tuple[Metric, ...] = ()) -> str:
    """Return the tables for a paper, after a comment that says on which terms; the package booktabs is needed."""
    parts = ["\n".join(f"% {line}" for line in (*header_lines(evaluation), *paired_lines(evaluation)))]
    tables = ((title, body) for title, body in _parts(evaluation, columns) if isinstance(body, Table))
    return "\n\n".join([*parts, *(f"% {title}\n{as_latex(table)}" for title, table in tables)]) + "\n"


def evaluation_csv(evaluation: EvaluatedSystems) -> str:
    """Return a line a run, failed ones too, with every metric; the last column says why a run failed."""
    keys = [metric.key for metric in METRICS]
    rows = (
        [
            *(run.sequence, run.estimator, run.run, run.status),
            *map(run.metrics.get, keys),
            run.log[0] if run.log else "",
        ]
        for run in evaluation.runs
    )
    return as_csv(["sequence", "system", "run", "status", *keys, "why"], rows)


def check_evaluation_directory(target: Path) -> None:
    check_replaceable(target, _ours)


def write_evaluation(
    evaluation: EvaluatedSystems, target: Path, choice: FigureChoice = "few", kind: FigureFormat = "png"
) -> None:
    """Write the directory, in the place of an earlier one, with figures of a kind as chosen.

    Raises OutputError where that cannot be.
    """
    with replaced_directory(target, _ours) as directory:
        captions: dict[str, str] = {}
        if choice != "none":
            # Here alone, for matplotlib takes long to import.
            from toolkit.report.figures import literal, save
            from toolkit.report.figures.trajectories import draw

            (directory / "figures").mkdir()
            drawn = map(literal, draw(evaluation, all_sequences=choice == "all"))
            captions = save(drawn, directory / "figures", kind)
        figures = {directory / "figures" / name: caption for name, caption in captions.items()}
        document = replace(evaluation_document(evaluation), figures=tuple(captions))
        texts = (
            to_text(document),
            leaderboard_page(evaluation, figures),
            evaluation_markdown(evaluation),
            evaluation_csv(evaluation),
        )
        for name, text in zip(_FILES, texts, strict=True):
            (directory / name).write_text(text, encoding="utf-8")


def _ours(directory: Path) -> frozenset[str]:
    try:
        figures = read_evaluation(directory / EVALUATION).figures or ()
    except DataError:
        return frozenset()
    return with_folders((*_FILES, *(f"figures/{name}" for name in figures)))


def leaderboard_page(evaluation: EvaluatedSystems, figures: Mapping[Path, str]) -> str:
    """Return the page: tables, figures (file -> caption), tests, failures and notes."""
    title = f"{' / '.join(evaluation.systems)} on {', '.join(evaluation.sequences[:3])}"
    if len(evaluation.sequences) > 3:
        title += f" and {len(evaluation.sequences) - 3} more"
    cards = [card("On which terms", header_lines(evaluation))]
    for name, body in _parts(evaluation):
        if body:
            lines, table = ((), body) if isinstance(body, Table) else (body, None)
            cards.append(card(name.capitalize(), lines, table))
    cards += [card("Figures", figures=figures)] if figures else []
    parts = {"title": in_html(title), "style": source("style.css"), "cards": "\n".join(cards)}
    return filled_page("leaderboard.html", parts)
