"""``vislam report``: run directories as one HTML page."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from toolkit.cli.arguments import epilog
from toolkit.errors import printable

if TYPE_CHECKING:
    from toolkit.cli.arguments import Subcommands

_NAME = "report.html"


def add_to(subcommands: Subcommands) -> None:
    """Add the subcommand."""
    parser = subcommands.add_parser(
        "report",
        help="show run directories as one interactive HTML page",
        description="Write one HTML file that opens from disk, with all it needs inside: the table, the trajectories "
        "from above and in three dimensions, errors, consistency, time, and what to know in words. Several run "
        "directories are laid side by side.",
        epilog=epilog(
            "vislam compare drive --estimators dead-reckoning,ekf --max-frames 40 --out runs/drive",
            "vislam report runs/drive",
        ),
    )
    parser.add_argument("runs", metavar="RUN_DIR", nargs="+", type=Path, help="as vislam compare writes it")
    parser.add_argument(
        "--out",
        metavar="FILE",
        type=Path,
        help=f"the page (default: {_NAME} in the run directory; ./{_NAME} for several)",
    )
    parser.set_defaults(command=command)


def command(options: argparse.Namespace) -> int:
    """Write the page and say where it is."""
    from toolkit.report.html import write_html

    target = options.out
    if target is None:
        target = options.runs[0] / _NAME if len(options.runs) == 1 else Path(_NAME)
    write_html(options.runs, target)
    print(printable(f"report: {target}"))
    return 0
