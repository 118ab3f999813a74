"""Position and heading error over time against the truth; without truth, the differences between estimators."""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes

from toolkit.estimate import Trajectory
from toolkit.experiment.comparison import Comparison, Row
from toolkit.geometry import Array
from toolkit.metrics._shared.alignment import Alignment
from toolkit.metrics._shared.residuals import rmse
from toolkit.report.figures.alignment import (
    NOT_ALIGNED,
    Errors,
    alignment_words,
    errors_to,
    last_good_answer,
    onto_truth,
    truth_during,
)
from toolkit.report.figures.panels import scale_by_decades
from toolkit.report.figures.style import (
    NamedFigure,
    colour_of,
    entries_of,
    legend_below,
    line_of_estimator,
    new_figure,
    quiet,
    width_of,
)
from toolkit.resampling import NS_PER_S
from toolkit.sequence import Truth

# A run that is not ok is drawn up to this many times the largest error of the runs that are.
_ROOM_FOR_DIVERGED = 1.5
# Estimators that agree to rounding shall look so: no axis is narrower than this (m, deg).
_LEAST_POSITION_M, _LEAST_HEADING_DEG = 1e-3, 1e-2
_ORDER_OF_MAGNITUDE, _BELOW_LEAST, _LEAST_LOGARITHMIC_M = 12.0, 0.2, 1e-5


class _Reference(NamedTuple):
    """What the curves are measured against, how a row is aligned to it first, and how to call the difference.

    ``trajectory`` is the estimate that stands for the truth where there is none.
    """

    truth: Truth
    align: Callable[[Row], Alignment]
    what: str
    caption: str
    trajectory: Trajectory | None = None


class ErrorCurves(NamedTuple):
    """The rows with their errors, how to call them ("error", or the difference from whom) and the caption."""

    of_rows: list[tuple[Row, Errors]]
    what: str
    caption: str


def draw(comparison: Comparison) -> Iterator[NamedFigure]:
    """Yield the figure of errors (with truth) or of differences (without, given two trajectories)."""
    curves = error_curves(comparison)
    if curves is not None:
        yield _figure(comparison, curves)


def error_curves(comparison: Comparison) -> ErrorCurves | None:
    """Return every row's errors (with truth) or differences (without), or None where no row has any."""
    reference = _truth(comparison) or _answer(comparison)
    if reference is None:
        return None
    curves: list[tuple[Row, Errors]] = []
    for row in comparison.rows:
        trajectory = row.run.trajectory(row.output)
        if trajectory is None or trajectory is reference.trajectory:
            continue
        if row.output == "causal" and row.run.final_is_causal:
            continue
        errors = errors_to(reference.truth, trajectory, reference.align(row), comparison.sequence)
        if errors is not None:
            curves.append((row, errors))
    return ErrorCurves(curves, reference.what, reference.caption) if curves else None


def _truth(comparison: Comparison) -> _Reference | None:
    sequence = comparison.sequence
    truth = truth_during(sequence)
    if truth is None:
        return None
    caption = (
        f"Position and heading error over time. {alignment_words(sequence)} "
        "Dashed: causal, what was known at the time. Solid: final, or both where they agree (as a filter's do)."
    )
    return _Reference(truth, lambda row: onto_truth(row.run, row.output, sequence), "error", caption)


def _answer(comparison: Comparison) -> _Reference | None:
    answer = last_good_answer(comparison)
    if answer is None:
        return None
    caption = (
        f"There is no truth: position and heading difference from {answer.name}, not aligned. "
        "A difference says that two estimators disagree, not which of them is right."
    )
    as_truth = Truth(answer.trajectory.t_ns, answer.trajectory.T_world_imu)
    return _Reference(as_truth, lambda _: NOT_ALIGNED, f"difference from {answer.name}", caption, answer.trajectory)


def _figure(comparison: Comparison, curves: ErrorCurves) -> NamedFigure:
    figure = new_figure(4.4)
    position, heading = figure.subplots(2, 1, sharex=True)
    start_ns = int(comparison.sequence.frames_t_ns[0])
    for row, errors in curves.of_rows:
        t_s, width = (errors.t_ns - start_ns) / NS_PER_S, width_of(comparison, row.estimator)
        look = {
            "color": colour_of(comparison, row.estimator),
            "linestyle": line_of_estimator(comparison, row.estimator, row.output),
        }
        position.plot(t_s, errors.position_m, linewidth=width, **look)
        heading.plot(t_s, _without_wraps(errors.heading_deg), linewidth=width, **look)
    quiet(position, f"{comparison.name}: position {curves.what}", "", "position [m]")
    quiet(heading, f"heading {curves.what}", "time [s]", "heading [deg]")
    _limit_position(position, curves.of_rows)
    low, high = heading.get_ylim()
    heading.set_ylim(min(low, -_LEAST_HEADING_DEG), max(high, _LEAST_HEADING_DEG))
    figure.align_ylabels()
    legend_below(figure, entries_of(comparison, [(row.estimator, row.output) for row, _ in curves.of_rows]))
    return NamedFigure("errors_over_time", curves.caption, figure)


def _limit_position(axes: Axes, curves: list[tuple[Row, Errors]]) -> None:
    """Keep the position axis to what the runs that are ok need, so that a diverged one does not flatten them.

    Where these differ by more than an order of magnitude it is logarithmic: else the best would be a line at zero.
    """
    good = [errors.position_m for row, errors in curves if row.status == "ok"]
    sizes = [size for position_m in good if (size := rmse(position_m)) > 0.0]
    _, high = axes.get_ylim()
    if good and len(good) < len(curves):
        largest = max(float(position_m.max()) for position_m in good)
        high = min(high, largest * _ROOM_FOR_DIVERGED) if largest > 0.0 else high
    high = max(high, _LEAST_POSITION_M)
    if sizes and max(sizes) > _ORDER_OF_MAGNITUDE * min(sizes) and high > _LEAST_POSITION_M:
        scale_by_decades(axes, max(_BELOW_LEAST * min(sizes), _LEAST_LOGARITHMIC_M), high)
    else:
        axes.set_ylim(0.0, high)


def _without_wraps(heading_deg: Array) -> Array:
    """Break the line where the angle steps over +-180 degrees, so that no vertical stroke is drawn."""
    broken = heading_deg.copy()
    broken[1:][np.abs(np.diff(heading_deg)) > 180.0] = np.nan
    return broken
