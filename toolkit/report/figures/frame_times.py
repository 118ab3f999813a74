"""Time per frame: what every step cost, and what a finish costs when it is spread over the frames."""

from collections.abc import Iterator

import numpy as np
from matplotlib.ticker import NullFormatter

from toolkit.experiment.comparison import Comparison
from toolkit.report.curves import running_median
from toolkit.report.figures.style import (
    Entry,
    NamedFigure,
    legend_below,
    new_figure,
    stroke_of,
    style_axes,
    width_of,
)

_MS = 1e3


def draw(comparison: Comparison) -> Iterator[NamedFigure]:
    """Yield the time of each step by frame, on a logarithmic axis, with the finish in the legend."""
    timed = [(run, run.timings) for run in comparison.runs if run.timings is not None and run.timings.step_s.size]
    if not timed:
        return
    figure = new_figure(3.4)
    axes = figure.add_subplot()
    entries = []
    for run, timings in timed:
        step_ms = np.maximum(timings.step_s * _MS, 1e-4)
        stroke = stroke_of(comparison, run.estimator, "final")
        axes.plot(step_ms, ".", color=stroke["color"], markersize=2.5, alpha=0.35)
        cpu_ms = _MS * timings.cpu_s / timings.step_s.size
        label = f"{run.estimator}: {float(step_ms.mean()):.2f} ms, CPU {cpu_ms:.2f} ms"
        if timings.finish_s > timings.step_s.sum():
            label += f", end {timings.finish_s:.1f} s"
        (median,) = axes.plot(running_median(step_ms), linewidth=width_of(comparison, run.estimator), **stroke)
        entries.append(Entry(label, (median,)))
    axes.set_yscale("log")
    low, high = axes.get_ylim()
    widened = max(1.0, np.sqrt(10.0 * low / high))  # a decade at least, so that jitter alone does not fill the axis
    axes.set_ylim(low / widened, high * widened)
    axes.yaxis.set_major_formatter("{x:g}")
    axes.yaxis.set_minor_formatter(NullFormatter())
    style_axes(axes, f"{comparison.name}: time per frame", "frame", "time of a step [ms]")
    legend_below(figure, entries)
    caption = (
        "Wall-clock time of each step (dots) and its running median (lines). In the legend their mean, and the "
        "processor time (CPU) a frame, the finish included: on a busy machine it alone is the estimator's. An "
        "estimator that answers only at the end does its work there; that time is in the legend, too."
    )
    yield NamedFigure("frame_times", caption, figure)
