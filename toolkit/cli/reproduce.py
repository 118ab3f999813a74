"""``vislam reproduce``: run what is in a bundle again, and say what differs."""

from __future__ import annotations

import argparse
import os
from contextlib import ExitStack, redirect_stdout
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from toolkit.cli.arguments import add_workers_argument, epilog
from toolkit.errors import printable

if TYPE_CHECKING:
    from toolkit.cli.arguments import Subcommands
    from toolkit.report.bundle import BundleRecord
    from toolkit.report.differences import Differences

_MOST_PACKAGES = 12


def add_to(subcommands: Subcommands) -> None:
    """Add the subcommand."""
    parser = subcommands.add_parser(
        "reproduce",
        help="run what is in a bundle again and tell what differs",
        description="Run again, with the settings in a bundle that vislam export --bundle made, and tell what differs: "
        "versions, data, how runs ended, metrics. Exits 1 where a result but time and memory is another one.",
        epilog=epilog(
            "vislam compare drive --estimators dead-reckoning --max-frames 40 --out runs/drive",
            "vislam export runs/drive --bundle drive.zip",
            "vislam reproduce drive.zip",
        ),
    )
    parser.add_argument("bundle", metavar="BUNDLE", type=Path, help="as vislam export --bundle writes it")
    parser.add_argument("--data", metavar="SEQUENCE", help="where the recording is here, if not where it was there")
    parser.add_argument("--out", metavar="DIR", type=Path, help="keep the new run directory (default: it is not kept)")
    what = parser.add_mutually_exclusive_group()
    what.add_argument("--json", action="store_true", help="print every difference as JSON, and nothing else")
    what.add_argument("--quiet", action="store_true", help="print nothing; the exit status tells")
    add_workers_argument(parser)
    parser.set_defaults(command=command)


def command(options: argparse.Namespace) -> int:
    """Repeat, compare and return 1 where a result is another one."""
    import tempfile

    from toolkit.documents import to_text
    from toolkit.report.bundle import unpack_bundle
    from toolkit.report.diff_text import diff_document
    from toolkit.report.differences import differences
    from toolkit.report.run_files import read_run

    with tempfile.TemporaryDirectory(prefix="vislam-") as folder:
        there = Path(folder) / "there"
        record = unpack_bundle(options.bundle, there)
        before = read_run(there)
        out = Path(folder) / "here" if options.out is None else options.out
        _run_again(there, out, options)
        found = replace(differences(before, read_run(out)), names=(str(options.bundle), str(out)))
    if options.json:
        print(to_text(diff_document(found)), end="")
    elif not options.quiet:
        _print(found, record, options)
    return 0 if found.same_results else 1


def _run_again(there: Path, out: Path, options: argparse.Namespace) -> None:
    """Do what vislam compare does with the bundle's manifest; what it prints is not of interest here."""
    from toolkit.cli import parser
    from toolkit.report.run_directory import MANIFEST

    sequence = [] if options.data is None else [options.data]
    workers = [] if options.workers is None else ["--workers", str(options.workers)]
    words = ["compare", *sequence, "--config", str(there / MANIFEST), "--out", str(out), *workers]
    asked = parser().parse_args(words)
    asked.command_line = ["vislam", *words]
    with ExitStack() as stack:
        nowhere = stack.enter_context(open(os.devnull, "w", encoding="utf-8"))  # noqa: PTH123
        stack.enter_context(redirect_stdout(nowhere))
        asked.command(asked)


def _print(found: Differences, record: BundleRecord, options: argparse.Namespace) -> None:
    from toolkit.report.bundle import installed_packages
    from toolkit.report.diff_text import diff_text
    from toolkit.report.prose import width_of_output

    here = installed_packages()
    others = [f"{name} {release}" for name, release in record.packages.items() if here.get(name) != release]
    print(diff_text(found, width=width_of_output()))
    if others:
        more = f" and {len(others) - _MOST_PACKAGES} more" if len(others) > _MOST_PACKAGES else ""
        print(printable(f"not installed here in the bundle's release: {', '.join(others[:_MOST_PACKAGES])}{more}"))
    verdict = "reproduced" if found.same_results else "not reproduced: what differs is above"
    print(printable(f"{options.bundle}: {verdict}"))
