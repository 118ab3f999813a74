"""Processor time of estimators, a frame and in total, as ratios to a fixed NumPy workload of the same run.

Not part of the test run: absolute times belong to a machine. The ratio to the reference, timed in the same process
just before each run, is what may be compared between machines and commits. The 95 % quantile of the frames is wall
clock: processor time is counted for a run as a whole, its finish included.

    python tests/benchmarks/bench_frame_time.py [ESTIMATOR ...]
    python -m pytest -s tests/benchmarks/bench_frame_time.py
"""

# ruff: noqa: E402 - the number of threads must be set before NumPy is imported
import os

for _threads in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_threads, "1")

import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from toolkit import runner
from toolkit.audit import audit
from toolkit.datasets import load_sequence
from toolkit.initialization import start_from_measurements
from toolkit.measurements import Prior
from toolkit.progress import SILENT
from toolkit.registry import find
from toolkit.sequence import Sequence
from toolkit.settings import DEFAULTS, Settings

DATA = Path(__file__).parents[2] / os.environ.get("VISLAM_DATA", "../shared/data")
RECORDINGS = ("drive", "drive-imu", "kitti00", str(DATA / "ucsd" / "03.npz"))
ESTIMATORS = ("dead-reckoning", "ekf", "batch")


def reference_ms() -> float:
    """Return the processor time (ms) of the reference: 400 times what a filter does to 64 landmarks, best of three."""
    rng = np.random.default_rng(0)
    roots, jacobians = rng.standard_normal((64, 3, 3)), rng.standard_normal((64, 3, 6))
    covs = roots @ np.swapaxes(roots, 1, 2) + np.eye(3)
    times = []
    for _ in range(3):
        began = time.process_time()
        for _ in range(400):
            weighted = np.swapaxes(jacobians, 1, 2) @ np.linalg.inv(covs)
            np.linalg.inv((weighted @ jacobians).sum(axis=0) + np.eye(6))
        times.append(time.process_time() - began)
    return 1e3 * min(times)


def _recordings() -> Iterator[Sequence]:
    for source in RECORDINGS:
        if "/" in source and not Path(source).exists():
            print(f"{source}: not there, left out (set VISLAM_DATA)")
            continue
        yield audit(load_sequence(source)).sequence


def measure(names: tuple[str, ...]) -> None:
    """Print one line for each estimator on each recording, two where it has compiled code and can run it."""
    print(
        f"{'recording':<12}{'estimator':<16}{'arithmetic':<12}{'status':<10}{'ms/frame':>9}{'CPU s':>8}"
        f"{'p95, wall ms':>14}{'reference ms':>14}"
    )
    for sequence in _recordings():
        prior = start_from_measurements(sequence)
        for name in names:
            if _measured(name, sequence, prior, DEFAULTS) == "compiled":
                _measured(name, sequence, prior, Settings(arithmetic="numpy"))


def _measured(name: str, sequence: Sequence, prior: Prior, settings: Settings) -> str | None:
    """Print the line of an estimator and return what computed, None where it has NumPy alone."""
    reference = reference_ms()
    run = runner.run(name, find(name).load(), sequence, prior, SILENT, settings)
    assert run.timings is not None
    frame_ms = 1e3 * run.timings.cpu_s / sequence.frame_count
    print(
        f"{sequence.name:<12}{name:<16}{run.arithmetic or '':<12}{run.status:<10}{frame_ms:>9.3f}"
        f"{run.timings.cpu_s:>8.2f}{1e3 * np.quantile(run.timings.step_s, 0.95):>14.3f}{reference:>14.1f}   "
        f"frame/reference {frame_ms / reference:.4f}, total/reference {1e3 * run.timings.cpu_s / reference:.1f}"
    )
    return run.arithmetic


def test_frame_times_are_printed() -> None:
    """Only printed: a benchmark asserts nothing about time."""
    measure(ESTIMATORS)


if __name__ == "__main__":
    measure(tuple(sys.argv[1:]) or ESTIMATORS)
