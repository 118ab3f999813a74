"""``vislam evaluate``: trajectory files of any systems against the truth, without a recording."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from toolkit.cli.arguments import (
    COV_CONVENTION,
    FIGURES,
    FORMAT,
    WORKERS,
    arg,
    at_least,
    command,
    flag,
    known_names,
    names,
    number_within,
    output,
    positive_seconds,
)
from toolkit.errors import printable

if TYPE_CHECKING:
    from toolkit.evaluation.standings import EvaluatedSystems
    from toolkit.metrics import Metric

# Of one sequence: what is missing is counted one by one.
MOST_RUNS = 10_000


@command(
    "evaluate",
    "score trajectory files of any systems against the truth",
    arg("truth TRUTH", "a file of one sequence, or a folder that has SEQUENCE.tum", Path),
    arg(
        "given NAME=FILE|FOLDER",
        "with one truth NAME=FILE, FILE, or NAME=FOLDER of repeated runs; with a folder of truths NAME=FOLDER with "
        "SEQUENCE.tum or SEQUENCE/RUN.tum, or a FOLDER that has such a folder for each system",
        nargs="+",
    ),
    arg("--max-dt S", "pair each pose with the nearest within S seconds (default: interpolate)", positive_seconds),
    COV_CONVENTION,
    arg("--offset S", "added to the trajectories' stamps", number_within("seconds", -1e9, 1e10), default=0.0),
    arg("--gap S", "the longest time between two poses that counts as covered", positive_seconds, default=5.0),
    flag("--imu", "the vertical is measured: place the first pose by heading and position only"),
    arg(
        "--least-coverage PERCENT",
        "of time; a run that covers less failed",
        number_within("percent", 0, 100),
        default=50.0,
    ),
    arg("--runs N", "expected runs of each system and sequence; missing ones count as failed", at_least(1, MOST_RUNS)),
    arg("--metric KEY", "metric that ranks and is tested", default="ate_se3_m"),
    arg("--columns KEY,...", "metrics of the table, uncertainty, or all (default: the usual)", names, default=()),
    FORMAT,
    output("evaluation.json, and nothing else", "see the exit status and --out"),
    arg("--out DIR", "write evaluation.json, the leaderboard as a page and as Markdown, and all runs as CSV", Path),
    *FIGURES,
    WORKERS,
    examples=(
        "vislam compare drive --estimators dead-reckoning,ekf --max-frames 40 --out runs/drive",
        "vislam evaluate runs/drive/trajectories/truth.tum ekf=runs/drive/trajectories/ekf_causal.tum --out scores",
    ),
)
def evaluate(options: argparse.Namespace) -> int:
    """Score trajectory files against the truth, without a recording: every error with its alignment, time coverage,
    medians over runs, ranks and paired tests over sequences, failures counted. See docs/evaluate.md.
    """
    from toolkit.cli.progress_display import of_this_process
    from toolkit.datasets.trajectories.covariances import convention_called
    from toolkit.evaluation.gathering import gather
    from toolkit.evaluation.scoring import Terms
    from toolkit.evaluation.standings import evaluate
    from toolkit.experiment.workers import usable_cpus
    from toolkit.report.evaluation import check_evaluation_directory, write_evaluation

    (ranked_by, *_), columns = _metrics((options.metric,)), _metrics(options.columns)
    if options.out is not None:
        check_evaluation_directory(options.out)
    convention = None if options.cov_convention is None else convention_called(options.cov_convention)
    terms = Terms(options.max_dt, options.offset, options.gap, options.imu, options.least_coverage, convention)
    gathered = gather(options.truth, options.given, options.runs)
    with of_this_process()(f"{len(gathered.items)} trajectories") as progress:
        found = evaluate(gathered, terms, ranked_by.key, progress, options.workers or usable_cpus())
    if options.out is not None:
        write_evaluation(found, options.out, options.figures, options.figure_format)
    if not options.quiet:
        print(_shown(found, columns, options), end="")
    return 0 if found.all_ok else 1


def _shown(found: EvaluatedSystems, columns: tuple[Metric, ...], options: argparse.Namespace) -> str:
    from toolkit.evaluation.standings import evaluation_document
    from toolkit.files.documents import to_text
    from toolkit.report import evaluation as texts
    from toolkit.report.text import width_of_output

    match "json" if options.json else options.format:
        case "json":
            return to_text(evaluation_document(found))
        case "csv":
            return texts.evaluation_csv(found)
        case "latex":
            return texts.evaluation_latex(found, columns)
        case "markdown":
            return texts.evaluation_markdown(found, columns)
    where = "" if options.out is None else f"\nresults: {printable(str(options.out))}\n"
    return f"{texts.evaluation_text(found, columns, width_of_output())}\n{where}"


def _metrics(keys: tuple[str, ...]) -> tuple[Metric, ...]:
    """Return metrics by their keys; raises UsageError for one that trajectories do not have."""
    from toolkit.evaluation.scoring import METRICS
    from toolkit.metrics import uncertainty

    if keys == ("all",):
        return METRICS
    by_key = {metric.key: (metric,) for metric in METRICS} | {uncertainty.GROUP: uncertainty.METRICS}
    chosen = known_names("metric of a trajectory", keys, by_key)
    return tuple(metric for key in chosen for metric in by_key[key])
