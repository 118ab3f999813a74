"""The figures of a comparison as files, PNG, PDF or SVG; drawn without a display.

Reading order: style -> comparison, whose numbers are those of report.curves; trials has the figures of a sweep and of
an explanation, trajectories those of trajectory files.
"""

import warnings
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.text import Text

from toolkit.errors import printable
from toolkit.report import FigureFormat
from toolkit.report.figures.style import NamedFigure

if TYPE_CHECKING:
    from toolkit.experiment.comparison import Comparison

# Text stays text in an SVG; in a PDF fonts are whole, as publishers ask (no Type 3).
_IN_FILES: Any = {"svg.hashsalt": "vislam", "svg.fonttype": "none", "pdf.fonttype": 42}
# Metadata with the time of drawing, by format; they are removed so that the same figure gives the same bytes.
_DATE_OF: Mapping[FigureFormat, str] = {"pdf": "CreationDate", "svg": "Date"}


def drawn(comparison: "Comparison", choice: Literal["few", "all"] = "all") -> Iterator[NamedFigure]:
    """Draw the few most important figures, or all that the comparison has data for, each when it is reached."""
    # With GTSAM, which figures of trajectory files do without.
    from toolkit.report.figures import comparison as of

    # Figures that are always drawn, and those drawn on request, because drawing takes time and few are looked at.
    few = (of.draw_all, of.draw_errors, of.draw_telling_components, of.draw_nees, of.draw_bound)
    more = (of.draw_nis, of.draw_other_components, of.draw_each)
    drawings = (of.draw_over_seeds,) if comparison.over_seeds else few + (more if choice == "all" else ())
    return (literal(figure) for drawing in drawings for figure in drawing(comparison))


def literal(drawn_one: NamedFigure) -> NamedFigure:
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
    with warnings.catch_warnings(), rc_context(_IN_FILES):
        # A letter that the font lacks is drawn as a box; the warning about it is suppressed.
        warnings.filterwarnings("ignore", "Glyph")
        for name, caption, figure in figures:
            undated = {_DATE_OF[kind]: None} if kind in _DATE_OF else {}
            figure.savefig(directory / f"{name}.{kind}", bbox_inches="tight", pad_inches=0.15, metadata=undated)
            captions[f"{name}.{kind}"] = caption
    return captions
