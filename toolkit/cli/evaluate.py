"""``vislam evaluate``: trajectory files of any systems against the truth, without a recording."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from toolkit.cli.arguments import (
    UsageError,
    add_option,
    add_output_arguments,
    add_workers_argument,
    at_least,
    command,
    known_names,
    names,
    positive_seconds,
)
from toolkit.errors import printable

if TYPE_CHECKING:
    from toolkit.evaluation.standings import EvaluatedSystems
    from toolkit.metrics import Metric

# Of one sequence: what is missing is counted one by one.
MOST_RUNS = 10_000
_FORMATS = ("text", "markdown", "csv", "latex")


def _add_terms(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--max-dt",
        metavar="S",
        type=positive_seconds,
        help="pair each pose with the nearest one within so many seconds, as evo does (default: interpolate)",
    )
    parser.add_argument("--offset", metavar="S", type=float, default=0.0, help="added to the trajectories' stamps")
    what = "the longest time between two poses that counts as covered"
    add_option(parser, "--gap", 5.0, what, metavar="S", type=positive_seconds)
    parser.add_argument(
        "--imu",
        action="store_true",
        help="the vertical is measured: place the first pose by heading and position only",
    )
    what = "of the truth's time; a run that covers less counts as failed"
    add_option(parser, "--least-coverage", 50.0, what, metavar="PERCENT", type=_percent)
    parser.add_argument(
        "--runs",
        metavar="N",
        type=at_least(1, MOST_RUNS),
        help="expected runs of each system and sequence; missing ones count as failed",
    )


def _evaluate_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "truth", metavar="TRUTH", type=Path, help="a file of one sequence, or a folder that has SEQUENCE.tum"
    )
    parser.add_argument(
        "given",
        metavar="NAME=FILE|FOLDER",
        nargs="+",
        help="with one truth NAME=FILE, FILE, or NAME=FOLDER of repeated runs; with a folder of truths NAME=FOLDER "
        "with SEQUENCE.tum or SEQUENCE/RUN.tum, or a FOLDER that has such a folder for each system",
    )
    _add_terms(parser)
    add_option(parser, "--metric", "ate_se3_m", "metric that ranks and is tested", metavar="KEY")
    parser.add_argument(
        "--columns", metavar="KEY,...", type=names, default=(), help="metrics of the table, or all (default: the usual)"
    )
    add_option(parser, "--format", "text", "of what is printed", choices=_FORMATS)
    add_output_arguments(parser, "evaluation.json, and nothing else", "see the exit status and --out")
    parser.add_argument(
        "--out",
        metavar="DIR",
        type=Path,
        help="write evaluation.json, the leaderboard as a page and as Markdown, and all runs as CSV",
    )
    add_workers_argument(parser)


@command(
    "evaluate",
    "score trajectory files of any systems against the truth",
    "vislam compare drive --estimators dead-reckoning,ekf --max-frames 40 --out runs/drive",
    "vislam evaluate runs/drive/trajectories/truth.tum ekf=runs/drive/trajectories/ekf_causal.tum --out runs/scores",
    arguments=_evaluate_arguments,
)
def evaluate(options: argparse.Namespace) -> int:
    """Score trajectory files against the truth, without a recording: every error with its alignment, time coverage,
    medians over runs, ranks and paired tests over sequences, failures counted. See docs/evaluate.md.
    """
    from toolkit.cli.progress_display import of_this_process
    from toolkit.evaluation.gathering import gather
    from toolkit.evaluation.scoring import Terms
    from toolkit.evaluation.standings import evaluate
    from toolkit.experiment.workers import usable_cpus
    from toolkit.report.evaluation_files import check_evaluation_directory, write_evaluation

    (ranked_by,), columns = _metrics((options.metric,)), _metrics(options.columns)
    if not -1e9 < options.offset < 1e10:
        raise UsageError(f"--offset: expected seconds, not {options.offset}")
    if options.out is not None:
        check_evaluation_directory(options.out)
    terms = Terms(options.max_dt, options.offset, options.gap, options.imu, options.least_coverage)
    gathered = gather(options.truth, options.given, options.runs)
    with of_this_process()(f"{len(gathered.items)} trajectories") as progress:
        found = evaluate(gathered, terms, ranked_by.key, progress, options.workers or usable_cpus())
    if options.out is not None:
        write_evaluation(found, options.out)
    _print(found, columns, options)
    return 0 if found.all_ok else 1


def _print(found: EvaluatedSystems, columns: tuple[Metric, ...], options: argparse.Namespace) -> None:
    from toolkit.evaluation.document import evaluation_document
    from toolkit.files.documents import to_text
    from toolkit.report import evaluation_text as texts
    from toolkit.report.prose import width_of_output

    if options.json:
        print(to_text(evaluation_document(found)), end="")
    elif options.quiet:
        return
    elif options.format == "csv":
        print(texts.evaluation_csv(found), end="")
    elif options.format == "latex":
        print(texts.evaluation_latex(found, columns), end="")
    elif options.format == "markdown":
        print(texts.evaluation_markdown(found, columns), end="")
    else:
        print(texts.evaluation_text(found, columns, width_of_output()))
        if options.out is not None:
            print(f"\nresults: {printable(str(options.out))}")


def _metrics(keys: tuple[str, ...]) -> tuple[Metric, ...]:
    """Return metrics by their keys; raises UsageError for one that trajectories do not have."""
    from toolkit.evaluation.scoring import METRICS

    if keys == ("all",):
        return METRICS
    by_key = {metric.key: metric for metric in METRICS}
    return tuple(by_key[key] for key in known_names("metric of a trajectory", keys, by_key))


def _percent(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"expected percent, not {text!r}") from None
    if not 0.0 <= value <= 100.0:
        raise argparse.ArgumentTypeError(f"expected 0 to 100 percent, not {text}")
    return value
