"""Maps coloured by error, from above, a panel an estimator: trajectories by position error, landmarks by reprojection.

All panels of a figure share one scale of colours, which is logarithmic: estimators differ by orders of magnitude.
"""

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import LinearSegmentedColormap, LogNorm
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullLocator

from toolkit.estimate import Run
from toolkit.experiment.comparison import Comparison
from toolkit.geometry import Array
from toolkit.metrics import Evaluation, Unavailable, reprojection
from toolkit.metrics.parts.against_truth import rmse
from toolkit.report.curves import alignment_text, errors_to, onto_truth, shown_output, truth_during
from toolkit.report.figures.style import (
    LABEL_PT,
    MUTED_COLOUR,
    SMALL_PT,
    TICK_PT,
    TITLE_PT,
    TRUTH_COLOUR,
    WIDTH_IN,
    NamedFigure,
    new_figure,
    style_axes,
)
from toolkit.report.figures.top_view import (
    NOWHERE,
    PathFromAbove,
    View,
    from_above,
    landmarks_shown,
    track_of,
    true_track,
    view_of,
)
from toolkit.report.text import number

# Plasma (Smith and van der Walt 2015) without its yellow, which white paper swallows: legible for the colour-blind.
_COLOURS = LinearSegmentedColormap.from_list("plasma without yellow", colormaps["plasma"](np.linspace(0.0, 0.85, 64)))
_QUANTILES = (0.02, 0.99)
_LEAST_SPAN = 3.0  # of the colour scale, as a ratio: errors that are all alike shall look so
_BAR_IN, _SHAPE, _MOST_COLUMNS = 1.1, 0.8, 4  # height over width


class _Coloured(NamedTuple):
    """What a panel shows: where a run went, and what is coloured, at points (n, 2) m by values (n,)."""

    run: Run
    track: PathFromAbove
    points: Array
    value: Array


class _Kind(NamedTuple):
    """How one of the figures is named, what its colours say, in which unit and from which value on, and its caption."""

    name: str
    what: str
    unit: str
    least: float
    caption: str


_TRAJECTORY = _Kind(
    "trajectory_error",
    "position error",
    "m",
    1e-4,
    "Trajectories from above, coloured by the distance to the truth (thin line); its RMS stands above each.",
)
_MAP = _Kind(
    "map_error",
    "reprojection error",
    "px",
    0.05,
    "Each estimator's landmarks from above and its trajectory (thin line). The colour of a landmark is the root mean "
    "square of its reprojection errors, over two sightings or more; the median landmark's stands above each.",
)
_SCALE = "All panels have one scale of colours, which is logarithmic."


def draw_trajectories(comparison: Comparison) -> Iterator[NamedFigure]:
    """Yield trajectories by position error, where there is a truth."""
    coloured = [found for run in comparison.runs if (found := _by_position(comparison, run)) is not None]
    if coloured:
        yield _figure(comparison, coloured, _TRAJECTORY)


def draw_maps(comparison: Comparison) -> Iterator[NamedFigure]:
    """Yield landmarks by reprojection error, where any estimator has landmarks."""
    coloured = [found for run in comparison.runs if (found := _by_pixel(comparison, run)) is not None]
    if coloured:
        yield _figure(comparison, coloured, _MAP)


def _by_position(comparison: Comparison, run: Run) -> _Coloured | None:
    """Return a run's trajectory coloured by its distance to the truth, or None without a truth or a trajectory."""
    truth, trajectory = truth_during(comparison.sequence), run.trajectory(shown_output(run))
    if truth is None or trajectory is None:
        return None
    alignment = onto_truth(run, shown_output(run), comparison.sequence)
    errors = errors_to(truth, trajectory, alignment, comparison.sequence)
    if errors is None:
        return None
    track = track_of(comparison, run)
    points = np.stack([np.interp(errors.t_ns, track.t_ns, xy) for xy in track.xy.T], axis=1)
    return _Coloured(run, track, points, errors.position_m)


def _by_pixel(comparison: Comparison, run: Run) -> _Coloured | None:
    """Return a run's landmarks coloured by their reprojection error, or None where it has none."""
    if run.trajectory(shown_output(run)) is None:
        return None
    try:
        with np.errstate(all="ignore"):  # a diverged run may overflow; the metric caps what comes of it
            ids, error_px = reprojection.errors_of_landmarks(Evaluation(run, shown_output(run), comparison.sequence))
    except Unavailable:
        return None
    points = run.landmarks.points_world[np.searchsorted(run.landmarks.track_ids, ids)]
    finite = np.isfinite(points).all(axis=1)
    above = from_above(comparison, run, points[finite])
    return _Coloured(run, track_of(comparison, run), above, error_px[finite]) if finite.any() else None


