"""``vislam check-data``, ``card``, ``tracks``, ``simulate`` and ``import``: look at a recording, or make one."""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from toolkit.cli.arguments import (
    RECORDING,
    SETTINGS,
    TOPICS,
    Group,
    UsageError,
    arg,
    at_least,
    choice,
    command,
    flag,
    number_within,
    positive_seconds,
    requested_recording,
    requested_settings,
)
from toolkit.errors import printable

if TYPE_CHECKING:
    from toolkit.frontend import ImageTracks
    from toolkit.simulation import Scenario

# Repeated from toolkit.simulation.SCENARIOS (a test compares them), which would cost the help half a second.
SCENARIOS = ("drive", "drive-imu", "flight", "drive-realistic", "flight-realistic")
_LONGEST_EXPOSURE_MS = 40
# Of more pairs is said, before they are made, how much room they take.
_MANY_PAIRS = 1000
_MOST_STILLS, _MOST_CRATES = 10_000, 1000
_ONLY_WITH_IMAGES = ("lens", "blur", "moving")


@command(
    "check-data",
    "find the faults of a recording",
    arg("--truth FILE.tum", "ground truth, to check that the two overlap", Path),
    *RECORDING,
    examples=("vislam check-data drive",),
)
def check_data(options: argparse.Namespace) -> int:
    """Find the faults of a recording from its data alone and say which of them are repaired when it is used. Fails
    on a fault that is not repaired.
    """
    from toolkit.cli.progress_display import of_this_process
    from toolkit.experiment.recording import audited_recording
    from toolkit.report.card import audit_text
    from toolkit.report.text import width_of_output

    recording = replace(requested_recording(options), truth=options.truth)
    with of_this_process()(options.sequence) as progress:
        audited = audited_recording(recording, progress)
    print(audit_text(audited, width_of_output()))
    return 1 if any(finding.blocking for finding in audited.findings) else 0


@command(
    "card",
    "describe the tracks of a recording: length, errors, depths",
    arg("--json FILE", "write the card as JSON, too (see docs/tracks.md)", Path),
    arg("--max-frames N", "use the first N frames only", at_least(2)),
    *RECORDING,
    examples=("vislam card drive-realistic --max-frames 60",),
)
def card(options: argparse.Namespace) -> int:
    """Fit the noise of a recording's tracks and say what they are like: how errors along a track are correlated,
    how many are at odds with the motion, how vision's scale compares with the measured motion. No truth is used.
    """
    from toolkit.cli.progress_display import of_this_process
    from toolkit.experiment.recording import recording_card
    from toolkit.files.documents import to_text
    from toolkit.files.writing import check_writable, write_text
    from toolkit.report.card import card_record, card_text
    from toolkit.report.text import width_of_output

    if options.json is not None:
        check_writable(options.json, "{")
    recording = replace(requested_recording(options), max_frames=options.max_frames)
    with of_this_process()(options.sequence) as progress:
        sequence, card = recording_card(recording, progress)
    if options.json is not None:  # before a reader of the output can have gone away
        write_text(options.json, to_text(card_record(card)))
    print(card_text(sequence, card, width_of_output()))
    return 0


@command(
    "tracks",
    "draw stereo tracks over the images they were made of",
    arg("images FOLDER|BAG", "a folder with images, as EuRoC's or KITTI's, or a bag"),
    TOPICS,
    arg("--out DIR", "directory of the stills", Path, required=True),
    Group(
        (
            arg("--count N", "how many stills", at_least(1, _MOST_STILLS), default=10),
            flag("--video", "a video of every frame instead of stills"),
        )
    ),
    *SETTINGS,
    examples=("vislam tracks kitti/sequences/06 --out stills --count 4",),
)
def tracks(options: argparse.Namespace) -> int:
    """Make the stereo tracks of a folder of images, as compare does, and write stills of them: left and right image
    side by side, a circle a track, blue where it is new, red where it is old.
    """
    from toolkit.cli.progress_display import of_this_process
    from toolkit.datasets import load_images
    from toolkit.files.writing import check_parent
    from toolkit.frontend.stills import write_stills, write_video

    frontend = requested_settings(options).frontend
    check_parent(options.out.parent)
    recording = load_images(options.images, frontend)
    with of_this_process()(options.images) as progress:
        tracks = recording.tracks(frontend, progress)
        written = (recording, tracks, options.out)
        names = write_video(*written, progress) if options.video else write_stills(*written, options.count, progress)
    print(f"{printable(options.images)}: {_summary(tracks)}")
    for skipped in tracks.skipped:
        print(f"left out: {printable(skipped)}")
    print(f"{printable(str(options.out))}: {', '.join(names)}")
    return 0


