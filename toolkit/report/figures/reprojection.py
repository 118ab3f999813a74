"""Histograms of the reprojection error: the estimator's own landmarks, and the tracks withheld from it."""

from collections.abc import Callable, Iterator

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import NullLocator

from toolkit.answers import Run
from toolkit.experiment.comparison import Comparison
from toolkit.geometry import Array
from toolkit.metrics import Evaluation, reprojection
from toolkit.metrics.parts.leave_one_out import CAP_PX
from toolkit.report.curves import available, shown_output
from toolkit.report.figures import style
from toolkit.report.figures.style import Entry, NamedFigure

# A logarithmic axis shows the bulk of a good estimator, that of a bad one and the mismatches in one picture.
_SMALLEST_PX = 0.01
_BINS = np.geomspace(_SMALLEST_PX, CAP_PX, 61)
_KINDS: dict[str, Callable[[Evaluation], Array]] = {
    "in-sample": reprojection.in_sample_errors,
    "held-out": reprojection.held_out_errors,
}


def draw(comparison: Comparison) -> Iterator[NamedFigure]:
    """Yield the histograms, one panel an estimator; nothing where there is nothing to reproject."""
    errors = {run.estimator: _errors_px(comparison, run) for run in comparison.runs}
    drawable = {name: kinds for name, kinds in errors.items() if kinds}
    if not drawable:
        return
    figure, panels = style.panels_of(list(drawable), "reprojection error [px]")
    for name, kinds in drawable.items():
        for kind, error_px in kinds.items():
            _histogram(panels[name], kind, error_px, style.colour_of(comparison, name))
        medians = " / ".join(f"{float(np.median(error_px)):.2f}" for error_px in kinds.values())
        style.annotate(panels, name, (f"median {medians} px", f"{medians} px"))
    first = next(iter(panels.values()))
    first.set_xscale("log")
    first.set_xlim(_SMALLEST_PX, CAP_PX)
    first.set_ylim(bottom=0.0)
    for axes in panels.values():
        axes.xaxis.set_major_formatter("{x:g}")
        axes.xaxis.set_minor_locator(NullLocator())
    style.finish(
        figure, panels, "share [%]", f"{comparison.name}: reprojection error of every sighting", _entries(drawable)
    )
    caption = (
        "Reprojection error of every sighting: the root mean square of its uL, uR and v residuals. Filled: against the "
        "estimator's own landmarks (in-sample). Outlined: of the tracks withheld from every estimator (held-out). The "
        "medians are marked and stand above each panel. The axis is logarithmic; its ends stand for all below "
        f"{_SMALLEST_PX:g} px, and for all that is {CAP_PX:g} px off or more or behind the camera."
    )
    yield NamedFigure("reprojection", caption, figure)


def _entries(drawable: dict[str, dict[str, Array]]) -> list[Entry]:
    samples: dict[str, Artist] = {
        "in-sample": Patch(color=style.MUTED_COLOUR, alpha=0.35, linewidth=0.0),
        "held-out": Line2D([], [], color=style.MUTED_COLOUR, linewidth=1.5),
    }
    shown = {kind for kinds in drawable.values() for kind in kinds}
    return [Entry(kind, (sample,)) for kind, sample in samples.items() if kind in shown]


def _errors_px(comparison: Comparison, run: Run) -> dict[str, Array]:
    found = {
        kind: available(errors_of, run, shown_output(run), comparison.sequence) for kind, errors_of in _KINDS.items()
    }
    return {kind: error_px for kind, error_px in found.items() if error_px is not None and error_px.size}


def _histogram(axes: Axes, kind: str, error_px: Array, colour: str) -> None:
    median_px = float(np.median(error_px))
    counts, _ = np.histogram(np.maximum(error_px, _SMALLEST_PX), bins=_BINS)
    share = 100.0 * counts / error_px.size
    # One outline: sixty bars look the same and take longer to draw.
    if kind == "in-sample":
        axes.stairs(share, _BINS, fill=True, color=colour, alpha=0.35)
        axes.axvline(median_px, color=colour, linewidth=1.0, alpha=0.5)
    else:
        axes.stairs(share, _BINS, color=colour, linewidth=1.2)
        axes.axvline(median_px, color=colour, linewidth=1.0)
