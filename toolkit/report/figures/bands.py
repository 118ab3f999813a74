"""A panel an estimator: NEES and NIS in their 95 % bands, and errors over seeds.

Bar-Shalom, Li and Kirubarajan, "Estimation with applications to tracking and navigation" (2001), section 5.4.
"""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from toolkit.answers import Output
from toolkit.experiment.comparison import Comparison, Row
from toolkit.geometry import Array
from toolkit.report.curves import computed_or_reason, nees_series, nis_series, shown_as
from toolkit.report.figures import style
from toolkit.report.figures.style import Entry, NamedFigure

# Values of a NEES or NIS over its expectation beyond these are drawn at the limit, and the panel gives the largest.
RANGE = (1e-2, 1e4)
_OF_NEES = (
    "Pose NEES of one run over its 6 degrees of freedom: the squared error over the covariance that the estimator "
    "states. In the band (grey) are 95 % of the frames of a consistent estimator; how many are stands above each "
    "panel. Above the band an estimator is overconfident, below it timid. Errors of neighbouring frames are "
    "correlated: a long stay outside may be chance, and only several seeds can decide."
)
_OF_NIS = (
    "Innovations of each frame, squared, over what the estimator's own covariances predict behind its gate "
    "(NIS). It needs no truth. In the band (grey) are 95 % of the frames of a consistent filter; how many are stands "
    "above each panel. Its width is that of the run's own scatter from frame to frame: a gate makes a frame's "
    "innovations scatter less, the error of the pose that they share more. A long stay above it means innovations "
    "larger than the estimator expects."
)


class Normalised(NamedTuple):
    """Squared errors (n,) over their expectation, NaN if unknown, at times (n,) s, and the band of consistent ones."""

    t_s: Sequence[float] | Array
    value: Array
    low: Array | float
    high: Array | float

    @property
    def in_band_percent(self) -> float:
        known = ~np.isnan(self.value)
        return 100.0 * float(np.mean(((self.value >= self.low) & (self.value <= self.high))[known]))


def _figure(comparison: Comparison, found: Sequence[tuple[Row, Normalised]], what: str) -> Figure:
    """Draw each row's normalised errors over their band, in a panel an estimator that says how many are in it."""
    figure, panels = style.panels_of(list(dict.fromkeys(row.estimator for row, _ in found)))
    shares: dict[str, list[str]] = {}
    least = most = 1.0
    for row, series in found:
        axes, colour = panels[row.estimator], style.stroke_of(comparison.estimators, row.estimator)["color"]
        shown = np.clip(series.value, *RANGE)
        axes.fill_between(series.t_s, series.low, series.high, color=style.BAND_COLOUR, linewidth=0.0, zorder=1)
        axes.plot(series.t_s, shown, color=colour, linestyle=style.line_of(shown_as(row)), linewidth=1.0)
        shares.setdefault(row.estimator, []).append(f"{series.in_band_percent:.0f} %")
        style.annotate(axes, ", ".join(shares[row.estimator]))
        least = float(np.fmin.reduce(np.append(shown, series.low), initial=least))
        most = float(np.fmax.reduce(np.append(shown, series.high), initial=most))
    style.scale_by_decades(next(iter(panels.values())), max(0.7 * least, RANGE[0]), min(1.5 * most, RANGE[1]))
    entries = style.output_entries({shown_as(row) for row, _ in found})
    seeds = f", {len(comparison.seeds)} seeds: mean" if comparison.over_seeds else ":"
    band = Entry("95 % band", Patch(color=style.BAND_COLOUR, linewidth=0.0))
    style.finish(figure, panels, what, f"{comparison.name}{seeds} {what}", [*entries, band])
    return figure


def draw_nees(comparison: Comparison) -> Iterator[NamedFigure]:
    found = [
        (row, Normalised(series.t_s, np.array(series.pose, float), *series.band))
        for row in comparison.lines
        if not isinstance(series := computed_or_reason(nees_series, row.run, row.output, comparison.sequence), str)
    ]
    if found:
        yield NamedFigure("nees_over_time", _OF_NEES, _figure(comparison, found, "pose NEES / 6"))


def draw_nis(comparison: Comparison) -> Iterator[NamedFigure]:
    found = [
        (row, Normalised(series.t_s, *(np.array(one, float) for one in (series.per_dof, series.low, series.high))))
        for row in comparison.lines
        if not isinstance(series := computed_or_reason(nis_series, row.run, row.output, comparison.sequence), str)
    ]
    if found:
        yield NamedFigure("nis_over_time", _OF_NIS, _figure(comparison, found, "NIS / expected"))


def draw_over_seeds(over: Comparison) -> Iterator[NamedFigure]:
    """Yield the figure of position errors and that of NEES, each where there is anything to draw."""
    if any(group.position_m is not None for group in over.rows):
        yield _errors(over)
    means = [(group, nees) for group in over.lines if (nees := group.mean_nees) is not None]
    if means:
        t_s = over.sequence.frames_s
        found = [(group, Normalised(t_s, nees.mean, nees.low, nees.high)) for group, nees in means]
        caption = (
            f"Pose NEES over its 6 degrees of freedom on {over.name}, averaged over the runs that are ok of "
            f"{len(over.seeds)} seeds, and the 95 % chi-square band of a consistent estimator (grey). Above the band "
            f"an estimator is overconfident. What is beyond {RANGE[0]:g} and {RANGE[1]:g} is drawn there."
        )
        yield NamedFigure("nees_over_seeds", caption, _figure(over, found, "pose NEES / 6"))


def _errors(over: Comparison) -> NamedFigure:
    figure, panels = style.panels_of(over.estimators)
    kinds: set[Output] = set()
    for group in over.lines:
        errors_m = group.position_m
        if errors_m is None:
            continue
        known = np.isfinite(errors_m).any(axis=0)
        lower, median, upper = np.nanpercentile(errors_m[:, known], [25.0, 50.0, 75.0], axis=0)
        kind = shown_as(group)
        axes, t_s = panels[group.estimator], over.sequence.frames_s[known]
        colour = style.stroke_of(over.estimators, group.estimator)["color"]
        axes.fill_between(t_s, lower, upper, color=colour, alpha=0.2, linewidth=0.0)
        axes.plot(t_s, median, color=colour, linestyle=style.line_of(kind), linewidth=1.2)
        kinds.add(kind)
    title = f"{over.name}, {len(over.seeds)} seeds: position error from the common start"
    quartiles = Entry("quartiles (lines: medians)", Patch(color=style.MUTED_COLOUR, alpha=0.2))
    style.finish(figure, panels, "position error [m]", title, [*style.output_entries(kinds), quartiles])
    next(iter(panels.values())).set_ylim(bottom=0.0)
    caption = (
        f"Position error over time on {over.name}, {len(over.seeds)} seeds, from the common start: the median and, "
        "shaded, the quartiles over the runs that are ok. Dashed: causal, what was known at the time. Solid: final."
    )
    return NamedFigure("errors_over_seeds", caption, figure)
