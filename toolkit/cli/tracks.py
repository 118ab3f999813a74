"""``vislam tracks``: stills of the stereo tracks over the images they were made of."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from toolkit.cli.arguments import add_settings_arguments, add_topics_argument, at_least, epilog, settings_asked
from toolkit.errors import printable

if TYPE_CHECKING:
    from toolkit.cli.arguments import Subcommands
    from toolkit.frontend import ImageTracks


def add_to(subcommands: Subcommands) -> None:
    """Add the subcommand."""
    parser = subcommands.add_parser(
        "tracks",
        help="draw stereo tracks over the images they were made of",
        description="Make the stereo tracks of a folder of images, as compare does, and write stills of them: left "
        "and right image side by side, a circle a track, blue where it is new, red where it is old.",
        epilog=epilog("vislam tracks kitti/sequences/06 --out stills --count 4"),
    )
    parser.add_argument("images", metavar="FOLDER|BAG", help="a folder with images, as EuRoC's or KITTI's, or a bag")
    parser.add_argument("--out", metavar="DIR", type=Path, required=True, help="directory of the stills")
    what = parser.add_mutually_exclusive_group()
    what.add_argument("--count", metavar="N", type=at_least(1), default=10, help="how many stills (default: 10)")
    what.add_argument("--video", action="store_true", help="a video of every frame instead of stills")
    add_topics_argument(parser)
    add_settings_arguments(parser)
    parser.set_defaults(command=command)


def command(options: argparse.Namespace) -> int:
    """Track, draw, and say what was written."""
    import msgspec

    from toolkit.datasets import load_images
    from toolkit.files import check_parent
    from toolkit.frontend import track_images
    from toolkit.frontend.stills import write_stills, write_video
    from toolkit.progress import of_this_process

    frontend = settings_asked(options).frontend
    if options.topics is not None:
        frontend = msgspec.structs.replace(frontend, topics=options.topics)
    check_parent(options.out.parent)
    recording = load_images(options.images, frontend)
    with of_this_process()(options.images) as progress:
        tracks = track_images(recording.pairs, recording.rig, frontend, progress)
        if options.video:
            names = write_video(recording, tracks, options.out, progress)
        else:
            names = write_stills(recording, tracks, options.out, options.count, progress)
    print(f"{printable(options.images)}: {_summary(tracks)}")
    for skipped in tracks.skipped:
        print(f"left out: {printable(skipped)}")
    print(f"{printable(str(options.out))}: {', '.join(names)}")
    return 0


def _summary(tracks: ImageTracks) -> str:
    """Return the tracks in one line: how many a frame, and how long they live."""
    import numpy as np

    a_frame = np.bincount(tracks.frame, minlength=tracks.t_ns.size)
    lives = np.unique(tracks.track_id, return_counts=True)[1]
    alive = f", seen in {np.median(lives):.0f} frames in the median" if lives.size else ""
    return f"{tracks.t_ns.size} pairs, {a_frame.mean():.0f} tracks a frame ({a_frame.min()} at least){alive}"
