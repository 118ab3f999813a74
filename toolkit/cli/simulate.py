"""``vislam simulate``: write a simulated recording with exact truth."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from toolkit.cli.arguments import at_least, epilog, positive_seconds
from toolkit.errors import printable

if TYPE_CHECKING:
    from toolkit.cli.arguments import Subcommands

# Repeated from toolkit.simulation.SCENARIOS (a test compares them), which would cost the help half a second.
SCENARIOS = ("drive", "drive-imu", "flight", "drive-realistic", "flight-realistic")


def add_to(subcommands: Subcommands) -> None:
    """Add the subcommand."""
    parser = subcommands.add_parser(
        "simulate",
        help="write a simulated recording",
        description="Write a simulated recording with exact truth; the same seed gives the same bits.",
        epilog=epilog("vislam simulate drive --out recordings/drive-seed-1 --seed 1 --duration 5"),
    )
    parser.add_argument("scenario", choices=SCENARIOS, help="what moves, and where")
    parser.add_argument("--out", metavar="DIR", type=Path, required=True, help="directory of the recording")
    parser.add_argument("--seed", metavar="N", type=at_least(0), default=0, help="draws every error (default: 0)")
    parser.add_argument("--duration", metavar="S", type=positive_seconds, help="seconds (default: the scenario's)")
    parser.set_defaults(command=command)


def command(options: argparse.Namespace) -> int:
    """Simulate, save, and say what was written."""
    from dataclasses import replace

    from toolkit.datasets import vislam_recording
    from toolkit.simulation import SCENARIOS as KNOWN
    from toolkit.simulation import simulate

    vislam_recording.check_folder(options.out)
    scenario = KNOWN[options.scenario]
    if options.duration is not None:
        scenario = replace(scenario, duration_s=options.duration)
    sequence = simulate(scenario, options.seed)
    vislam_recording.save(sequence, options.out)
    print(
        f"{printable(str(options.out))}: {sequence.frame_count} frames, {sequence.duration_s:.1f} s, "
        f"{len(sequence.observations)} stereo observations, {sequence.motion_kind}, seed {options.seed}"
    )
    return 0
