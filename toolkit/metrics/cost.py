"""The cost of the run: time per frame, total time, memory."""

import numpy as np

from toolkit.answers import Timings
from toolkit.geometry import Array
from toolkit.metrics.parts.evaluation import Evaluation
from toolkit.metrics.parts.scores import Metric, Scores, Unavailable, evaluate

ORDER = 90
METRICS = (
    Metric("frame_ms_mean", "mean wall-clock time of a step, the first included (ms)", "ms", ("wall", "frame")),
    Metric("frame_ms_p95", "95th percentile of the same (ms)", "ms", ("frame", "p95")),
    Metric("frame_ms_max", "longest step (ms)", "ms", ("frame", "max")),
    Metric("total_s", "wall-clock time of all steps and the finish (s)", "s", ("total", ""), table="always"),
    Metric("cpu_s", "processor time of all threads (s)", "s", ("CPU", "")),
    Metric("peak_rss_mb", "peak resident memory of the process during the run (MB)", "MB", ("peak", "memory")),
    Metric(
        "frame_cpu_ms_mean",
        "processor time of all threads, the finish included, over the number of steps (ms)",
        "ms",
        ("CPU", "frame"),
        table="always",
        over_seeds=True,
    ),
)


def score(evaluation: Evaluation) -> Scores:
    """Score the run's timings; the same for both kinds of output, which come from one run."""
    timings = evaluation.run.timings
    if timings is None:
        raise Unavailable("not run here")
    return evaluate(
        {
            "frame_ms_mean": lambda: float(np.mean(_steps_ms(timings))),
            "frame_ms_p95": lambda: float(np.percentile(_steps_ms(timings), 95.0)),
            "frame_ms_max": lambda: float(np.max(_steps_ms(timings))),
            "total_s": lambda: timings.total_s,
            "cpu_s": lambda: timings.cpu_s,
            "peak_rss_mb": lambda: _measured(timings.peak_rss_mb),
            "frame_cpu_ms_mean": lambda: 1e3 * timings.cpu_s / _steps_ms(timings).size,
        }
    )


def _steps_ms(timings: Timings) -> Array:
    steps_s = np.asarray(timings.step_s)
    if not steps_s.size:
        raise Unavailable("the run made no step")
    return 1e3 * steps_s


def _measured(value: float | None) -> float:
    if value is None:
        raise Unavailable("not measured on this platform")
    return value
