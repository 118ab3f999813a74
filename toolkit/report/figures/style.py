"""One look for every figure: a colour an estimator, legible for the colour-blind, quiet axes, legends beside the data.

Small panels, one an estimator on the same axes, are laid out here too: fourteen lines in one panel hide each other.
Figures are as wide as two columns of a paper and are to be set at that width: letters then have 7 to 9 points.
"""

from collections.abc import Collection, Iterable, Sequence
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, Self, TypedDict

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.legend import Legend
from matplotlib.lines import Line2D
from matplotlib.ticker import LogLocator, NullLocator

from toolkit.answers import Output

if TYPE_CHECKING:  # with GTSAM, which figures of trajectory files do without
    from toolkit.experiment.comparison import Comparison

DPI = 130
WIDTH_IN = 7.16  # two columns of an IEEE paper
TITLE_PT, LABEL_PT, TICK_PT, LEGEND_PT, SMALL_PT = 9.0, 8.5, 8.0, 8.0, 7.0
_EM_A_LETTER = 0.56  # the mean width of a letter over the size of the type
GRID_COLOUR, BAND_COLOUR, ZERO_COLOUR, MUTED_COLOUR = "#e4e7ea", "#d5dade", "#9aa4ad", "#5b6670"
TRUTH_COLOUR = "#1a1a1a"
LANDMARK_COLOUR = "#8a949f"

