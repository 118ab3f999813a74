"""One look for every figure: a colour an estimator, legible for the colour-blind, quiet axes."""

from typing import NamedTuple

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from toolkit.estimate import Output
from toolkit.experiment.comparison import Comparison

DPI = 110
TRUTH_COLOUR = "#1a1a1a"
LANDMARK_COLOUR = "#8a949f"

# Okabe & Ito (2008), in the order in which neighbours differ most; more estimators start over with it, in other dashes.
_COLOURS = ("#D55E00", "#0072B2", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#7F5F3F")
_Dashes = str | tuple[int, tuple[float, ...]]
_LINE_OF: dict[Output, tuple[_Dashes, ...]] = {
    "causal": ("--", ":"),
    "final": ("-", (0, (7.0, 1.5, 1.0, 1.5, 1.0, 1.5))),
}
_WIDEST, _THINNEST = 2.8, 1.2


class NamedFigure(NamedTuple):
    """A figure with its file name (without ending) and the sentence that belongs under it."""

    name: str
    caption: str
    figure: Figure


def colour_of(comparison: Comparison, estimator: str) -> str:
    """Return the colour an estimator has in every figure of a comparison."""
    order = [run.estimator for run in comparison.runs]
    return _COLOURS[order.index(estimator) % len(_COLOURS)]


def line_of(output: Output) -> _Dashes:
    """Return the line style of a kind of output: dashed while it knew the past only, solid at the end."""
    return _LINE_OF[output][0]


def line_of_estimator(comparison: Comparison, estimator: str, output: Output) -> _Dashes:
    """Return the line style of one kind of output of an estimator: other dashes where its colour is had already.

    Both outputs keep the estimator's colour, so that twice as many estimators as there are colours are told apart.
    """
    order = [run.estimator for run in comparison.runs]
    styles = _LINE_OF[output]
    return styles[order.index(estimator) // len(_COLOURS) % len(styles)]


def width_of(comparison: Comparison, estimator: str) -> float:
    """Return the width of an estimator's line: each wider than the next, so that equal lines show as a border."""
    order = [run.estimator for run in comparison.runs]
    if len(order) == 1:
        return _THINNEST
    return _WIDEST + (_THINNEST - _WIDEST) * order.index(estimator) / (len(order) - 1)


def new_figure(width_in: float, height_in: float) -> Figure:
    """Return an empty figure that arranges its own margins."""
    return Figure(figsize=(width_in, height_in), dpi=DPI, layout="constrained")


def quiet(axes: Axes, title: str, x_label: str, y_label: str) -> None:
    """Label axes (with units), draw a light grid behind the data and no frame on the open sides."""
    axes.set_title(title, fontsize=11, loc="left")
    axes.set_xlabel(x_label)
    axes.set_ylabel(y_label)
    axes.grid(True, color="#e4e7ea", linewidth=0.8)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
