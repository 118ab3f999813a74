"""The loss of each estimator against the Cramér-Rao bound over time, with the bound and its stated deviation."""

from collections.abc import Iterator

import numpy as np
from matplotlib.axes import Axes

from toolkit.experiment.comparison import Comparison, Row
from toolkit.geometry import Array
from toolkit.metrics import Evaluation, Unavailable
from toolkit.metrics.bound import AgainstBound, against_bound
from toolkit.models.state import POSITION, ROTATION
from toolkit.report.figures.style import (
    MUTED_COLOUR,
    TRUTH_COLOUR,
    Entry,
    NamedFigure,
    entries_of,
    legend_below,
    line_of,
    new_figure,
    shown_as,
    stroke_of,
    style_axes,
)

_CAPTION = (
    "How close to the limit. Black: the Cramér-Rao bound, one standard deviation (dashed: of what was known at the "
    "time, solid: of the whole recording). In colour, thick: the error of an estimator beyond the efficient estimate "
    "on the same measurements; well below the bound the loss is negligible. Thin: the standard deviation it "
    "states; below the bound it is overconfident."
)
_LEAST_SHARE, _STATED_WIDTH = 1e-3, 0.7


def draw(comparison: Comparison) -> Iterator[NamedFigure]:
    """Yield the figure where the bound was asked for and the recording has one."""
    found = list(_found(comparison)) if comparison.settings.metrics.bound else []
    if found:
        yield _figure(comparison, found)


def _found(comparison: Comparison) -> Iterator[tuple[Row, AgainstBound]]:
    for row in comparison.lines:
        try:
            yield row, against_bound(Evaluation(row.run, row.output, comparison.sequence))
        except Unavailable:
            continue  # the notes under the table say why


def _figure(comparison: Comparison, found: list[tuple[Row, AgainstBound]]) -> NamedFigure:
    figure = new_figure(4.8)
    position, rotation = figure.subplots(2, 1, sharex=True)
    for axes, block, scale in ((position, POSITION, 1.0), (rotation, ROTATION, 180.0 / np.pi)):
        for row, one in found:
            _plot_estimator(axes, comparison, row, one, block, scale)
        _plot_bounds(axes, comparison, found, block, scale)
    style_axes(position, f"{comparison.name}: position beyond the efficient estimate", "", "position [m]")
    style_axes(rotation, "rotation beyond the efficient estimate", "time [s]", "rotation [deg]")
    figure.align_ylabels()
    bounds = [
        Entry.of_line(f"bound {output}", TRUTH_COLOUR, line_of(output), 2.0)
        for output in dict.fromkeys(row.output for row, _ in found)
    ]
    stated = Entry.of_line("thin: stated", MUTED_COLOUR, width=_STATED_WIDTH)
    estimators = entries_of(comparison, [(row.estimator, shown_as(row)) for row, _ in found])
    legend_below(figure, [*bounds, *estimators, stated])
    return NamedFigure("against_bound", _CAPTION, figure)


def _plot_estimator(
    axes: Axes, comparison: Comparison, row: Row, one: AgainstBound, block: slice, scale: float
) -> None:
    t_s, label = comparison.sequence.elapsed_s(one.t_ns), f"{row.estimator} {row.label}"
    stroke = stroke_of(comparison, row.estimator, shown_as(row))
    lost = np.linalg.norm(one.excess[:, block], axis=1)
    axes.plot(t_s, scale * lost, linewidth=1.6, label=label, **stroke)
    axes.plot(t_s, scale * _sigma(one.stated, block), linewidth=_STATED_WIDTH, **stroke)


def _plot_bounds(
    axes: Axes, comparison: Comparison, found: list[tuple[Row, AgainstBound]], block: slice, scale: float
) -> None:
    """Draw the bound of each kind of output, and leave room for what is a thousand times below it."""
    least = np.inf
    for output in dict.fromkeys(row.output for row, _ in found):
        one = next(one for row, one in found if row.output == output)
        sigma = scale * _sigma(one.bound, block)
        least = min(least, float(sigma.min()))
        t_s, line = comparison.sequence.elapsed_s(one.t_ns), line_of(output)
        axes.plot(t_s, sigma, color=TRUTH_COLOUR, linestyle=line, linewidth=2.0, label=f"bound {output}")
    axes.set_yscale("log")
    axes.set_ylim(bottom=_LEAST_SHARE * least)


def _sigma(covs: Array, block: slice) -> Array:
    """Return the root (n,) of the trace of a block of covariances (n, d, d)."""
    return np.asarray(np.sqrt(np.trace(covs[:, block, block], axis1=1, axis2=2)))