# Okabe & Ito (2008), in the order in which neighbours differ most.
_COLOURS = ("#D55E00", "#0072B2", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#7F5F3F")
Dashes = Literal["-", "--", ":"] | tuple[float, tuple[float, ...]]
_LINE_OF: dict[Output, tuple[Dashes, ...]] = {
    "causal": ("--", ":", (0.0, (1.0, 3.0)), (0.0, (2.0, 1.0, 1.0, 1.0))),
    "final": ("-", (0.0, (7.0, 1.5, 1.0, 1.5, 1.0, 1.5)), (0.0, (12.0, 1.5)), (0.0, (9.0, 1.5, 3.0, 1.5))),
}
_WIDEST, _THINNEST = 2.8, 1.2
# Of a sample of a line in a legend, wide enough and thin enough for one period of any dashes, in sizes of the type.
_SAMPLE_EM, _SAMPLE_PT = 3.4, 1.6
# From this many panels on there are four in a row, before that three; two or four make a square.
_MANY = 10
_PANEL_IN = 1.35
_FEW_DECADES = 1.7
# Errors that differ by this factor have a logarithmic axis, which begins here at least: the best were a line at zero.
_ORDER_OF_MAGNITUDE, _LEAST_ERROR = 12.0, 1e-5


class NamedFigure(NamedTuple):
    """A figure with its file name (without ending) and the sentence that belongs under it."""

    name: str
    caption: str
    figure: Figure


def colour_at(place: int) -> str:
    return _COLOURS[place % len(_COLOURS)]


def line_of(output: Output) -> Dashes:
    """Return the line style of a kind of output: dashed while it knew the past only, solid at the end."""
    return _LINE_OF[output][0]


class Stroke(TypedDict):
    """How a line is drawn, as matplotlib's arguments."""

    color: str
    linestyle: Dashes


def stroke_of(estimators: Iterable[str], estimator: str, output: Output = "final") -> Stroke:
    """Return colour and dashes of one kind of output of an estimator, given all: others where its colour is another's.

    Both outputs keep the estimator's colour, so that thrice as many estimators as there are colours are told apart.
    """
    from toolkit.report.curves import look_numbers

    number, styles = look_numbers(estimators)[estimator], _LINE_OF[output]
    return Stroke(color=colour_at(number), linestyle=styles[number // len(_COLOURS) % len(styles)])


def width_of(comparison: "Comparison", estimator: str) -> float:
    """Return the width of an estimator's line: each wider than the next, so that equal lines show as a border."""
    order = [run.estimator for run in comparison.runs]
    if len(order) == 1:
        return _THINNEST
    return _WIDEST + (_THINNEST - _WIDEST) * order.index(estimator) / (len(order) - 1)


def new_figure(height_in: float) -> Figure:
    return Figure(figsize=(WIDTH_IN, height_in), dpi=DPI, layout="constrained")


def add_title(figure: Figure, text: str) -> None:
    figure.suptitle(text, fontsize=TITLE_PT, x=0.01, ha="left")


def label_axes(axes: Axes, title: str, x_label: str, y_label: str) -> None:
    """Label axes (with units), draw a light grid behind the data and no frame on the open sides."""
    axes.set_title(title, fontsize=TITLE_PT, loc="left")
    axes.set_xlabel(x_label, fontsize=LABEL_PT)
    axes.set_ylabel(y_label, fontsize=LABEL_PT)
    axes.tick_params(labelsize=TICK_PT)
    axes.grid(True, color=GRID_COLOUR, linewidth=0.8)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)


class Entry(NamedTuple):
    """An entry of a legend: what it is called, and a sample of what is drawn for it."""

    label: str
    sample: Artist

    @classmethod
    def of_line(cls, label: str, colour: str, dashes: Dashes = "-", width: float = 1.5) -> Self:
        return cls(label, Line2D([], [], color=colour, linestyle=dashes, linewidth=width))


def entries_of(estimators: Iterable[str], drawn: Sequence[tuple[str, Output]]) -> list[Entry]:
    """Return an entry for each estimator of which outputs are drawn, with the line of the final one where it is."""
    output_of = dict(sorted(drawn, key=lambda pair: pair[1]))  # causal before final
    strokes = {name: stroke_of(estimators, name, output_of[name]) for name, _ in drawn}
    return [Entry.of_line(name, stroke["color"], stroke["linestyle"], _SAMPLE_PT) for name, stroke in strokes.items()]


def legend(owner: Figure | Axes, entries: Sequence[Entry], columns: int = 0, **place: Any) -> Legend:
    """Put a legend somewhere (``loc`` and the like), with as many columns as there is room for unless it is said."""
    widest_pt = LEGEND_PT * (_SAMPLE_EM + 2.2 + _EM_A_LETTER * max(len(entry.label) for entry in entries))
    return owner.legend(
        handles=[entry.sample for entry in entries],
        labels=[entry.label for entry in entries],
        handlelength=_SAMPLE_EM,
        ncols=columns or max(1, min(len(entries), int(WIDTH_IN * 72.0 / widest_pt))),
        columnspacing=1.4,
        frameon=False,
        fontsize=LEGEND_PT,
        **place,
    )


def legend_below(figure: Figure, entries: Sequence[Entry]) -> None:
    legend(figure, entries, loc="outside lower center")


def panels_of(
    names: Sequence[str], x_label: str = "time [s]", panel_in: float = _PANEL_IN
) -> tuple[Figure, dict[str, Axes]]:
    """Return a figure with an empty panel of some height a name, all on the same axes."""
    columns = 4 if len(names) >= _MANY else 2 if len(names) in (2, 4) else min(3, len(names))
    rows = -(-len(names) // columns)
    figure = new_figure(0.85 + panel_in * rows)
    grid = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False).ravel()
    for axes in grid[len(names) :]:
        axes.set_axis_off()
    panels = dict(zip(names, grid, strict=False))
    for name, axes in panels.items():
        label_axes(axes, name, "", "")
        axes.set_title(name, fontsize=TITLE_PT if columns < 4 else TICK_PT, loc="left")  # a remark is beside it
    # A panel with nothing below it has the numbers of the axis, too.
    for axes in grid[: len(names)][-columns:]:
        axes.tick_params(labelbottom=True)
        axes.set_xlabel(x_label, fontsize=LABEL_PT)
    return figure, panels


def say(axes: Axes, text: str) -> None:
    axes.text(0.5, 0.5, text, transform=axes.transAxes, ha="center", color=MUTED_COLOUR, fontsize=SMALL_PT)


def finish(figure: Figure, panels: dict[str, Axes], what: str, title: str, entries: Sequence[Entry]) -> None:
    """Give the figure its title, its vertical axis and its legend, and say which panel has nothing to show."""
    for axes in panels.values():
        if not axes.has_data():
            say(axes, "nothing to show")
    add_title(figure, title)
    figure.supylabel(what, fontsize=LABEL_PT)
    legend_below(figure, entries)


def scale_by_decades(axes: Axes, low: float, high: float, which: Literal["x", "y"] = "y") -> None:
    """Make an axis, and those shared with it, logarithmic between two values, with few and plain numbers."""
    axes.set(**{f"{which}scale": "log", f"{which}lim": (low, high)})
    axis: Axis = getattr(axes, f"{which}axis")
    few = np.log10(high / low) < _FEW_DECADES
    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if few else (1.0,), numticks=6))
    if few:
        axis.set_major_formatter("{x:g}")
    # Ticks between decades are many, and take longer to draw than all else.
    axis.set_minor_locator(NullLocator())


def scale_errors(axes: Axes, sizes: Sequence[float], most: float) -> None:
    """Have an axis of errors reach from zero up to a value, by decades where their sizes differ by more than one."""
    known = [size for size in sizes if size > 0.0]
    if known and max(known) > _ORDER_OF_MAGNITUDE * min(known):
        scale_by_decades(axes, max(0.2 * min(known), _LEAST_ERROR), most)
    else:
        axes.set_ylim(0.0, most)


def annotate(axes: Axes, text: str) -> None:
    axes.set_title(text, fontsize=SMALL_PT, loc="right", color=MUTED_COLOUR)


def output_entries(outputs: Collection[Output]) -> list[Entry]:
    """Return the legend's entries for the outputs that are drawn; a filter's final output repeats its causal one."""
    names: dict[Output, str] = {"causal": "causal", "final": "final (a filter's causal output too)"}
    return [Entry.of_line(names[output], MUTED_COLOUR, line_of(output)) for output in sorted(outputs)]
