"""``vislam compare``: estimators side by side on the same measurements."""

from __future__ import annotations

import argparse
import shlex
import sys
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from toolkit.cli.arguments import (
    UsageError,
    add_estimators_argument,
    add_option,
    add_output_arguments,
    add_part_arguments,
    add_repair_arguments,
    add_tracks_argument,
    add_workers_argument,
    at_least,
    command,
    kept_faults,
    named_file,
    names,
    with_tracks,
)
from toolkit.cli.settings_arguments import add_settings_arguments, check_given_once, requested_assignments
from toolkit.errors import VislamError, printable

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping

    from toolkit.experiment import Comparison, Plan
    from toolkit.experiment.configuration import Configuration
    from toolkit.experiment.outcome_store import OutcomeStore
    from toolkit.report.run_directory import MadeBy

# The one with truth first: its table is the first impression.
SEQUENCES = ("drive", "kitti00")


class Interrupted(VislamError):  # noqa: N818 - the user's wish, no error
    """An interrupt after which something is kept that the same command continues from."""

    exit_status: ClassVar[int] = 130


def _add_what_to_compare(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "sequences",
        metavar="SEQUENCE",
        nargs="*",
        help=f"a recording's path, or a built-in name (default: {' '.join(SEQUENCES)})",
    )
    add_estimators_argument(parser, "estimators to compare, see 'vislam list estimators'; 'ladder' is every rung")
    parser.add_argument("--truth", metavar="FILE.tum", type=Path, help="ground truth; with exactly one SEQUENCE")
    parser.add_argument(
        "--trajectory",
        metavar="NAME=FILE",
        type=named_file,
        action="append",
        default=[],
        help="another system's poses of the IMU (TUM, KITTI, EuRoC or OpenVINS file), to be scored beside the "
        "estimators; may be repeated; with exactly one SEQUENCE",
    )
    parser.add_argument(
        "--out",
        metavar="DIR",
        type=Path,
        help="run directory (default: runs/<date and time>); with --seeds every run is kept there as it ends, and the "
        "same command continues where it stopped",
    )


