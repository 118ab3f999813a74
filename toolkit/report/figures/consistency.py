"""NEES and NIS over time with their 95 % chi-square bands: one small panel an estimator, all on the same axes.

Bar-Shalom, Li and Kirubarajan, "Estimation with applications to tracking and navigation" (2001), section 5.4.
"""

from collections.abc import Callable, Iterator

import numpy as np

from toolkit.experiment.comparison import Comparison, Row
from toolkit.metrics import Evaluation, Unavailable
from toolkit.metrics.parts.consistency import POSE_DOF, nees_band, nees_over_time, nis_over_time
from toolkit.report.figures.panels import Drawn, Normalised, figure_with_bands
from toolkit.report.figures.style import NamedFigure, colour_of, shown_as

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


def draw_nees(comparison: Comparison) -> Iterator[NamedFigure]:
    """Yield the figure of the NEES where there is an independent truth."""
    yield from _figure(comparison, _nees, "nees_over_time", "pose NEES / 6", _OF_NEES)


def draw_nis(comparison: Comparison) -> Iterator[NamedFigure]:
    """Yield the figure of the NIS where any estimator reports innovations."""
    yield from _figure(comparison, _nis, "nis_over_time", "NIS / expected", _OF_NIS)


_OfRow = Callable[[Comparison, Row], Normalised]


def _figure(comparison: Comparison, of_row: _OfRow, name: str, what: str, caption: str) -> Iterator[NamedFigure]:
    drawn = list(_drawn(comparison, of_row))
    if drawn:
        estimators = list(dict.fromkeys(one.estimator for one in drawn))
        figure = figure_with_bands(estimators, drawn, what, f"{comparison.name}: {what}")
        yield NamedFigure(name, caption, figure)


def _drawn(comparison: Comparison, of_row: _OfRow) -> Iterator[Drawn]:
    for row in comparison.lines:
        if row.run.trajectory(row.output) is None:
            continue
        try:
            with np.errstate(all="ignore"):  # a diverged run may overflow; that is drawn at the edge
                yield Drawn(row.estimator, colour_of(comparison, row.estimator), shown_as(row), of_row(comparison, row))
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
