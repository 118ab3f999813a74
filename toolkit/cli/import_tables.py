"""``vislam import``: a recording of your own tables."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from toolkit.cli.arguments import epilog
from toolkit.errors import printable

if TYPE_CHECKING:
    from toolkit.cli.arguments import Subcommands


def add_to(subcommands: Subcommands) -> None:
    """Add the subcommand."""
    parser = subcommands.add_parser(
        "import",
        help="make a recording of your own tables",
        description="Make a recording of stereo tracks, IMU samples or body velocities, and a calibration in tables of "
        "your own. Their columns, units and axes are in docs/own-data.md.",
        epilog=epilog(
            "vislam import --tracks tracks.csv --motion twist.csv --rig rig.toml --truth truth.tum --out recordings/own"
        ),
    )
    parser.add_argument(
        "--tracks", metavar="FILE.csv", type=Path, required=True, help="t, track_id, uL, uR and v, or vL and vR"
    )
    parser.add_argument(
        "--motion",
        metavar="FILE.csv",
        type=Path,
        required=True,
        help="t and ax, ay, az, gx, gy, gz of an IMU, or vx, vy, vz, wx, wy, wz of the body",
    )
    parser.add_argument(
        "--rig", metavar="FILE.toml", type=Path, required=True, help="calibration of the rectified pair, and noise"
    )
    parser.add_argument("--truth", metavar="FILE.tum", type=Path, help="ground truth")
    parser.add_argument("--out", metavar="DIR", type=Path, required=True, help="directory of the recording")
    parser.set_defaults(command=command)


def command(options: argparse.Namespace) -> int:
    """Read, save, and say what was written."""
    from toolkit.datasets import own_tables, vislam_recording

    vislam_recording.check_folder(options.out)
    read = own_tables.read(options.out.resolve().name, options.tracks, options.motion, options.rig, options.truth)
    vislam_recording.save(read.sequence, options.out)
    sequence = read.sequence
    truth = "no truth" if sequence.truth is None else f"truth of {sequence.truth.t_ns.size} poses"
    print(
        f"{printable(str(options.out))}: {sequence.frame_count} frames, {sequence.duration_s:.1f} s, "
        f"{len(sequence.observations)} stereo observations, {sequence.motion_kind}, {truth}"
    )
    for name in read.unused:
        print(f"not used: {printable(name)}")
    return 0
