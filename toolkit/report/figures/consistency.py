"""NEES and NIS over time with their 95 % chi-square bands: one small panel an estimator, all on the same axes.

Bar-Shalom, Li and Kirubarajan, "Estimation with applications to tracking and navigation" (2001), section 5.4.
"""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np

from toolkit.estimate import Output
from toolkit.experiment.comparison import Comparison, Row
from toolkit.geometry import Array
from toolkit.metrics import Evaluation, Unavailable
from toolkit.metrics._shared.consistency import POSE_DOF, nees_band, nees_over_time, nis_over_time
from toolkit.report.figures.panels import (
    COLOUR_OF,
    RANGE,
    band_entry,
    finish,
    output_entries,
    panels_of,
    scale_by_decades,
    tell_shares,
)
from toolkit.report.figures.style import BAND_COLOUR, NamedFigure, line_of

_OF_NEES = (
    "Pose NEES of one run over its 6 degrees of freedom: the squared error over the covariance that the estimator "
    "states. In the band (grey) are 95 % of the frames of a consistent estimator; how many are stands above each "
    "panel. Above the band an estimator is too sure of itself, below it too timid. Errors of neighbouring frames "
    "belong together: a long stay outside may be one draw of luck, and only seeds tell."
)
_OF_NIS = (
    "Innovations of each frame, squared, over what the estimator's own covariances let expect of them behind its gate "
    "(NIS). It needs no truth. In the band (grey) are 95 % of the frames of a consistent filter; how many are stands "
    "above each panel. Its width is that of the run's own scatter from frame to frame: a gate makes a frame's "
    "innovations scatter less, the error of the pose that they share more. A long stay above it is of measurements "
    "that surprise the estimator more than they should."
)


class Normalised(NamedTuple):
    """Squared errors over their expectation at times (n,) s, and the band (n,), (n,) of a consistent estimator."""

    t_s: Array
    value: Array
    low: Array
    high: Array

    @property
    def in_band_percent(self) -> float:
        """Return the share of the values that are in the band."""
        return 100.0 * float(np.mean((self.value >= self.low) & (self.value <= self.high)))


def draw_nees(comparison: Comparison) -> Iterator[NamedFigure]:
    """Yield the figure of the NEES where there is an independent truth."""
    of_rows = list(_found(comparison, _nees))
    if of_rows:
        yield _figure(comparison, "pose NEES / 6", "nees_over_time", _OF_NEES, of_rows)


def draw_nis(comparison: Comparison) -> Iterator[NamedFigure]:
    """Yield the figure of the NIS where any estimator reports innovations."""
    of_rows = list(_found(comparison, _nis))
    if of_rows:
        yield _figure(comparison, "NIS / expected", "nis_over_time", _OF_NIS, of_rows)


def _found(comparison: Comparison, of_row: Callable[[Comparison, Row], Normalised]) -> Iterator[tuple[Row, Normalised]]:
    for row in comparison.lines:
        if row.run.trajectory(row.output) is None:
            continue
        try:
            with np.errstate(all="ignore"):  # a diverged run may overflow; that is drawn at the edge
                yield row, of_row(comparison, row)
        except Unavailable:
            continue


def _nees(comparison: Comparison, row: Row) -> Normalised:
    nees = nees_over_time(Evaluation(row.run, row.output, comparison.sequence))
    low, high = (np.full(nees.pose.size, side) for side in nees_band(POSE_DOF))
    return Normalised(comparison.sequence.elapsed_s(nees.t_ns), nees.pose, low, high)


def _nis(comparison: Comparison, row: Row) -> Normalised:
    evaluation = Evaluation(row.run, row.output, comparison.sequence)
    found = nis_over_time(evaluation)
    low, high = found.bands()
    t_s = comparison.sequence.elapsed_s(evaluation.estimate.t_ns[found.rows])
    return Normalised(t_s, found.nis / found.expected, low, high)


def _figure(
    comparison: Comparison, what: str, name: str, caption: str, of_rows: list[tuple[Row, Normalised]]
) -> NamedFigure:
    figure, panels = panels_of(list(dict.fromkeys(row.estimator for row, _ in of_rows)))
    shares: dict[str, list[float]] = {}
    least, most, kinds = 1.0, 1.0, set[Output]()
    for row, one in of_rows:
        axes, shown = panels[row.estimator], np.clip(one.value, *RANGE)
        # The output that is there alone has the colour and the line of the final one.
        kind: Output = "final" if row.label == "both" else row.output
        axes.fill_between(one.t_s, one.low, one.high, color=BAND_COLOUR, linewidth=0.0, zorder=1)
        axes.plot(one.t_s, shown, color=COLOUR_OF[kind], linestyle=line_of(kind), linewidth=1.0)
        shares.setdefault(row.estimator, []).append(one.in_band_percent)
        least, most = min(least, float(np.nanmin(shown)), float(one.low.min())), max(most, float(np.nanmax(shown)))
        kinds.add(kind)
    tell_shares(panels, shares)
    scale_by_decades(next(iter(panels.values())), max(0.7 * least, RANGE[0]), min(1.5 * most, RANGE[1]))
    finish(figure, panels, what, f"{comparison.name}: {what}", [*output_entries(kinds), band_entry()])
    return NamedFigure(name, caption, figure)
