"""Histograms of the reprojection error: the estimator's own landmarks, and the tracks withheld from it."""

from collections.abc import Callable, Iterator

import numpy as np
from matplotlib.axes import Axes

from toolkit.estimate import Run
from toolkit.experiment.comparison import Comparison
from toolkit.geometry import Array
from toolkit.metrics import Evaluation, held_out, in_sample
from toolkit.metrics._shared.residuals import CAP_PX
from toolkit.metrics._shared.scores import Unavailable
from toolkit.report.figures.style import NamedFigure, colour_of, new_figure, quiet
from toolkit.report.figures.top_view import last_word

# A logarithmic axis shows the bulk of a good estimator, that of a bad one and the mismatches in one picture.
_SMALLEST_PX = 0.01
_FAR_PX = 3.0
_BINS = np.geomspace(_SMALLEST_PX, CAP_PX, 61)


def draw(comparison: Comparison) -> Iterator[NamedFigure]:
    """Yield the histograms, one panel an estimator; nothing where there is nothing to reproject."""
    errors = {run.estimator: _errors_px(comparison, run) for run in comparison.runs}
    drawable = {name: kinds for name, kinds in errors.items() if kinds}
    if not drawable:
        return
    figure = new_figure(9.6, 1.2 + 1.7 * len(drawable))
    panels = figure.subplots(len(drawable), 1, sharex=True, squeeze=False)[:, 0]
    for axes, (name, kinds) in zip(panels, drawable.items(), strict=True):
        for kind, error_px in kinds.items():
            _histogram(axes, kind, error_px, colour_of(comparison, name))
        quiet(axes, f"{comparison.sequence.name}: {name}", "", "share [%]")
        axes.set_xscale("log")
        axes.set_xlim(_SMALLEST_PX, CAP_PX)
        axes.xaxis.set_major_formatter("{x:g}")
        axes.legend(frameon=False, fontsize=9, loc="upper left", bbox_to_anchor=(1.0, 1.05))
    panels[-1].set_xlabel("reprojection error: root mean square of the uL, uR, v residuals [px]")
    caption = (
        "Reprojection error of every sighting. Filled: against the estimator's own landmarks (in-sample). Outlined: "
        "of the tracks withheld from every estimator. Thin lines: the medians. The axis is logarithmic; its ends "
        f"stand for all below {_SMALLEST_PX:g} px, and for all that is {CAP_PX:g} px off or more or behind the camera."
    )
    yield NamedFigure("reprojection", caption, figure)


def _errors_px(comparison: Comparison, run: Run) -> dict[str, Array]:
    """Return the errors (n,) px by kind, without the kinds the run has none of."""
    if run.trajectory(last_word(run)) is None:
        return {}
    evaluation = Evaluation(run, last_word(run), comparison.sequence)
    kinds: dict[str, Callable[[Evaluation], Array]] = {"in-sample": in_sample.errors, "held-out": held_out.errors}
    found = {}
    for kind, errors_of in kinds.items():
        try:
            with np.errstate(all="ignore"):  # a diverged run may overflow; the metrics cap what comes of it
                found[kind] = errors_of(evaluation)
        except Unavailable:
            continue
    return {kind: error_px for kind, error_px in found.items() if error_px.size}


def _histogram(axes: Axes, kind: str, error_px: Array, colour: str) -> None:
    median_px = float(np.median(error_px))
    label = (
        f"{kind}: median {median_px:.2f} px\n({100.0 * float(np.mean(error_px > _FAR_PX)):.1f} % above {_FAR_PX:g} px)"
    )
    counts, _ = np.histogram(np.maximum(error_px, _SMALLEST_PX), bins=_BINS)
    share = 100.0 * counts / error_px.size
    # One outline: sixty bars look the same and take longer to draw.
    if kind == "in-sample":
        axes.stairs(share, _BINS, fill=True, color=colour, alpha=0.35, label=label)
        axes.axvline(median_px, color=colour, linewidth=1.0, alpha=0.5)
    else:
        axes.stairs(share, _BINS, color=colour, linewidth=1.5, label=label)
        axes.axvline(median_px, color=colour, linewidth=1.0)
