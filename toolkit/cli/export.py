"""``vislam export``: a trajectory of a run directory in another program's format."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from toolkit.cli.arguments import epilog
from toolkit.errors import printable

if TYPE_CHECKING:
    from toolkit.cli.arguments import Subcommands

# Repeated from toolkit.datasets.trajectories.FORMATS (a test compares them), which would cost the help half a second.
FORMATS = ("tum", "kitti", "euroc", "openvins")


def add_to(subcommands: Subcommands) -> None:
    """Add the subcommand."""
    parser = subcommands.add_parser(
        "export",
        help="write a trajectory of a run directory in another program's format",
        description="Write a trajectory of a run directory as a TUM, KITTI, EuRoC or OpenVINS file. Poses are those "
        "of the IMU in the estimator's world; nothing is aligned.",
        epilog=epilog(
            "vislam compare drive --estimators dead-reckoning --max-frames 40 --out runs/drive",
            "vislam export runs/drive --format kitti --out drive.kitti",
        ),
    )
    parser.add_argument("run", metavar="RUN_DIR", type=Path, help="as vislam compare writes it")
    parser.add_argument("--estimator", metavar="NAME", help="whose, or truth (default: the only one there is)")
    parser.add_argument("--output", choices=("causal", "final"), help="default: final, where there is one")
    parser.add_argument("--format", choices=FORMATS, required=True, help="of the file; KITTI has no stamps")
    parser.add_argument("--out", metavar="FILE", type=Path, required=True, help="the file to write")
    parser.set_defaults(command=command)


def command(options: argparse.Namespace) -> int:
    """Write the file and say what is in it."""
    from toolkit.report.export import export

    written = export(options.run, options.estimator, options.output, options.format, options.out)
    print(printable(f"{options.out}: {written}"))
    return 0
