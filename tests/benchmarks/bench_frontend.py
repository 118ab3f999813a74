"""Time of the front end on a pair of images, over that of the bare OpenCV calls it makes, both in the same run.

Not part of the test run. For each pair the front end reads, decodes, rectifies and tracks; a second one, which does
the same, writes down every call to OpenCV with its arguments, and these calls are then made again with nothing between
them. The two are timed in turns, pair by pair and which comes first in turns too, so that a busy machine slows both.
The images are those of a recording, or of a few rendered seconds where none is named.

    python tests/benchmarks/bench_frontend.py [FOLDER]
    python -m pytest -s tests/benchmarks/bench_frontend.py
"""

# ruff: noqa: E402 - the number of threads must be set before NumPy is imported
import os

for _threads in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_threads, "1")

import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from toolkit.datasets import load_images
from toolkit.frontend import ImageRecording
from toolkit.frontend.images import StampedPair, Unusable
from toolkit.frontend.tracker import Tracker
from toolkit.frontend.tracking import read_pair
from toolkit.settings import Frontend
from toolkit.simulation import FLIGHT
from toolkit.simulation.filming import Filming, film

BITS = 8
# The first pair begins all tracks, the second has no motion yet: they are not what a frame costs.
WARM_UP = 2
MOST_PAIRS = 160
TRACKS = (100, 200)
Call = tuple[Callable[..., Any], tuple[Any, ...], dict[str, Any]]


@contextmanager
def calls_written_down() -> Iterator[list[Call]]:
    """Write down the calls to OpenCV made in the block; arrays are copied, for some calls write into theirs."""
    calls: list[Call] = []
    own = {name: value for name, value in vars(cv2).items() if type(value) is type(cv2.remap)}

    def listening(function: Callable[..., Any]) -> Callable[..., Any]:
        def call(*arguments: Any, **options: Any) -> Any:
            kept = tuple(np.copy(x) if isinstance(x, np.ndarray) else x for x in arguments)
            calls.append((function, kept, options))
            return function(*arguments, **options)

        return call

    try:
        for name, function in own.items():
            setattr(cv2, name, listening(function))
        yield calls
    finally:
        for name, function in own.items():
            setattr(cv2, name, function)


def seconds(work: Callable[[], Any]) -> float:
    """Return the CPU time of some work."""
    began = time.process_time()
    work()
    return time.process_time() - began


def step(tracker: Tracker, recording: ImageRecording, pair: StampedPair) -> None:
    """Read, decode, rectify and track a pair."""
    images = read_pair(pair, recording.rig, BITS)
    assert not isinstance(images, Unusable), images
    tracker.step(*images)


def bare(calls: list[Call]) -> None:
    """Make the calls again."""
    for function, arguments, options in calls:
        function(*arguments, **options)


def measure(recording: ImageRecording, max_tracks: int) -> None:
    """Print the times of a pair and their ratio, with the standard error of the ratio over the pairs."""
    settings = Frontend(max_tracks=max_tracks)
    timed, listened = Tracker(recording.rig, settings), Tracker(recording.rig, settings)
    times = []
    for k, pair in enumerate(recording.pairs[:MOST_PAIRS]):
        with calls_written_down() as calls:
            step(listened, recording, pair)
        runs: list[Callable[[], None]] = [lambda: step(timed, recording, pair), lambda: bare(calls)]  # noqa: B023
        spent = [seconds(run) for run in (runs if k % 2 else runs[::-1])]
        times.append(spent if k % 2 else spent[::-1])
    whole, alone = 1e3 * np.array(times[WARM_UP:]).T
    ratio = whole.sum() / alone.sum()
    error = np.std(whole - ratio * alone, ddof=1) / np.sqrt(alone.size) / alone.mean()
    print(
        f"{max_tracks} tracks: {whole.mean():.1f} ms a pair, OpenCV alone {alone.mean():.1f} ms, "
        f"ratio {ratio:.3f} +- {error:.3f} over {alone.size} pairs"
    )


def main(folder: str | None) -> None:
    """Measure on a folder, or on a flight rendered for it."""
    cv2.setNumThreads(1)
    with tempfile.TemporaryDirectory() as directory:
        if folder is None:
            folder = str(Path(directory) / "flight")
            film(replace(FLIGHT, duration_s=3.0), 0, Path(folder), Filming("radtan"))
        recording = load_images(folder)
        print(f"{folder}: {len(recording.pairs)} pairs of {recording.rig.size_px[0]}x{recording.rig.size_px[1]} px")
        for max_tracks in TRACKS:
            measure(recording, max_tracks)


def test_times_are_printed() -> None:
    """Only printed: a benchmark asserts nothing about time."""
    main(None)


if __name__ == "__main__":
    main(sys.argv[1] if len(sys.argv) > 1 else None)
