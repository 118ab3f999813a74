"""``vislam diff``: what differs between two run directories."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from toolkit.cli.arguments import UsageError, epilog, names
from toolkit.errors import VislamError

if TYPE_CHECKING:
    from toolkit.cli.arguments import Subcommands


def add_to(subcommands: Subcommands) -> None:
    """Add the subcommand."""
    parser = subcommands.add_parser(
        "diff",
        help="tell what differs between two run directories",
        description="Tell what differs between two run directories: settings, versions, data, how runs ended, and the "
        "metrics that moved; over seeds also which of them moved by more than chance.",
        epilog=epilog(
            "vislam compare drive --estimators ekf --max-frames 40 --out runs/before",
            "vislam compare drive --estimators ekf --max-frames 40 --set noise.motion_scale=1.2 --out runs/after",
            "vislam diff runs/before runs/after",
        ),
    )
    parser.add_argument("before", metavar="RUN_A", type=Path, help="as vislam compare writes it")
    parser.add_argument("after", metavar="RUN_B", type=Path, help="the one that is held against it")
    parser.add_argument(
        "--columns", metavar="KEY,...", type=names, default=(), help="metrics to show, or all (default: the tables')"
    )
    parser.add_argument("--json", action="store_true", help="print every metric and difference as JSON")
    parser.set_defaults(command=command)


def command(options: argparse.Namespace) -> int:
    """Compare and print; what differs is no failure."""
    from toolkit.documents import to_text
    from toolkit.metrics import known_metrics, metrics_called
    from toolkit.report.diff_text import diff_document, diff_text
    from toolkit.report.differences import differences
    from toolkit.report.prose import width_of_output
    from toolkit.report.run_files import read_run

    try:
        columns = known_metrics() if options.columns == ("all",) else metrics_called(options.columns)
    except VislamError as error:
        raise UsageError(str(error)) from error
    found = differences(read_run(options.before), read_run(options.after))
    if options.json:
        print(to_text(diff_document(found)), end="")
    else:
        print(diff_text(found, columns, width_of_output()))
    return 0
