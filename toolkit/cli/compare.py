"""``vislam compare``, ``explain`` and ``sweep``: estimators on the same measurements, under one setting or many."""

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
    PART,
    REPAIR,
    SETTINGS,
    TOPICS,
    TRACKS,
    WORKERS,
    UsageError,
    arg,
    at_least,
    choice,
    command,
    estimators,
    flag,
    kept_faults,
    named_file,
    names,
    output,
    requested_changes,
    seconds_from_start,
)
from toolkit.errors import VislamError, printable

if TYPE_CHECKING:
    from msgspec import Struct

    from toolkit.experiment.comparison import Comparison
    from toolkit.experiment.configuration import Request
    from toolkit.report.comparison_table import Columns
    from toolkit.settings import Settings

# The one with truth first: its table is the first impression.
SEQUENCES = ("drive", "kitti00")


# How recordings are prepared and estimators run, of every command that does so.
_HOW = (
    *PART,
    REPAIR,
    choice("--start", ("measurements", "truth"), "source of the first state (default: measurements)", sets="start"),
    TRACKS,
    TOPICS,
    arg("--seed N", "of simulated sequences (default: 0)", at_least(0), sets="first_seed"),
    arg("--seeds N", "repeat simulated sequences over N seeds, from --seed", at_least(1), sets="seeds"),
    choice("--vary", ("noise", "world"), "what a seed draws: noise, or the whole world (default: noise)", sets="vary"),
    *SETTINGS,
)
_SCHEDULER = arg("--scheduler ADDRESS", "run on a Dask cluster, as in tcp://host:8786 (see docs/scaling.md)")
_TRUTH = arg("--truth FILE.tum", "ground truth of the one SEQUENCE")
_OUT = arg(
    "--out DIR",
    "run directory (default: runs/<date and time>); runs of several seeds or variants are kept there as they end, and "
    "the same command continues where it stopped",
    Path,
)


class Interrupted(VislamError):  # noqa: N818 - the user's wish, no error
    """An interrupt after which something is kept that the same command continues from."""

    exit_status: ClassVar[int] = 130