def _add_seeds(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--seed", metavar="N", type=at_least(0), help="of simulated sequences (default: 0)")
    parser.add_argument(
        "--seeds", metavar="N", type=at_least(1), help="repeat simulated sequences over N seeds, from --seed"
    )
    parser.add_argument(
        "--vary",
        choices=("noise", "world"),
        help="what a seed draws of a simulation: the noise, or trajectory and landmarks as well (default: noise)",
    )
    parser.add_argument(
        "--keep-trajectories",
        action="store_true",
        default=None,
        help="with --seeds, write the trajectories of every seed (of a single one they always are)",
    )


def _add_what_is_shown(parser: argparse.ArgumentParser) -> None:
    what = "figures to draw; docs/figures.md shows all of them"
    add_option(parser, "--figures", "few", what, choices=("few", "all", "none"))
    what = "format of the figures; pdf and svg are vector graphics, for a paper"
    add_option(parser, "--figure-format", "png", what, choices=("png", "pdf", "svg"))
    add_output_arguments(
        parser,
        "the content of metrics.json or seeds.json, a line a SEQUENCE, no table",
        "the run directory has everything",
    )


def _compare_arguments(parser: argparse.ArgumentParser) -> None:
    _add_what_to_compare(parser)
    add_part_arguments(parser)
    add_repair_arguments(parser)
    parser.add_argument(
        "--start",
        choices=("measurements", "truth"),
        help="source of the first state; a start from the truth is labelled (default: measurements)",
    )
    add_tracks_argument(parser)
    _add_seeds(parser)
    parser.add_argument(
        "--columns",
        metavar="NAME,...",
        type=names,
        default=(),
        help="of the table: metrics by key or name, or all; bound: how close each comes to the Cramér-Rao bound",
    )
    add_settings_arguments(parser)
    add_workers_argument(parser)
    _add_what_is_shown(parser)
    parser.add_argument(
        "--scheduler",
        metavar="ADDRESS",
        help="run on the Dask cluster whose scheduler is there, as in tcp://host:8786 (see docs/scaling.md)",
    )


@command(
    "compare",
    "run estimators on the same measurements and compare them",
    "vislam compare drive --estimators dead-reckoning,ekf --max-frames 40 --out runs/drive",
    arguments=_compare_arguments,
)
def compare(options: argparse.Namespace) -> int:
    """Run estimators on the same measurements of each SEQUENCE and compare them: a table here, and a run directory
    with report, metrics, trajectories, landmarks and figures.
    """
    from toolkit.cli.progress_display import of_this_process, print_above
    from toolkit.experiment import comparisons, prepared_cases, stores_of, workers_of
    from toolkit.files.documents import to_line
    from toolkit.report.comparison_table import requested_columns
    from toolkit.report.comparison_text import comparison_text
    from toolkit.report.prose import width_of_output
    from toolkit.report.run_directory import directories_for, write_run
    from toolkit.report.scores_json import scores_document

    columns = requested_columns(options.columns)
    requested = _configuration(options)
    plan, progress_for = _placed(_plan(requested), options), of_this_process()
    made_by, all_ok = _made_by(options, requested), True
    with workers_of(plan) as workers, ExitStack() as open_files:
        cases = prepared_cases(plan, workers, progress_for)
        directories = directories_for(cases, options.out if options.out is not None else _new_run())
        stores = dict(zip(directories, stores_of(plan, cases, directories), strict=False))
        open_files.enter_context(_kept_when_interrupted(stores))
        coming = comparisons(plan, cases, workers, progress_for, tuple(stores.values()))
        for comparison, directory in zip(coming, directories, strict=True):
            try:
                if not (options.json or options.quiet):
                    print_above(comparison_text(comparison, columns, width_of_output()))
            finally:  # before the files, which take seconds to draw, and which a reader that goes away must not cost
                with progress_for(f"{comparison.name}: figures and report"):
                    write_run(comparison, directory, made_by)
            found = _found(comparison, stores.get(directory))
            if options.json:
                print_above(to_line(scores_document(comparison)).rstrip())
            elif not options.quiet:
                where = printable(str(directory))
                print_above(f"results: {where}{found}; as a page: vislam report {shlex.quote(where)}\n")
            all_ok = all_ok and comparison.all_ok
    return 0 if all_ok else 1


def _made_by(options: argparse.Namespace, requested: Configuration) -> MadeBy:
    from toolkit.report.run_directory import MadeBy

    return MadeBy(shlex.join(options.command_line), requested, options.figure_format, options.figures)


@contextmanager
def _kept_when_interrupted(stores: Mapping[Path, OutcomeStore]) -> Iterator[None]:
    """Say what of the kept outcomes is of no use and, after an interrupt, where others are; close them in the end.

    Raises Interrupted in the place of KeyboardInterrupt where any outcome is kept.
    """
    for directory, store in stores.items():
        if store.unusable:
            what = f"{store.unusable} outcomes of other data, noise or repairs, or of another version"
            print(f"vislam: {printable(str(directory))}: {what}, are there and not used", file=sys.stderr)
    try:
        yield
    except KeyboardInterrupt:
        begun = [printable(str(directory)) for directory, store in stores.items() if store.is_there]
        if not begun:
            raise
        kept = f"what has ended is kept in {', '.join(begun)}"
        raise Interrupted(f"interrupted; {kept}, and the same command with this --out goes on") from None
    finally:
        for store in stores.values():
            store.close()


def _found(comparison: Comparison, store: OutcomeStore | None) -> str:
    """Return how many runs did not have to be made, nothing where all had."""
    if store is None or not store.found:
        return ""
    return f" ({store.found} of {len(comparison.outcomes)} runs were there)"


def _configuration(options: argparse.Namespace) -> Configuration:
    """Return what is to be compared and how: the file of --config, and over it the command line."""
    from toolkit.experiment.configuration import configuration, read_configuration
    from toolkit.metrics import requests_of
    from toolkit.settings import with_assignments

    request, settings = ({}, {}) if options.config is None else read_configuration(options.config)
    assignments = requested_assignments(options)
    places = ([] if options.config is None else [str(options.config)]) + (["the command line"] if assignments else [])
    place = " or ".join(places) or "the command line"
    given = {
        "sequences": options.sequences or None,
        "estimators": options.estimators,
        "truth": None if options.truth is None else str(options.truth),
        "trajectories": {name: str(file) for name, file in options.trajectory} or None,
        "max_frames": options.max_frames,
        **{"from_s": options.from_s, "to_s": options.to_s, "every": options.every},
        "keep": _faults_kept(options),
        "keep_trajectories": options.keep_trajectories,
    }
    named = {"start": options.start, "first_seed": options.seed, "seeds": options.seeds, "vary": options.vary}
    request = {**request, **{key: value for key, value in given.items() if value is not None}}
    settings = with_assignments(settings, assignments)
    settings |= {key: value for key, value in named.items() if value is not None}
    switches = [] if options.columns == ("all",) else [f"metrics.{name}" for name in requests_of(options.columns)]
    check_given_once({switch: (f"--columns {','.join(options.columns)}", True) for switch in switches}, options.set)
    settings = with_assignments(settings, [f"{switch}=true" for switch in switches])
    settings = with_tracks(settings, options)
    return configuration(request, settings, place)


def _faults_kept(options: argparse.Namespace) -> tuple[str, ...] | None:
    """Return the faults not to be repaired, or None where the command line says nothing of them."""
    if not options.no_repair and not options.keep:
        return None
    from toolkit.audit import faults

    return tuple(sorted(kept_faults(options, faults())))


def _placed(plan: Plan, options: argparse.Namespace) -> Plan:
    """Return the plan with where it is run."""

    if options.scheduler is not None and options.workers is not None:
        raise UsageError("--scheduler and --workers exclude each other: a cluster has its own workers")
    return replace(plan, workers=options.workers, scheduler=options.scheduler)


def _plan(requested: Configuration) -> Plan:
    """Return the plan of a configuration; what does not go together is a UsageError."""
    from toolkit.experiment import Plan
    from toolkit.experiment.recording import Part
    from toolkit.registry import defaults

    request, settings = requested.request, requested.settings
    sequences = request.sequences or SEQUENCES
    estimators = request.estimators or defaults()
    single = {"--truth": request.truth is not None, "--trajectory": bool(request.trajectories)}
    for option, used in single.items():
        if used and len(sequences) != 1:
            raise UsageError(f"{option} goes with exactly one SEQUENCE (see vislam compare --help)")
        if used and settings.seeds > 1:
            raise UsageError(f"{option} and --seeds exclude each other: a file is of one recording")
    _check_trajectory_names(request.trajectories, estimators)
    return Plan(
        sources=tuple(sequences),
        estimators=tuple(estimators),
        settings=settings,
        truth=None if request.truth is None else Path(request.truth),
        trajectories={name: Path(file) for name, file in request.trajectories.items()},
        keep=frozenset(request.keep),
        max_frames=request.max_frames,
        part=Part(request.from_s, request.to_s, request.every),
        keep_trajectories=request.keep_trajectories,
    )


def _check_trajectory_names(trajectories: Mapping[str, str], estimators: Iterable[str]) -> None:
    """Raise UsageError for a trajectory whose name stands for something else."""
    if not trajectories:
        return
    from toolkit.experiment.comparison import plain_name
    from toolkit.registry import find_all
    from toolkit.report.export import TRUTH
    from toolkit.sequence import LONGEST_NAME

    # What a name becomes as that of a file must differ, too.
    taken = {plain_name(name): name for name in (TRUTH, *find_all(estimators))}
    for name in trajectories:
        plain = plain_name(name)
        if len(plain) > LONGEST_NAME:
            raise UsageError(
                f"--trajectory: a name of {len(plain)} characters is too long for a file; choose a shorter one"
            )
        if not plain or plain in taken:
            why = f"is taken by {taken[plain]}" if plain else "has no letter or digit"
            raise UsageError(f"--trajectory: the name {name} {why}; choose another")
        taken[plain] = f"another trajectory, {name}"


def _new_run() -> Path:
    """Return a directory named by the local time that does not exist yet."""
    from datetime import datetime

    stamp = datetime.now().astimezone().strftime("%Y-%m-%d_%H-%M-%S")
    free = (Path("runs") / name for name in (stamp, *(f"{stamp}_{n}" for n in range(2, 1000))))
    return next(path for path in free if not path.exists())
