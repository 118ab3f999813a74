"""``vislam check``: has anything got worse than a baseline, or moved from it?"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from toolkit.cli.arguments import UsageError, add_workers_argument, epilog, runs_given

if TYPE_CHECKING:
    from toolkit.cli.arguments import Subcommands
    from toolkit.gate.verdict import Check

_FILES = {"junit": "JUnit XML", "markdown": "Markdown for a pull request", "json": "JSON"}


def add_to(subcommands: Subcommands) -> None:
    """Add the subcommand."""
    parser = subcommands.add_parser(
        "check",
        help="fail if accuracy, consistency or speed are not a baseline's",
        description="Run again what a baseline lists, on the same measurements, and fail where accuracy, "
        "consistency, held-out reprojection or speed got worse, an answer moved, or anything is missing. With "
        "--trajectories, judge files of another system in the same way. See docs/gate.md.",
        epilog=epilog(
            "vislam baseline drive --estimators dead-reckoning --seeds 5 --duration 2 --out baseline.json",
            "vislam check --baseline baseline.json --skip-speed",
        ),
    )
    parser.add_argument(
        "--baseline",
        metavar="FILE",
        type=Path,
        required=True,
        help="what vislam baseline wrote; of a folder, the one for the releases installed here",
    )
    add_workers_argument(parser)
    for name, what in _FILES.items():
        parser.add_argument(f"--{name}", metavar="FILE", type=Path, help=f"write the verdicts as {what}")
    parser.add_argument(
        "--trajectories",
        metavar="DIR|FILE",
        type=Path,
        help="run nothing; judge another system's files, SEQUENCE.tum or SEQUENCE/RUN.tum, or the evaluation.json that "
        "vislam evaluate made of them, against a baseline that vislam baseline --trajectories wrote",
    )
    parser.add_argument(
        "--truth",
        metavar="DIR|SEQUENCE=FILE",
        action="append",
        default=[],
        help="with --trajectories: where the truth is, if not where it was for the baseline",
    )
    parser.add_argument(
        "--accept-better",
        action="store_true",
        help="let results that moved pass unless they are worse, as after a change that is meant to move them",
    )
    parser.add_argument("--skip-speed", action="store_true", help="do not judge time, as on a machine of another make")
    parser.add_argument(
        "--speed-against",
        metavar="REVISION|WHEEL",
        help="judge time by runs in turn with another version of the code: a git revision of the checkout you stand "
        "in, or a wheel; sees 15 %%, on any machine",
    )
    parser.add_argument(
        "--allow-other-releases",
        action="store_true",
        help="compare although GTSAM or NumPy is another release than the baseline's",
    )
    parser.set_defaults(command=command)


def command(options: argparse.Namespace) -> int:
    """Check, print and return 1 where anything fails."""
    from toolkit.files import check_writable
    from toolkit.report.gate import gate_text, write_check
    from toolkit.report.prose import width_of_output

    files = {name: path for name in _FILES if (path := getattr(options, name)) is not None}
    for path in files.values():
        check_writable(path)
    checked = _of_estimators(options) if options.trajectories is None else _of_trajectories(options)
    write_check(checked, files)
    print(gate_text(checked, width_of_output()))
    return 0 if checked.passed else 1


def _of_estimators(options: argparse.Namespace) -> Check:
    from toolkit.experiment.workers import usable_cpus
    from toolkit.gate.baseline_file import check_releases, load_baseline
    from toolkit.gate.checking import How, check
    from toolkit.progress import of_this_process

    if options.speed_against and options.skip_speed:
        raise UsageError("--speed-against and --skip-speed exclude each other")
    if options.truth:
        raise UsageError("--truth goes with --trajectories; a baseline of estimators names its own truth")
    baseline = load_baseline(options.baseline)
    if not options.allow_other_releases:
        check_releases(baseline, str(options.baseline))
    how = How(
        options.workers or usable_cpus(),
        speed=not options.skip_speed,
        accept_better=options.accept_better,
        speed_against=options.speed_against,
    )
    return check(baseline, str(options.baseline), how, of_this_process())


def _of_trajectories(options: argparse.Namespace) -> Check:
    from toolkit.gate.trajectory_baseline import load_trajectory_baseline
    from toolkit.gate.trajectory_check import check_trajectories

    if options.speed_against:
        raise UsageError("--speed-against times estimators; with --trajectories nothing runs")
    baseline, given = load_trajectory_baseline(options.baseline), runs_given(options.trajectories, options.truth)
    return check_trajectories(baseline, str(options.baseline), given, accept_better=options.accept_better)
