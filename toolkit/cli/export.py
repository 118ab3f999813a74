"""``vislam export``: a trajectory of a run directory in another program's format, or the whole run as one file."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from toolkit.cli.arguments import UsageError, epilog
from toolkit.errors import printable

if TYPE_CHECKING:
    from toolkit.cli.arguments import Subcommands

# Repeated from toolkit.datasets.trajectories.FORMATS (a test compares them), which would cost the help half a second.
FORMATS = ("tum", "kitti", "euroc", "openvins")


def add_to(subcommands: Subcommands) -> None:
    """Add the subcommand."""
    parser = subcommands.add_parser(
        "export",
        help="write a trajectory of a run directory in another program's format, or a bundle",
        description="Write a trajectory of a run directory as a TUM, KITTI, EuRoC or OpenVINS file. Poses are those "
        "of the IMU in the estimator's world; nothing is aligned. Or bundle what others need to repeat the run.",
        epilog=epilog(
            "vislam compare drive --estimators dead-reckoning --max-frames 40 --out runs/drive",
            "vislam export runs/drive --format kitti --out drive.kitti",
            "vislam export runs/drive --bundle drive.zip",
        ),
    )
    parser.add_argument("run", metavar="RUN_DIR", type=Path, help="as vislam compare writes it")
    parser.add_argument("--estimator", metavar="NAME", help="whose, or truth (default: the only one there is)")
    parser.add_argument("--output", choices=("causal", "final"), help="default: final, where there is one")
    parser.add_argument("--format", choices=FORMATS, help="of the file; KITTI has no stamps")
    parser.add_argument("--out", metavar="FILE", type=Path, help="the file to write")
    parser.add_argument(
        "--bundle",
        metavar="FILE.zip",
        type=Path,
        help="write settings, versions, hashes, trajectories and metrics of the run as one file for vislam reproduce",
    )
    parser.set_defaults(command=command)


def command(options: argparse.Namespace) -> int:
    """Write the file and say what is in it."""
    if options.bundle is not None:
        return _bundle(options)
    if options.format is None or options.out is None:
        raise UsageError("give --format and --out for a trajectory, or --bundle (see vislam export --help)")
    from toolkit.report.export import export

    written = export(options.run, options.estimator, options.output, options.format, options.out)
    print(printable(f"{options.out}: {written}"))
    return 0


def _bundle(options: argparse.Namespace) -> int:
    from toolkit.report.bundle import write_bundle

    if options.format or options.out or options.estimator or options.output:
        raise UsageError("--bundle goes without --format, --out, --estimator and --output: it has everything")
    written = write_bundle(options.run, options.bundle)
    print(printable(f"{options.bundle}: {written}"))
    return 0
