"""How time and memory grow as tracks, frames, the window or the landmarks of the state double, with fitted exponents.

Not part of the test run: absolute times belong to a machine. An exponent is the slope of a line through the
logarithms of processor time, in all (frames) or a frame (all else). Memory is what a run takes above one of two frames.

    python tests/benchmarks/bench_growth.py [tracks] [frames] [window] [landmarks]
"""

# ruff: noqa: E402 - the number of threads must be set before NumPy is imported
import os

for _threads in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_threads, "1")

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import msgspec
import numpy as np

from toolkit import runner
from toolkit.registry import find
from toolkit.sequence import Sequence as Recorded
from toolkit.settings import DEFAULTS, Settings
from toolkit.simulation import DRIVE_IMU, simulate
from toolkit.simulation.scenes import Scene, SceneOf, road

FILTERS = ("ekf", "riekf", "msckf-fej", "msckf-slam")
SMOOTHERS = ("fixed-lag", "isam2", "batch")


@dataclass(frozen=True)
class Growth:
    """What doubles: the values it takes, whose cost is measured, and the recording and settings at a value."""

    values: tuple[float, ...]
    estimators: tuple[str, ...]
    at: Callable[[float], tuple[Recorded, Settings]]
    per_frame: bool


def recording(tracks: int = 100, frames: int = 80, scene: SceneOf = road) -> Recorded:
    """Return a simulated drive with an IMU, so many tracks in view at a time."""
    camera = replace(DRIVE_IMU.camera, max_tracks=tracks)
    return simulate(replace(DRIVE_IMU, scene=scene, camera=camera, duration_s=frames / camera.rate_hz), 0)


def crowded_road(duration_s: float, drawn: np.random.Generator | None = None) -> Scene:
    """Return the drive's scene with eight landmarks in the place of each: more than 800 are in view."""
    scene, rng = road(duration_s, drawn), np.random.default_rng(0)
    beside = [scene.points + rng.normal(0.0, 0.5, scene.points.shape) for _ in range(7)]
    return replace(scene, points=np.concatenate([scene.points, *beside]))


def with_window(**changed: float) -> Settings:
    """Return the default settings but for those of the window; its cap on states does not bind."""
    window = msgspec.structs.replace(DEFAULTS.window, most_states=200, **changed)
    return msgspec.structs.replace(DEFAULTS, window=window)


GROWTHS = {
    "tracks": Growth(
        (50, 100, 200, 400, 800),
        (*FILTERS, "fixed-lag"),
        lambda n: (recording(tracks=int(n), scene=crowded_road), DEFAULTS),
        per_frame=True,
    ),
    "frames": Growth(
        (200, 400, 800, 1600, 3200),
        (*FILTERS, *SMOOTHERS),
        lambda n: (recording(frames=int(n)), DEFAULTS),
        per_frame=False,
    ),
    "window": Growth(
        (0.5, 1.0, 2.0, 4.0),
        ("msckf-fej", "msckf-slam", "fixed-lag"),
        lambda s: (recording(frames=100), with_window(lag_s=s)),
        per_frame=True,
    ),
    "landmarks": Growth(
        (25, 50, 100, 200),
        ("msckf-slam",),
        lambda n: (recording(tracks=200), with_window(landmarks=int(n))),
        per_frame=True,
    ),
}


def exponent(values: Sequence[float], costs: Sequence[float]) -> float:
    """Return the slope of log cost over log value."""
    return float(np.polyfit(np.log(values), np.log(costs), 1)[0])


def measure(name: str) -> None:
    """Print a line for each estimator: its cost at each value and the exponents."""
    growth = GROWTHS[name]
    unit = "CPU ms a frame" if growth.per_frame else "CPU s"
    print(f"{name}: {', '.join(f'{v:g}' for v in growth.values)} ({unit} | MB above a run of two frames)", flush=True)
    made = [growth.at(value) for value in growth.values]
    for estimator in growth.estimators:
        build, costs, memory = find(estimator).load(), [], []
        for sequence, settings in made:
            assert sequence.prior is not None
            least = runner.run(estimator, build, sequence.truncated(2), sequence.prior, settings=settings).timings
            timed = runner.run(estimator, build, sequence, sequence.prior, settings=settings).timings
            assert least is not None and timed is not None
            scale = 1e3 / sequence.frame_count if growth.per_frame else 1.0
            costs.append(scale * timed.cpu_s)
            memory.append(max((timed.peak_rss_mb or 0.0) - (least.peak_rss_mb or 0.0), 0.0))
        reported = "  ".join(f"{cost:7.2f}" for cost in costs), "  ".join(f"{mb:5.0f}" for mb in memory)
        print(
            f"  {estimator:<12}{reported[0]} | {reported[1]} | time ~ n^{exponent(growth.values, costs):.2f}",
            flush=True,
        )


if __name__ == "__main__":
    for wanted in sys.argv[1:] or GROWTHS:
        measure(wanted)
