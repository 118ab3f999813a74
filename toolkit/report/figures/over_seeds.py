"""Error and NEES over time, over the seeds: one small panel an estimator, all on the same axes."""

from collections.abc import Iterator

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from toolkit.estimate import Output
from toolkit.experiment.comparison import Comparison, Row
from toolkit.geometry import Array
from toolkit.report.figures.style import NamedFigure, line_of, new_figure, quiet

_COLOUR_OF: dict[Output, str] = {"causal": "#D55E00", "final": "#0072B2"}  # Okabe & Ito (2008)
_BAND_COLOUR = "#cfd5da"
_MOST_COLUMNS = 3
_NEES_RANGE = (1e-2, 1e4)


def draw(over: Comparison) -> Iterator[NamedFigure]:
    """Yield the figure of position errors and that of NEES, each where there is anything to draw."""
    if any(group.position_m is not None for group in over.rows):
        yield _errors(over)
    if any(group.mean_nees is not None for group in over.rows):
        yield _nees(over)


def _errors(over: Comparison) -> NamedFigure:
    figure, panels = _panels(over)
    for group in over.rows:
        errors_m = group.position_m
        if errors_m is None or _repeats(over, group):
            continue
        known = np.isfinite(errors_m).any(axis=0)
        lower, median, upper = np.nanpercentile(errors_m[:, known], [25.0, 50.0, 75.0], axis=0)
        axes, t_s, colour = panels[group.estimator], over.frames_s[known], _COLOUR_OF[group.output]
        axes.fill_between(t_s, lower, upper, color=colour, alpha=0.2, linewidth=0.0)
        axes.plot(t_s, median, color=colour, linestyle=line_of(group.output), linewidth=1.4, label=_label(over, group))
    _finish(figure, panels, over, "position error [m]")
    next(iter(panels.values())).set_ylim(bottom=0.0)
    caption = (
        f"Position error over time on {over.name}, {len(over.seeds)} seeds, not aligned: the median and, shaded, "
        "the quartiles over the runs that are ok. Dashed: causal, what was known at the time. Solid: final."
    )
    return NamedFigure("errors_over_seeds", caption, figure)


def _nees(over: Comparison) -> NamedFigure:
    figure, panels = _panels(over)
    for group in over.rows:
        nees = group.mean_nees
        if nees is None or _repeats(over, group):
            continue
        axes = panels[group.estimator]
        axes.fill_between(over.frames_s, nees.low, nees.high, color=_BAND_COLOUR, linewidth=0.0, zorder=1)
        label = f"{_label(over, group)}: {nees.in_band_percent:.0f} % in band"
        shown: Array = np.clip(nees.mean, *_NEES_RANGE)
        colour, line = _COLOUR_OF[group.output], line_of(group.output)
        axes.plot(over.frames_s, shown, color=colour, linestyle=line, linewidth=1.2, label=label)
        axes.set_yscale("log")
    _finish(figure, panels, over, "pose NEES / 6")
    caption = (
        f"Pose NEES over its 6 degrees of freedom on {over.name}, averaged over the runs that are ok of "
        f"{len(over.seeds)} seeds, and the 95 % chi-square band of a consistent estimator (grey). Above the band an "
        f"estimator is too sure of itself. What is beyond {_NEES_RANGE[0]:g} and {_NEES_RANGE[1]:g} is drawn there."
    )
    return NamedFigure("nees_over_seeds", caption, figure)


def _panels(over: Comparison) -> tuple[Figure, dict[str, Axes]]:
    columns = min(_MOST_COLUMNS, len(over.estimators))
    rows = -(-len(over.estimators) // columns)
    figure = new_figure(max(3.4 * columns, 5.0), 0.6 + 2.5 * rows)
    grid = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False).ravel()
    for axes in grid[len(over.estimators) :]:
        axes.remove()
    return figure, dict(zip(over.estimators, grid, strict=False))


def _finish(figure: Figure, panels: dict[str, Axes], over: Comparison, y_label: str) -> None:
    for name, axes in panels.items():
        quiet(axes, name, "", "")
        axes.tick_params(labelbottom=True)
        if axes.get_legend_handles_labels()[0]:
            axes.legend(frameon=False, fontsize=8, loc="best")
        else:
            axes.text(0.5, 0.5, "nothing to show", transform=axes.transAxes, ha="center", color="#8a949f", fontsize=9)
    figure.suptitle(f"{over.name}, {len(over.seeds)} seeds", fontsize=11, x=0.01, ha="left")
    figure.supxlabel("time [s]", fontsize=10)
    figure.supylabel(y_label, fontsize=10)


def _repeats(over: Comparison, group: Row) -> bool:
    """Say whether a group's errors are those of the estimator's other output, as a filter's final ones are."""
    return group.output == "final" and _same_as_causal(over, group)


def _same_as_causal(over: Comparison, group: Row) -> bool:
    causal = next((g for g in over.rows if g.estimator == group.estimator and g.output == "causal"), None)
    if causal is None or causal.position_m is None or group.position_m is None:
        return False
    return np.array_equal(causal.position_m, group.position_m, equal_nan=True)


def _label(over: Comparison, group: Row) -> str:
    both = next((g for g in over.rows if g.estimator == group.estimator and g.output == "final"), group)
    return "causal = final" if group is not both and _same_as_causal(over, both) else group.output
