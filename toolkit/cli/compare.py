"""``vislam compare``: estimators on the same measurements; and what its kin in trials.py ask for and keep alike."""

from __future__ import annotations

import argparse
import shlex
import sys
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from toolkit.cli.arguments import (
    COV_CONVENTION,
    FIGURES,
    FORMAT,
    HOW,
    OUT,
    SCHEDULER,
    TRUTH,
    WORKERS,
    arg,
    command,
    estimators,
    flag,
    kept_faults,
    named_file,
    names,
    output,
    requested_changes,
)
from toolkit.errors import VislamError, printable

if TYPE_CHECKING:
    from toolkit.experiment.comparison import Comparison
    from toolkit.experiment.configuration import Request
    from toolkit.report.headers import Columns
    from toolkit.settings import Settings

# The one with truth first: its table is the first impression.
SEQUENCES = ("drive", "kitti00")


class Interrupted(VislamError):  # noqa: N818 - the user's wish, no error
    """An interrupt after which something is kept that the same command continues from."""

    exit_status: ClassVar[int] = 130


@command(
    "compare",
    "run estimators on the same measurements and compare them",
    arg("sequences SEQUENCE", f"a recording's path, or a built-in name (default: {' '.join(SEQUENCES)})", nargs="*"),
    estimators("estimators to compare, see 'vislam list estimators'; 'ladder' is every rung"),
    TRUTH,
    arg(
        "--trajectory NAME=FILE",
        "another system's poses of the IMU, to be scored beside the estimators, as final or, with FILE:causal, as "
        "causal output; may be repeated; with exactly one SEQUENCE",
        named_file,
        action="append",
        dest="trajectories",
        default=[],
    ),
    COV_CONVENTION,
    OUT,
    *HOW,
    flag("--keep-trajectories", "with --seeds, write the trajectories of every seed", default=None),
    arg(
        "--columns NAME,...",
        "of the table: metrics by key or name, or all; bound: how close each comes to the Cramér-Rao bound",
        names,
        default=(),
    ),
    WORKERS,
    *FIGURES,
    FORMAT,
    output("what metrics.json or seeds.json holds, a line a SEQUENCE, no table", "the run directory has everything"),
    SCHEDULER,
    examples=("vislam compare drive --estimators dead-reckoning,ekf --max-frames 40 --out runs/drive",),
)
def compare(options: argparse.Namespace) -> int:
    """Run estimators on the same measurements of each SEQUENCE and compare them: a table here, and a run directory
    with report, metrics, trajectories, landmarks and figures.
    """
    from toolkit.cli.progress_display import of_this_process, print_above
    from toolkit.experiment.configuration import plan_of
    from toolkit.experiment.pipeline import comparisons, prepared_cases, stores_of, workers_of
    from toolkit.files.documents import to_line
    from toolkit.report.headers import requested_columns
    from toolkit.report.run_directory import MadeBy, directories_for, write_run
    from toolkit.report.scores import scores_document

    columns = requested_columns(options.columns)
    request, settings = requested(options)
    plan = plan_of(request, settings, SEQUENCES, workers=options.workers, scheduler=options.scheduler)
    made_by = MadeBy(shlex.join(options.command_line), request, options.figure_format, options.figures)
    progress_for, all_ok = of_this_process(), True
    with workers_of(plan) as workers, ExitStack() as open_files:
        cases = prepared_cases(plan, workers, progress_for)
        directories = directories_for(cases, options.out if options.out is not None else new_run())
        stores = dict(zip(directories, stores_of(plan, cases, directories), strict=False))
        for directory, store in stores.items():
            open_files.callback(store.close)
            tell_unusable(store.unusable, directory)
        open_files.enter_context(kept_where(stores))
        coming = comparisons(plan, cases, workers, progress_for, tuple(stores.values()))
        for comparison, directory in zip(coming, directories, strict=True):
            try:
                if not (options.json or options.quiet):
                    print_above(_shown(comparison, columns, options.format, first=directory == directories[0]))
            finally:  # before the files, which take seconds to draw, and which a reader that goes away must not cost
                with progress_for(f"{comparison.name}: figures and report"):
                    write_run(comparison, directory, made_by)
            if options.json:
                print_above(to_line(scores_document(comparison)).rstrip())
            elif not options.quiet and options.format == "text":
                where, found = printable(str(directory)), stores[directory].found if stores else 0
                there = f" ({found} of {len(comparison.outcomes)} runs were there)" if found else ""
                print_above(f"results: {where}{there}; as a page: vislam report {shlex.quote(where)}\n")
            all_ok = all_ok and comparison.all_ok
    return 0 if all_ok else 1


def _shown(comparison: Comparison, columns: Columns, form: str, *, first: bool) -> str:
    """Return a comparison in the form that was asked for; of CSV only the first has a heading."""
    from toolkit.report import comparison_table as texts
    from toolkit.report.text import width_of_output

    match form:
        case "csv":
            text = texts.comparison_csv(comparison)
            return text if first else text.partition("\n")[2]
        case "latex":
            return texts.comparison_latex(comparison, columns) + "\n"
        case "markdown":
            return texts.comparison_markdown(comparison, columns) + "\n"
    return texts.comparison_text(comparison, columns, width_of_output())


def tell_unusable(count: int, directory: Path) -> None:
    if count:
        what = f"{count} outcomes of other data, noise or repairs, or of another version"
        print(f"vislam: {printable(str(directory))}: {what}, are there and not used", file=sys.stderr)


def requested(options: argparse.Namespace) -> tuple[Request, Settings]:
    """Return what is to be compared and how: the file of --config, and over it the command line."""
    from toolkit.experiment.configuration import COMPARE, Request, read_configuration, record_of
    from toolkit.metrics import requests_of
    from toolkit.settings.reading import settings_of, with_changes

    request, settings = ({}, {}) if options.config is None else read_configuration(options.config)
    columns = getattr(options, "columns", ())
    switches = () if columns == ("all",) else requests_of(columns)
    by_columns = [(f"--columns {','.join(columns)}", f"metrics.{switch}", True) for switch in switches]
    changes = requested_changes(options, *by_columns)
    given = {name: getattr(options, name, None) for name in Request.__struct_fields__} | {"keep": kept_faults(options)}
    given |= {"trajectories": dict(getattr(options, "trajectories", ()))}
    given = {name: value for name, value in given.items() if value not in (None, [], {})}
    places = ([] if options.config is None else [str(options.config)]) + (["the command line"] if changes else [])
    place = " or ".join(places) or "the command line"
    return record_of(Request, {**request, **given}, place, COMPARE), settings_of(with_changes(settings, changes), place)


@contextmanager
def kept_where(directories: Iterable[Path]) -> Iterator[None]:
    """Say after an interrupt where outcomes are that were kept; raises Interrupted then, if there are any."""
    from toolkit.experiment.outcome_store import OUTCOMES

    try:
        yield
    except KeyboardInterrupt:
        begun = [printable(str(directory)) for directory in directories if (directory / OUTCOMES).exists()]
        if not begun:
            raise
        kept = f"what has ended is kept in {', '.join(begun)}"
        raise Interrupted(f"interrupted; {kept}, and the same command with this --out goes on") from None


def new_run() -> Path:
    from datetime import datetime

    stamp = datetime.now().astimezone().strftime("%Y-%m-%d_%H-%M-%S")
    free = (Path("runs") / name for name in (stamp, *(f"{stamp}_{n}" for n in range(2, 1000))))
    return next(path for path in free if not path.exists())
