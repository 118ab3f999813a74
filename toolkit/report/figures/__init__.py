"""The figures of a comparison as files, PNG, PDF or SVG, one module a figure; drawn without a display."""

import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Literal

from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.text import Text

from toolkit.errors import printable
from toolkit.experiment.comparison import Comparison
from toolkit.report.figures import (
    against_bound,
    components,
    consistency,
    error_map,
    errors_over_time,
    frame_times,
    over_seeds,
    reprojection,
    top_view,
)
from toolkit.report.figures.style import NamedFigure

FigureFormat = Literal["png", "pdf", "svg"]
# What formats note of the time a figure was drawn, which differs where nothing else does.
_DATE_OF: Mapping[FigureFormat, str] = {"pdf": "CreationDate", "svg": "Date"}
_Drawing = Callable[[Comparison], Iterator[NamedFigure]]
_OF_ONE: tuple[_Drawing, ...] = (
    top_view.draw_all,
    errors_over_time.draw,
    consistency.draw,
    components.draw,
    against_bound.draw,
    reprojection.draw,
    frame_times.draw,
    error_map.draw,
    top_view.draw_each,
)
_OVER_SEEDS: tuple[_Drawing, ...] = (over_seeds.draw,)


def drawn(comparison: Comparison) -> Iterator[NamedFigure]:
    """Draw every figure the comparison has data for."""
    drawings = _OVER_SEEDS if comparison.over_seeds else _OF_ONE
    return (_literal(figure) for drawing in drawings for figure in drawing(comparison))


def _literal(drawn_one: NamedFigure) -> NamedFigure:
    """Return a figure whose words are shown as they are: a name with dollar signs is no formula."""
    figure = drawn_one.figure
    parts = [part for part in figure.get_children() if not isinstance(part, Axes)]
    # Not the axes' ticks: they are numbers, and asking for them would make them.
    parts += [part for axes in figure.axes for part in axes.get_children() if not isinstance(part, Axis)]
    for text in {found for part in parts for found in part.findobj(Text)}:
        if isinstance(text, Text):
            text.set_parse_math(False)
            text.set_text("\n".join(map(printable, text.get_text().split("\n"))))
    return drawn_one


def save(figures: Iterable[NamedFigure], directory: Path, kind: FigureFormat = "png") -> dict[str, str]:
    """Save figures as files of a kind; return file name -> caption, in order. The same figures give the same bytes."""
    captions: dict[str, str] = {}
    with warnings.catch_warnings(), rc_context({"svg.hashsalt": "vislam", "svg.fonttype": "none"}):
        # A letter that the font lacks is drawn as a box; of that nothing is to be told.
        warnings.filterwarnings("ignore", "Glyph")
        for name, caption, figure in figures:
            undated = {_DATE_OF[kind]: None} if kind in _DATE_OF else {}
            figure.savefig(directory / f"{name}.{kind}", bbox_inches="tight", pad_inches=0.15, metadata=undated)
            captions[f"{name}.{kind}"] = caption
    return captions