def _figure(comparison: Comparison, shown: Sequence[_Coloured], kind: _Kind) -> NamedFigure:
    """Draw a panel an estimator, all over one view and with one scale of colours."""
    truth = true_track(comparison)
    good = [one for one in shown if one.run.status == "ok"] or list(shown)
    tracks = [one.track for one in good] + ([] if truth is None else [truth])
    view = view_of(tracks, landmarks_shown(np.vstack([one.points for one in good])) if kind is _MAP else NOWHERE)
    scale = ScalarMappable(_norm(np.concatenate([one.value for one in good]), kind.least), _COLOURS)
    figure, panels = _panels([one.run for one in shown], view)
    for axes, one in zip(panels, shown, strict=True):
        if kind is _MAP:
            axes.plot(*one.track.xy.T, color=TRUTH_COLOUR, linewidth=0.8, zorder=3)
            axes.scatter(one.points[:, 0], one.points[:, 1], s=2.5, c=scale.to_rgba(one.value), linewidths=0, zorder=2)
            middle = float(np.median(one.value))
        else:
            if truth is not None:
                axes.plot(*truth.xy.T, color=TRUTH_COLOUR, linewidth=0.6, zorder=3)
            axes.add_collection(_line(one, scale))
            middle = rmse(one.value)
        axes.set_title(f"{number(middle)} {kind.unit}", fontsize=SMALL_PT, loc="right", color=MUTED_COLOUR)
    bar = figure.colorbar(scale, ax=panels, shrink=0.9, aspect=35, pad=0.02, extend="both")
    bar.set_label(f"{kind.what} [{kind.unit}]", fontsize=LABEL_PT)
    bar.ax.tick_params(labelsize=TICK_PT)
    bar.ax.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0), numticks=8))
    bar.ax.yaxis.set_major_formatter("{x:g}")
    bar.ax.yaxis.set_minor_locator(NullLocator())
    figure.suptitle(f"{comparison.name}: {kind.what}, from above", fontsize=TITLE_PT, x=0.01, ha="left")
    figure.supxlabel("x [m]", fontsize=LABEL_PT)
    figure.supylabel("y [m]", fontsize=LABEL_PT)
    return NamedFigure(kind.name, f"{kind.caption} {alignment_text(comparison.sequence)} {_SCALE}", figure)


def _line(one: _Coloured, scale: ScalarMappable) -> LineCollection:
    """Return a trajectory as a line whose pieces have the colour of the error where each begins."""
    pieces = np.stack([one.points[:-1], one.points[1:]], axis=1)
    return LineCollection(list(pieces), colors=scale.to_rgba(one.value[:-1]), linewidths=3.0, zorder=2)


def _norm(value: Array, least: float) -> LogNorm:
    """Return a scale that holds nearly all of the values (n,), and spans some even where they are all alike."""
    low, high = np.maximum(np.quantile(value, _QUANTILES), least)
    widen = max(1.0, float(np.sqrt(_LEAST_SPAN * low / high)))
    return LogNorm(float(low) / widen, float(high) * widen)


def _panels(runs: Sequence[Run], view: View) -> tuple[Figure, list[Axes]]:
    """Return a figure with a panel a run, each of which shows the view."""
    columns = _columns(len(runs), view.ratio)
    rows = -(-len(runs) // columns)
    panel_in = (WIDTH_IN - _BAR_IN) / columns
    figure = new_figure(0.6 + rows * (panel_in * view.ratio + 0.3))
    grid = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False).ravel()
    panels = list(grid[: len(runs)])
    for axes in grid[len(runs) :]:
        axes.remove()
    for axes, run in zip(panels, runs, strict=True):
        style_axes(axes, run.estimator if run.status == "ok" else f"{run.estimator} ({run.status})", "", "")
        view.show(axes)
    for axes in panels[-columns:]:
        axes.tick_params(labelbottom=True)
    return figure, panels


def _columns(count: int, ratio: float) -> int:
    """Return how many panels of a height over width stand in a row: a figure of pleasing shape without empty places."""

    def misfit(columns: int) -> float:
        rows = -(-count // columns)
        return abs(math.log(rows * ratio / columns / _SHAPE)) + (rows * columns - count) / count

    return min(range(1, min(count, _MOST_COLUMNS) + 1), key=misfit)
