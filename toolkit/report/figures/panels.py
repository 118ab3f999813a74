"""Small panels, one an estimator, all on the same axes, because fourteen lines in one panel hide each other."""

from collections.abc import Collection, Sequence
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from matplotlib.ticker import LogLocator, NullLocator

from toolkit.estimate import Output
from toolkit.geometry import Array
from toolkit.report.figures.style import (
    BAND_COLOUR,
    LABEL_PT,
    MUTED_COLOUR,
    SMALL_PT,
    TITLE_PT,
    WIDTH_IN,
    Entry,
    legend,
    legend_below,
    line_of,
    new_figure,
    style_axes,
)

# Values of a NEES or NIS over its expectation beyond these are drawn at the limit, and the panel gives the largest.
RANGE = (1e-2, 1e4)
# From so many panels on there are four in a row, before that three; two or four make a square.
_MANY = 10
_PANEL_IN = 1.35
_FEW_DECADES = 1.7


def panels_of(names: Sequence[str], x_label: str = "time [s]") -> tuple[Figure, dict[str, Axes]]:
    """Return a figure with an empty panel a name, all on the same axes."""
    columns = columns_for(len(names))
    rows = -(-len(names) // columns)
    figure = new_figure(0.85 + _PANEL_IN * rows)
    grid = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False).ravel()
    for axes in grid[len(names) :]:
        axes.set_axis_off()
    panels = dict(zip(names, grid, strict=False))
    for name, axes in panels.items():
        style_axes(axes, name, "", "")
    # A panel with nothing below it has the numbers of the axis, too.
    for axes in grid[: len(names)][-columns:]:
        axes.tick_params(labelbottom=True)
        axes.set_xlabel(x_label, fontsize=LABEL_PT)
    return figure, panels


def columns_for(count: int) -> int:
    """Return how many columns so many panels have."""
    if count >= _MANY:
        return 4
    return 2 if count in (2, 4) else min(3, count)


def finish(figure: Figure, panels: dict[str, Axes], what: str, title: str, entries: Sequence[Entry]) -> None:
    """Give the figure its title, its vertical axis and its legend, which stands in a spare panel where there is one."""
    for axes in panels.values():
        if not axes.has_data():
            text = "nothing to show"
            axes.text(0.5, 0.5, text, transform=axes.transAxes, ha="center", color=MUTED_COLOUR, fontsize=SMALL_PT)
    figure.suptitle(title, fontsize=TITLE_PT, x=0.01, ha="left")
    figure.supylabel(what, fontsize=LABEL_PT)
    spare = figure.axes[len(panels) :]
    if spare:
        legend(spare[0], entries, columns=1, loc="center left").set_in_layout(False)
    else:
        legend_below(figure, entries)


def scale_by_decades(axes: Axes, low: float, high: float) -> None:
    """Make the vertical axis, and those shared with it, logarithmic between two values, with few and plain numbers."""
    axes.set_yscale("log")
    axes.set_ylim(low, high)
    few = np.log10(high / low) < _FEW_DECADES
    axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if few else (1.0,), numticks=6))
    if few:
        axes.yaxis.set_major_formatter("{x:g}")
    # Ticks between decades are many, and take longer to draw than all else.
    axes.yaxis.set_minor_locator(NullLocator())


class Normalised(NamedTuple):
    """Squared errors over their expectation at times (n,) s, and the band (n,), (n,) of a consistent estimator.

    NaN means unknown.
    """

    t_s: Array
    value: Array
    low: Array
    high: Array

    @property
    def in_band_percent(self) -> float:
        """Return the share of the values that are in the band."""
        known = ~np.isnan(self.value)
        return 100.0 * float(np.mean(((self.value >= self.low) & (self.value <= self.high))[known]))


class Drawn(NamedTuple):
    """What a panel of an estimator shows, in its colour and with the line of a kind of output."""

    estimator: str
    colour: str
    output: Output
    series: Normalised


def figure_with_bands(panels_for: Sequence[str], drawn: Sequence[Drawn], what: str, title: str) -> Figure:
    """Draw each estimator's normalised errors over their band, in a panel of its own that says how many are in it.

    A panel whose values leave the figure says how large they become.
    """
    figure, panels = panels_of(panels_for)
    shares: dict[str, list[float]] = {}
    largest: dict[str, float] = {}
    least = most = 1.0
    for estimator, colour, output, series in drawn:
        axes, shown = panels[estimator], np.clip(series.value, *RANGE)
        axes.fill_between(series.t_s, series.low, series.high, color=BAND_COLOUR, linewidth=0.0, zorder=1)
        axes.plot(series.t_s, shown, color=colour, linestyle=line_of(output), linewidth=1.0)
        shares.setdefault(estimator, []).append(series.in_band_percent)
        largest[estimator] = np.nanmax([largest.get(estimator, 0.0), *series.value])
        least, most = np.nanmin([least, *shown, *series.low]), np.nanmax([most, *shown, *series.high])
    for estimator, percents in shares.items():
        text = ", ".join(f"{percent:.0f} %" for percent in percents)
        beyond = f", up to {largest[estimator]:.0e}" if largest[estimator] > RANGE[1] else ""
        annotate(panels, estimator, (f"{text} in band{beyond}", f"{text}{beyond}", text))
    scale_by_decades(next(iter(panels.values())), max(0.7 * least, RANGE[0]), min(1.5 * most, RANGE[1]))
    finish(figure, panels, what, title, [*output_entries({one.output for one in drawn}), band_entry()])
    return figure


def annotate(panels: dict[str, Axes], name: str, texts: Sequence[str]) -> None:
    """Write above a panel, to the right: the first of the texts for which there is room."""
    room = int(WIDTH_IN * 72.0 / columns_for(len(panels)) / (0.6 * TITLE_PT)) - 3
    fitting = next((one for one in texts if len(name) + len(one) <= room), texts[-1])
    panels[name].set_title(fitting, fontsize=SMALL_PT, loc="right", color=MUTED_COLOUR)


def output_entries(outputs: Collection[Output]) -> list[Entry]:
    """Return the legend's entries for the outputs that are drawn; a filter's final output repeats its causal one."""
    names: dict[Output, str] = {"causal": "causal", "final": "final (a filter's causal output too)"}
    return [Entry.of_line(names[output], MUTED_COLOUR, line_of(output)) for output in sorted(outputs)]


def band_entry() -> Entry:
    """Return the legend's entry for the band of a consistent estimator."""
    return Entry("95 % band", (Patch(color=BAND_COLOUR, linewidth=0.0),))
