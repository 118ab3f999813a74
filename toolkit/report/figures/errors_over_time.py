"""Position and heading error over time against the truth; without truth, the differences between estimators."""

from collections.abc import Iterator

import numpy as np
from matplotlib.axes import Axes

from toolkit.experiment.comparison import Comparison, Row
from toolkit.geometry import Array
from toolkit.metrics._shared.residuals import rmse
from toolkit.report.curves import ErrorCurves, Errors, error_curves
from toolkit.report.figures.panels import scale_by_decades
from toolkit.report.figures.style import (
    NamedFigure,
    colour_of,
    entries_of,
    legend_below,
    line_of_estimator,
    new_figure,
    style_axes,
    width_of,
)

# A run that is not ok is drawn up to this many times the largest error of the runs that are.
_ROOM_FOR_DIVERGED = 1.5
# Estimators that agree to rounding shall look so: no axis is narrower than this (m, deg).
_LEAST_POSITION_M, _LEAST_HEADING_DEG = 1e-3, 1e-2
_ORDER_OF_MAGNITUDE, _BELOW_LEAST, _LEAST_LOGARITHMIC_M = 12.0, 0.2, 1e-5


def draw(comparison: Comparison) -> Iterator[NamedFigure]:
    """Yield the figure of errors (with truth) or of differences (without, given two trajectories)."""
    curves = error_curves(comparison)
    if curves is not None:
        yield _figure(comparison, curves)


def _figure(comparison: Comparison, curves: ErrorCurves) -> NamedFigure:
    figure = new_figure(4.4)
    position, heading = figure.subplots(2, 1, sharex=True)
    for row, errors in curves.of_rows:
        t_s, width = comparison.sequence.elapsed_s(errors.t_ns), width_of(comparison, row.estimator)
        look = {
            "color": colour_of(comparison, row.estimator),
            "linestyle": line_of_estimator(comparison, row.estimator, row.output),
        }
        position.plot(t_s, errors.position_m, linewidth=width, **look)
        heading.plot(t_s, _without_wraps(errors.heading_deg), linewidth=width, **look)
    style_axes(position, f"{comparison.name}: position {curves.what}", "", "position [m]")
    style_axes(heading, f"heading {curves.what}", "time [s]", "heading [deg]")
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
