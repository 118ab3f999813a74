"""``vislam compare``: estimators side by side on the same measurements."""

from __future__ import annotations

import argparse
import shlex
from pathlib import Path
from typing import TYPE_CHECKING

from toolkit.cli.arguments import (
    add_estimators_argument,
    add_repair_arguments,
    add_workers_argument,
    at_least,
    epilog,
    kept_faults,
    named_file,
)

if TYPE_CHECKING:
    from collections.abc import Iterator

    from toolkit.cli.arguments import Subcommands
    from toolkit.report.session import Request

SEQUENCES = ("kitti00", "drive")


def add_to(subcommands: Subcommands) -> None:
    """Add the subcommand."""
    parser = subcommands.add_parser(
        "compare",
        help="run estimators on the same measurements and compare them",
        description="Run estimators on the same measurements of each SEQUENCE and compare them: a table here, and a "
        "run directory with report, metrics, trajectories, landmarks and figures.",
        epilog=epilog("vislam compare drive --estimators dead-reckoning,ekf --max-frames 40 --out runs/drive"),
    )
    parser.add_argument(
        "sequences",
        metavar="SEQUENCE",
        nargs="*",
        default=SEQUENCES,
        help=f"a recording's path, or a built-in name (default: {' '.join(SEQUENCES)})",
    )
    add_estimators_argument(parser, "what to compare, see 'vislam list'; 'ladder' is every rung")
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
    parser.add_argument("--out", metavar="DIR", type=Path, help="run directory (default: runs/<date and time>)")
    parser.add_argument("--max-frames", metavar="N", type=at_least(2), help="use the first N frames only")
    add_repair_arguments(parser)
    parser.add_argument(
        "--start",
        choices=("measurements", "truth"),
        default="measurements",
        help="where the first state comes from; a start from the truth is labelled (default: measurements)",
    )
    parser.add_argument("--seed", metavar="N", type=at_least(0), default=0, help="of simulated sequences (default: 0)")
    parser.add_argument(
        "--seeds",
        metavar="N",
        type=at_least(1),
        default=1,
        help="repeat simulated sequences over N seeds, from --seed",
    )
    add_workers_argument(parser, "processes side by side with --seeds")
    parser.set_defaults(command=command)


def command(options: argparse.Namespace) -> int:
    """Compare, print and return 1 where an estimator diverged or failed."""
    from toolkit.audit import faults
    from toolkit.cli.arguments import UsageError
    from toolkit.report.session import Request

    if options.truth is not None and len(options.sequences) != 1:
        raise UsageError("--truth goes with exactly one SEQUENCE (see vislam compare --help)")
    request = Request(
        sources=tuple(options.sequences),
        estimators=options.estimators,
        out=options.out if options.out is not None else _new_run(),
        truth=options.truth,
        trajectories=_trajectories(options),
        max_frames=options.max_frames,
        keep=kept_faults(options, faults()),
        start=options.start,
        seed=options.seed,
        command=shlex.join(options.command_line),
    )
    compared = _over_seeds(request, options) if options.seeds > 1 or options.workers is not None else _once(request)
    all_ok = True
    for text, directory, ok in compared:
        print(text, f"\nresults: {directory}\n", sep="\n", flush=True)
        all_ok = all_ok and ok
    return 0 if all_ok else 1


def _trajectories(options: argparse.Namespace) -> dict[str, Path]:
    """Return the trajectory files by name; a name that stands for something else is a UsageError."""
    if not options.trajectory:
        return {}
    from toolkit.cli.arguments import UsageError
    from toolkit.estimator import find_all
    from toolkit.report.comparison import plain_name
    from toolkit.report.export import TRUTH

    if len(options.sequences) != 1:
        raise UsageError("--trajectory goes with exactly one SEQUENCE (see vislam compare --help)")
    # What a name becomes as that of a file must differ, too.
    taken = {plain_name(name): name for name in (TRUTH, *find_all(options.estimators))}
    for name, _ in options.trajectory:
        plain = plain_name(name)
        if not plain or plain in taken:
            why = f"is taken by {taken[plain]}" if plain else "has no letter or digit"
            raise UsageError(f"--trajectory: the name {name} {why}; choose another")
        taken[plain] = f"another trajectory, {name}"
    return dict(options.trajectory)


def _once(request: Request) -> Iterator[tuple[str, Path, bool]]:
    """Yield each comparison as text, where its results are, and whether every run ended well."""
    from toolkit.progress import of_this_process
    from toolkit.report.session import compare_all
    from toolkit.report.terminal import comparison_text

    for comparison, directory in compare_all(request, of_this_process()):
        yield comparison_text(comparison), directory, comparison.all_ok


def _over_seeds(request: Request, options: argparse.Namespace) -> Iterator[tuple[str, Path, bool]]:
    """Yield the same for each comparison over seeds; what cannot be repeated over seeds is a UsageError."""
    from toolkit.cli.arguments import UsageError
    from toolkit.datasets import is_drawn_from_a_seed
    from toolkit.experiment.workers import usable_cpus
    from toolkit.progress import of_this_process
    from toolkit.report.seeds_md import seeds_text
    from toolkit.report.seeds_session import OverSeedsRequest, compare_over_seeds

    if options.seeds == 1:
        raise UsageError("--workers goes with --seeds of 2 and more (see vislam compare --help)")
    if options.truth is not None:
        raise UsageError("--truth and --seeds exclude each other: every seed has the truth of its own simulation")
    if options.trajectory:
        raise UsageError("--trajectory and --seeds exclude each other: a file is of one recording, not of every seed's")
    for source in request.sources:
        if not is_drawn_from_a_seed(source):
            raise UsageError(f"--seeds repeats simulated sequences, and {source} is the same under every seed")
    asked = OverSeedsRequest(request, options.seeds, options.workers or usable_cpus())
    for over, directory in compare_over_seeds(asked, of_this_process()):
        yield seeds_text(over), directory, over.all_ok


def _new_run() -> Path:
    """Return a directory named by the local time that does not exist yet."""
    from datetime import datetime

    stamp = datetime.now().astimezone().strftime("%Y-%m-%d_%H-%M-%S")
    free = (Path("runs") / name for name in (stamp, *(f"{stamp}_{n}" for n in range(2, 1000))))
    return next(path for path in free if not path.exists())
