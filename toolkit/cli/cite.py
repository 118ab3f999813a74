"""``vislam cite``: BibTeX for estimators and data sets."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from toolkit.cli.arguments import epilog

if TYPE_CHECKING:
    from toolkit.cli.arguments import Subcommands


def add_to(subcommands: Subcommands) -> None:
    """Add the subcommand."""
    parser = subcommands.add_parser(
        "cite",
        help="print BibTeX for estimators and data sets",
        description="Print BibTeX for estimators, data sets or whatever a run directory compared; for all of them "
        "without a name.",
        epilog=epilog("vislam cite msckf-fej euroc"),
    )
    parser.add_argument(
        "names", metavar="NAME|RUN_DIR", nargs="*", help="an estimator, a format, an estimator's file, a run directory"
    )
    parser.set_defaults(command=command)


def command(options: argparse.Namespace) -> int:
    """Print the entries."""
    from toolkit.report.citations import bibtex, citations

    print(bibtex(citations(options.names)), end="")
    return 0