def _summary(tracks: ImageTracks) -> str:
    import numpy as np

    a_frame = np.bincount(tracks.frame, minlength=tracks.t_ns.size)
    lives = np.unique(tracks.track_id, return_counts=True)[1]
    alive = f", seen in {np.median(lives):.0f} frames in the median" if lives.size else ""
    return f"{tracks.t_ns.size} pairs, {a_frame.mean():.0f} tracks a frame ({a_frame.min()} at least){alive}"


@command(
    "simulate",
    "write a simulated recording",
    choice("scenario", SCENARIOS, "scenario: the vehicle and its path"),
    arg("--out DIR", "directory of the recording", Path, required=True),
    arg("--seed N", "seed of every error", at_least(0), default=0),
    arg("--duration S", "seconds (default: the scenario's)", positive_seconds),
    Group(
        (
            flag("--images", "render the images of a stereo pair (flight)"),
            choice("--lens", ("none", "radtan", "equidistant"), "distortion of the cameras (default: none, rectified)"),
            arg("--blur MS", "exposure (default: 0)", number_within("milliseconds", 0, _LONGEST_EXPOSURE_MS)),
            arg("--moving N", "moving crates (default: 0)", at_least(0, _MOST_CRATES)),
        ),
        "images",
    ),
    examples=(
        "vislam simulate drive --out recordings/drive-seed-1 --seed 1 --duration 5",
        "vislam simulate flight --images --lens radtan --out recordings/filmed --duration 0.5",
    ),
)
def simulate(options: argparse.Namespace) -> int:
    """Write a simulated recording with exact truth; the same seed gives the same bits. With --images it is a folder
    of stereo images in EuRoC's layout, 0.4 MB a pair.
    """
    from toolkit.datasets import vislam_recording
    from toolkit.simulation import SCENARIOS as KNOWN
    from toolkit.simulation import simulate

    scenario = KNOWN[options.scenario]
    if options.duration is not None:
        scenario = replace(scenario, duration_s=options.duration)
    if options.images:
        return _film(scenario, options)
    if asked := [name for name in _ONLY_WITH_IMAGES if getattr(options, name) is not None]:
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
    from toolkit.cli.progress_display import of_this_process
    from toolkit.simulation.filming import Filming, check_filmable, film, pair_count, size_gb

    check_filmable(scenario, options.out)
    if (pairs := pair_count(scenario)) > _MANY_PAIRS:
        print(f"{printable(str(options.out))}: {pairs} stereo pairs, about {size_gb(scenario):.2g} GB", file=sys.stderr)
    filming = Filming(options.lens or "none", (options.blur or 0.0) / 1000.0, options.moving or 0)
    with of_this_process()(str(options.out)) as progress:
        sequence = film(scenario, options.seed, options.out, filming, progress)
    print(
        f"{printable(str(options.out))}: {sequence.frame_count} stereo pairs, {sequence.duration_s:.1f} s, "
        f"{sequence.motion_kind}, seed {options.seed}"
    )
    return 0


@command(
    "import",
    "make a recording of your own tables",
    arg("--tracks FILE.csv", "t, track_id, uL, uR and v, or vL and vR", Path, required=True),
    arg("--motion FILE.csv", "t and ax ... gz of an IMU, or vx ... wz of the body", Path, required=True),
    arg("--rig FILE.toml", "calibration of the rectified pair, and noise", Path, required=True),
    arg("--truth FILE.tum", "ground truth", Path),
    arg("--out DIR", "directory of the recording", Path, required=True),
    examples=("vislam import --tracks tracks.csv --motion twist.csv --rig rig.toml --truth truth.tum --out own",),
)
def import_tables(options: argparse.Namespace) -> int:
    """Make a recording of stereo tracks, IMU samples or body velocities, and a calibration in tables of your own.
    Their columns, units and axes are in docs/own-data.md.
    """
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
