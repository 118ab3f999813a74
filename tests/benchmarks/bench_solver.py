"""batch's three solves against GTSAM's own optimizer on the same graphs from the same starts, as ratios of CPU time.

Not part of the test run: absolute times belong to a machine. Both reach the same error, which is printed.

    python tests/benchmarks/bench_solver.py [SEQUENCE [FRAMES]]
"""

# ruff: noqa: E402 - the number of threads must be set before NumPy is imported
import os

for _threads in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_threads, "1")

import sys
import time
from collections.abc import Callable
from typing import Any

import gtsam

from filters import batch
from filters.smoothing.levenberg_marquardt import Solution, Stopping
from toolkit import runner
from toolkit.audit import audit
from toolkit.datasets import load_sequence
from toolkit.initialization import start_from_measurements
from toolkit.registry import find


def own(
    graph: gtsam.NonlinearFactorGraph, start: gtsam.Values, stopping: Stopping
) -> gtsam.LevenbergMarquardtOptimizer:
    """Return GTSAM's optimizer at its end, with the damping and the limits of ours."""
    params = gtsam.LevenbergMarquardtParams()
    params.setLinearSolverType("SEQUENTIAL_CHOLESKY")
    params.setlambdaInitial(1e-3)
    params.setlambdaUpperBound(1e8)
    params.setlambdaFactor(10.0)
    params.setRelativeErrorTol(stopping.relative_decrease)
    params.setAbsoluteErrorTol(0.0)
    params.setMaxIterations(stopping.max_iterations)
    optimizer = gtsam.LevenbergMarquardtOptimizer(graph, start, params)
    optimizer.optimize()
    return optimizer


def timed(work: Callable[[], Any]) -> tuple[Any, float]:
    """Return what some work gives and the CPU seconds it took."""
    began = time.process_time()
    result = work()
    return result, time.process_time() - began


def measure(source: str, frames: int) -> None:
    """Run batch; have GTSAM's optimizer solve each of its graphs again; print both."""
    sequence = audit(load_sequence(source)).sequence
    prior = start_from_measurements(sequence)
    sequence = sequence.truncated(frames) if frames else sequence
    solve, ours_s, theirs_s = batch.solve, [], []

    def both(graph: Any, start: Any, stopping: Stopping, *rest: Any, **named: Any) -> Solution:
        solution, spent_s = timed(lambda: solve(graph, start, stopping, *rest, **named))
        optimizer, own_s = timed(lambda: own(graph.whole, start, stopping))
        ours_s.append(spent_s)
        theirs_s.append(own_s)
        print(
            f"  {solution.iterations} iterations to {solution.error:.6f} in {spent_s:.2f} s, "
            f"GTSAM's own {optimizer.iterations()} to {optimizer.error():.6f} in {own_s:.2f} s"
        )
        return solution

    batch.solve = both
    try:
        print(f"{sequence.name}, {sequence.frame_count} frames")
        run = runner.run("batch", find("batch").load(), sequence, prior)
    finally:
        batch.solve = solve
    assert run.status == "ok" and run.timings is not None, run.log
    whole_s = run.timings.cpu_s - sum(theirs_s)
    print(f"  solves {sum(ours_s) / sum(theirs_s):.2f}, whole batch {whole_s / sum(theirs_s):.2f} x GTSAM's own")


if __name__ == "__main__":
    measure(sys.argv[1] if len(sys.argv) > 1 else "kitti00", int(sys.argv[2]) if len(sys.argv) > 2 else 0)
