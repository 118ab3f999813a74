"""What starting costs: imports and short runs as ratios of processor time to importing NumPy, by turns in one session.

Not part of the test run: absolute times belong to a machine. Every row is a process of its own, and its time all that
the process did; bytecode is compiled before. A run is three frames of ``drive``: with NumPy, with compiled code that
was kept, and with `--cold` with nothing kept, which compiles for many seconds.

    python tests/benchmarks/bench_start.py [--repeats 5] [--cold]
"""

import argparse
import os
import resource
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path

import numpy as np

ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
REFERENCE = "import numpy"
IMPORTS = (
    "pass",
    REFERENCE,
    "import gtsam",
    "import toolkit",
    "import toolkit.api",
    "import toolkit.cli",
    "from toolkit.registry import discover; [one.load() for one in discover().values()]",
)
RUN = """
import toolkit
toolkit.compare("drive", ["{name}"], max_frames=3, workers=1)
"""
# What is timed, by what is printed of it.
PROGRAMS = {line: line for line in IMPORTS} | {name: RUN.format(name=name) for name in ("ekf", "msckf-fej")}


def cpu_s(program: str, changed: Mapping[str, str]) -> float:
    """Return the processor time of a process that runs a program, its children's included."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    environment = {**os.environ, **ONE_THREAD, **changed}
    subprocess.run([sys.executable, "-c", program], env=environment, check=True, stderr=subprocess.DEVNULL)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def measure(repeats: int) -> None:
    """Print a line for each program: its time over the reference's of the same turn, mean and standard error."""
    for program in PROGRAMS.values():  # what is imported is compiled and read once
        cpu_s(program, {})
    turns = [{name: cpu_s(program, {}) for name, program in PROGRAMS.items()} for _ in range(repeats)]
    for name in PROGRAMS:
        ratios = np.array([turn[name] / turn[REFERENCE] for turn in turns])
        error = ratios.std(ddof=1) / np.sqrt(repeats) if repeats > 1 else np.nan
        print(f"{ratios.mean():8.2f} +- {error:.2f}  {np.mean([turn[name] for turn in turns]):7.2f} s  {name}")


def measure_cold() -> None:
    """Print what a run takes that compiles all it needs, over the reference."""
    with tempfile.TemporaryDirectory() as folder:
        spent_s = cpu_s(RUN.format(name="msckf-fej"), {"NUMBA_CACHE_DIR": folder})
        assert any(Path(folder).rglob("*.nbc")), "nothing was compiled"
    print(f"{spent_s / cpu_s(REFERENCE, {}):8.1f}           {spent_s:7.2f} s  msckf-fej, nothing kept", flush=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--cold", action="store_true", help="compile with an empty cache as well")
    wanted = parser.parse_args()
    measure(wanted.repeats)
    if wanted.cold:
        measure_cold()
