"""The figures of a comparison as PNG files, one module a figure; drawn without a display."""

from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

from toolkit.experiment.comparison import Comparison
from toolkit.report.figures import errors_over_time, frame_times, over_seeds, reprojection, top_view
from toolkit.report.figures.style import NamedFigure

_Drawing = Callable[[Comparison], Iterator[NamedFigure]]
_OF_ONE: tuple[_Drawing, ...] = (top_view.draw, errors_over_time.draw, reprojection.draw, frame_times.draw)
_OVER_SEEDS: tuple[_Drawing, ...] = (over_seeds.draw,)


def drawn(comparison: Comparison) -> Iterator[NamedFigure]:
    """Draw every figure the comparison has data for."""
    return (figure for drawing in (_OVER_SEEDS if comparison.over_seeds else _OF_ONE) for figure in drawing(comparison))


def save(figures: Iterable[NamedFigure], directory: Path) -> dict[str, str]:
    """Save figures as PNG files; return file name -> caption, in order."""
    captions: dict[str, str] = {}
    for name, caption, figure in figures:
        figure.savefig(directory / f"{name}.png", bbox_inches="tight", pad_inches=0.15)
        captions[f"{name}.png"] = caption
    return captions
