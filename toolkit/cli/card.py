"""``vislam card``: what the tracks of a recording are like, and so why a smoother wins on it or does not."""

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
        "card",
        help="say what the tracks of a recording are like",
        description="Fit the noise of a recording's tracks and say what they are like: how errors along a track "
        "are correlated, how many are at odds with the motion, how vision's scale compares with the measured motion. "
        "No truth is used.",
        epilog=epilog("vislam card drive-realistic --max-frames 60"),
    )
    parser.add_argument("sequence", metavar="SEQUENCE", help="a recording's path, or a built-in name")
    parser.add_argument("--json", metavar="FILE", type=Path, help="write the card as JSON, too (see docs/tracks.md)")
    parser.add_argument("--max-frames", metavar="N", type=at_least(2), help="use the first N frames only")
    add_repair_arguments(parser)
    add_tracks_argument(parser)
    parser.add_argument("--seed", metavar="N", type=at_least(0), default=0, help="of a simulated sequence (default: 0)")
    parser.set_defaults(command=command)


def command(options: argparse.Namespace) -> int:
    """Print the card and return 0."""
    from toolkit.documents import to_text
    from toolkit.experiment.recording import recording_card
    from toolkit.files import check_writable, write_text
    from toolkit.progress import of_this_process
    from toolkit.report.card import card_record, card_text
    from toolkit.report.prose import width_of_output

    if options.json is not None:
        check_writable(options.json)
    recording = replace(recording_asked(options), max_frames=options.max_frames)
    with of_this_process()(options.sequence) as progress:
        sequence, card = recording_card(recording, progress)
    if options.json is not None:  # before a reader of the output can have gone away
        write_text(options.json, to_text(card_record(card)))
    print(card_text(sequence, card, width_of_output()))
    return 0
