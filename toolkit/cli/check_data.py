"""``vislam check-data``: what is wrong with a recording, and what of it is repaired."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from toolkit.cli.arguments import add_repair_arguments, add_tracks_argument, at_least, epilog, recording_asked

if TYPE_CHECKING:
    from toolkit.cli.arguments import Subcommands


def add_to(subcommands: Subcommands) -> None:
    """Add the subcommand."""
    parser = subcommands.add_parser(
        "check-data",
        help="find the faults of a recording",
        description="Find the faults of a recording from its data alone and say which of them are repaired when it "
        "is used. Fails on a fault that is not repaired.",
        epilog=epilog("vislam check-data drive"),
    )
    parser.add_argument("sequence", metavar="SEQUENCE", help="a recording's path, or a built-in name")
    parser.add_argument("--truth", metavar="FILE.tum", type=Path, help="ground truth, to check that the two overlap")
    add_repair_arguments(parser)
    add_tracks_argument(parser)
    parser.add_argument("--seed", metavar="N", type=at_least(0), default=0, help="of a simulated sequence (default: 0)")
    parser.set_defaults(command=command)


def command(options: argparse.Namespace) -> int:
    """Print the audit and return 1 where a fault stays that must not."""
    from toolkit.experiment.recording import audited_recording
    from toolkit.progress import of_this_process
    from toolkit.report.prose import width_of_output
    from toolkit.report.terminal import audit_text

    recording = replace(recording_asked(options), truth=options.truth)
    with of_this_process()(options.sequence) as progress:
        audited = audited_recording(recording, progress)
    print(audit_text(audited, width_of_output()))
    return 1 if any(finding.blocking for finding in audited.findings) else 0
