"""``vislam simulate``: write a simulated recording with exact truth, as tracks or as images."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from toolkit.cli.arguments import UsageError, at_least, epilog, positive_seconds
from toolkit.errors import printable

if TYPE_CHECKING:
    from toolkit.cli.arguments import Subcommands
    from toolkit.simulation import Scenario

# Repeated from toolkit.simulation.SCENARIOS (a test compares them), which would cost the help half a second.
SCENARIOS = ("drive", "drive-imu", "flight", "drive-realistic", "flight-realistic")
LENSES = ("none", "radtan", "equidistant")
_LONGEST_EXPOSURE_MS = 40
_ONLY_WITH_IMAGES = ("lens", "blur", "moving")


def _exposure_ms(text: str) -> float:
    """Parse an exposure that ends before the next one begins."""
    try:
        value = float(text)
    except ValueError:
        value = -1.0
    if not 0.0 <= value <= _LONGEST_EXPOSURE_MS:
        raise argparse.ArgumentTypeError(f"expected milliseconds from 0 to {_LONGEST_EXPOSURE_MS}, not {text!r}")
    return value


def add_to(subcommands: Subcommands) -> None:
    """Add the subcommand."""
    parser = subcommands.add_parser(
        "simulate",
        help="write a simulated recording",
        description="Write a simulated recording with exact truth; the same seed gives the same bits. With --images "
        "it is a folder of stereo images in EuRoC's layout, 0.4 MB a pair.",
        epilog=epilog(
            "vislam simulate drive --out recordings/drive-seed-1 --seed 1 --duration 5",
            "vislam simulate flight --images --lens radtan --out recordings/filmed --duration 0.5",
        ),
    )
    parser.add_argument("scenario", choices=SCENARIOS, help="what moves, and where")
    parser.add_argument("--out", metavar="DIR", type=Path, required=True, help="directory of the recording")
    parser.add_argument("--seed", metavar="N", type=at_least(0), default=0, help="draws every error (default: 0)")
    parser.add_argument("--duration", metavar="S", type=positive_seconds, help="seconds (default: the scenario's)")
    images = parser.add_argument_group("images")
    images.add_argument("--images", action="store_true", help="render the images of a stereo pair (flight)")
    images.add_argument(
        "--lens", choices=LENSES, help="the distortion of both cameras, mounted askew then (default: none, rectified)"
    )
    images.add_argument("--blur", metavar="MS", type=_exposure_ms, help="milliseconds of exposure (default: 0)")
    images.add_argument("--moving", metavar="N", type=at_least(0), help="crates that fly about (default: 0)")
    parser.set_defaults(command=command)


def command(options: argparse.Namespace) -> int:
    """Simulate, save, and say what was written."""
    from dataclasses import replace

    from toolkit.datasets import vislam_recording
    from toolkit.simulation import SCENARIOS as KNOWN
    from toolkit.simulation import simulate

    scenario = KNOWN[options.scenario]
    if options.duration is not None:
        scenario = replace(scenario, duration_s=options.duration)
    asked = [name for name in _ONLY_WITH_IMAGES if getattr(options, name) is not None]
    if options.images:
        return _film(scenario, options)
    if asked:
        raise UsageError(f"--{asked[0]} is of images; add --images")
    vislam_recording.check_folder(options.out)
    sequence = simulate(scenario, options.seed)
    vislam_recording.save(sequence, options.out)
    print(
        f"{printable(str(options.out))}: {sequence.frame_count} frames, {sequence.duration_s:.1f} s, "
        f"{len(sequence.observations)} stereo observations, {sequence.motion_kind}, seed {options.seed}"
    )
    return 0


def _film(scenario: Scenario, options: argparse.Namespace) -> int:
    """Render the images, with the time that is left, and say what was written."""
    from toolkit.progress import of_this_process
    from toolkit.simulation.filming import Filming, film

    filming = Filming(options.lens or "none", (options.blur or 0.0) / 1000.0, options.moving or 0)
    with of_this_process()(str(options.out)) as progress:
        sequence = film(scenario, options.seed, options.out, filming, progress)
    print(
        f"{printable(str(options.out))}: {sequence.frame_count} stereo pairs, {sequence.duration_s:.1f} s, "
        f"{sequence.motion_kind}, seed {options.seed}"
    )
    return 0