@command(
    "compare",
    "run estimators on the same measurements and compare them",
    arg("sequences SEQUENCE", f"a recording's path, or a built-in name (default: {' '.join(SEQUENCES)})", nargs="*"),
    estimators("estimators to compare, see 'vislam list estimators'; 'ladder' is every rung"),
    _TRUTH,
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
    _OUT,
    *_HOW,
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
    _SCHEDULER,
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
    from toolkit.report.comparison_table import requested_columns
    from toolkit.report.run_directory import MadeBy, directories_for, write_run
    from toolkit.report.scores import scores_document

    columns = requested_columns(options.columns)
    request, settings = _requested(options)
    plan = plan_of(request, settings, SEQUENCES, workers=options.workers, scheduler=options.scheduler)
    made_by = MadeBy(shlex.join(options.command_line), request, options.figure_format, options.figures)
    progress_for, all_ok = of_this_process(), True
    with workers_of(plan) as workers, ExitStack() as open_files:
        cases = prepared_cases(plan, workers, progress_for)
        directories = directories_for(cases, options.out if options.out is not None else _new_run())
        stores = dict(zip(directories, stores_of(plan, cases, directories), strict=False))
        for directory, store in stores.items():
            open_files.callback(store.close)
            _tell_unusable(store.unusable, directory)
        open_files.enter_context(_kept_where(stores))
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
    from toolkit.report import comparison_text as texts
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


@command(
    "explain",
    "say what makes one estimator more accurate than another, ingredient by ingredient",
    arg("sequence SEQUENCE", "a recording's path, or a built-in name"),
    arg(
        "--from NAME",
        "the first estimator (default: the lowest with INGREDIENTS of those compared by default)",
        dest="start_at",
    ),
    arg("--to NAME", "the second estimator (default: the highest of those)", dest="goal"),
    arg(
        "--estimators NAME,...",
        "those that may be run between the two, with and without ingredients, or files (default: all)",
        names,
    ),
    _TRUTH,
    _OUT,
    arg("--since TIME", "leave out frames before it, as in 10s", seconds_from_start, dest="from_s"),
    arg("--until TIME", "leave out frames after it, as in 10s", seconds_from_start, dest="to_s"),
    *(one for one in _HOW if one not in PART[:2]),
    WORKERS,
    _SCHEDULER,
    output("what explain.json holds, no table", "the run directory has everything"),
    examples=(
        "vislam explain drive --from ekf --to ekf-slam --until 3s --estimators ekf,ekf-slam --out runs/why",
        "vislam report runs/why",
    ),
)
def explain(options: argparse.Namespace) -> int:
    """Run what lies between two estimators on one recording, and say what each ingredient in which they differ brings:
    added as near to the first as can be, and taken away as near to the second; with 95 % intervals over 3 seeds or
    more, or over stretches of a recording. docs/explain.md tells how.
    """
    from toolkit.cli.progress_display import of_this_process
    from toolkit.experiment.configuration import plan_of
    from toolkit.experiment.explanation import default_ends, run_explanation
    from toolkit.registry import discover
    from toolkit.report.explanation import EXPLANATIONS, write_explanation
    from toolkit.report.text import width_of_output

    options.sequences = [options.sequence]
    options.estimators = options.estimators or tuple(discover())
    plan = plan_of(*_requested(options), (), workers=options.workers, scheduler=options.scheduler)
    usual = default_ends()
    ends = options.start_at or usual[0], options.goal or usual[1]
    target, progress_for = options.out or _new_run(), of_this_process()
    EXPLANATIONS.check(target)
    with _kept_where([target]):
        found = run_explanation(plan, *ends, target, progress_for)
    with progress_for(f"{found.grid.case.name}: figure"):
        document = write_explanation(found, target, shlex.join(options.command_line))
    _tell_unusable(found.grid.unusable, target)
    _print(document, EXPLANATIONS.text(document, width_of_output()), target, options)
    return 0


def over(text: str) -> tuple[str, tuple[str, ...]]:
    name, equals, values = text.partition("=")
    given = tuple(value.strip() for value in values.split(",") if value.strip())
    if not (equals and name.strip() and given):
        raise argparse.ArgumentTypeError(f"expected KEY=V1,V2,... or fault:NAME=D1,D2,..., not {text!r}")
    return name.strip(), given


@command(
    "sweep",
    "vary settings or plant faults in doses, and see where estimators break",
    arg("sequence SEQUENCE", "a recording's path, or a built-in name", nargs="?"),
    arg(
        "--over KEY=V1,V2,...",
        "vary a setting (see 'vislam list settings'), or plant fault:NAME in doses (see 'vislam list injectors'); two "
        "are crossed, every value with every other",
        over,
        action="append",
        default=[],
    ),
    flag("--each", "vary each of several by itself, and cross none", default=None),
    estimators("estimators to run, see 'vislam list estimators'"),
    _TRUTH,
    _OUT,
    *_HOW,
    WORKERS,
    _SCHEDULER,
    output("what sweep.json holds, no table", "the run directory has everything"),
    examples=(
        "vislam sweep drive --over fault:dropped_frames=0.3,0.8 --estimators dead-reckoning,ekf --seeds 2 --to 3s "
        "--out runs/sweep",
    ),
)
def sweep(options: argparse.Namespace) -> int:
    """Run estimators on one recording at every value of a setting, or with a fault planted in every dose of it, over
    seeds, and tell how their errors compare with those without: a table with 95 % intervals, the dose at which each
    breaks, what the audit would have said, and figures.
    """
    from toolkit.cli.progress_display import of_this_process
    from toolkit.experiment.configuration import SweepRequest, plan_of, read_sweep_request
    from toolkit.experiment.sweep import run_sweep
    from toolkit.report.figures.sweeps import draw_sweep
    from toolkit.report.sweep import SWEEPS, write_sweep
    from toolkit.settings.reading import assigned

    requested = SweepRequest() if options.config is None else read_sweep_request(options.config)
    axes = {name: [assigned(f"{name}={value}")[1] for value in values] for name, values in options.over}
    if len(axes) < len(options.over):
        raise UsageError("--over names the same twice; give all its values at once")
    options.sequences = None if options.sequence is None else [options.sequence]
    plan = plan_of(*_requested(options), (), workers=options.workers, scheduler=options.scheduler)
    if not plan.sources:
        raise UsageError("name the sequence to sweep, a path or a built-in name as drive")
    target, progress_for = options.out or _new_run(), of_this_process()
    SWEEPS.check(target)
    with _kept_where([target]):
        crossed = not (options.each or requested.each)
        found = run_sweep(plan, axes or requested.over, crossed=crossed, directory=target, progress_for=progress_for)
    with progress_for(f"{found.grid.case.name}: figures"):
        document = write_sweep(found, target, shlex.join(options.command_line), list(draw_sweep(found)))
    _tell_unusable(found.grid.unusable, target)
    _print(document, SWEEPS.text(document), target, options)
    return 0


def _tell_unusable(count: int, directory: Path) -> None:
    if count:
        what = f"{count} outcomes of other data, noise or repairs, or of another version"
        print(f"vislam: {printable(str(directory))}: {what}, are there and not used", file=sys.stderr)


def _print(document: Struct, text: str, target: Path, options: argparse.Namespace) -> None:
    from toolkit.cli.progress_display import print_above
    from toolkit.files.documents import to_line

    where = printable(str(target))
    if options.json:
        print_above(to_line(document).rstrip())
    elif not options.quiet:
        print_above(f"{text}\n\nresults: {where}; as a page: vislam report {shlex.quote(where)}")


def _requested(options: argparse.Namespace) -> tuple[Request, Settings]:
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
def _kept_where(directories: Iterable[Path]) -> Iterator[None]:
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


def _new_run() -> Path:
    from datetime import datetime

    stamp = datetime.now().astimezone().strftime("%Y-%m-%d_%H-%M-%S")
    free = (Path("runs") / name for name in (stamp, *(f"{stamp}_{n}" for n in range(2, 1000))))
    return next(path for path in free if not path.exists())
