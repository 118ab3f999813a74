"""The world from above: all trajectories, one over its own landmarks, and all coloured by their error, a panel each.

The coloured panels share one scale, which is logarithmic: estimators differ by orders of magnitude.
"""

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

from toolkit.answers import Run
from toolkit.experiment.comparison import Comparison
from toolkit.files.writing import plain_name
from toolkit.geometry import Array
from toolkit.metrics.parts.against_truth import rmse
from toolkit.report.curves import alignment_text, errors_to, onto_truth, shown_output, truth_during
from toolkit.report.figures import style
from toolkit.report.figures.style import Entry, NamedFigure
from toolkit.report.text import number

_LANDMARK_QUANTILES = (0.02, 0.98)
_MARGIN = 0.05
# Landmarks widen the view by at most this share of the tracks' extent, and by this much where the camera hardly moved.
_LANDMARK_REACH = 0.5
_LEAST_REACH_M = 30.0
NOWHERE: Array = np.empty((0, 2))
_LINE_WIDTH, _TRUTH_WIDTH = 1.5, 4.0
# How high a map may be, and the room for labels and legend.
_HIGHEST_IN, _LOWEST_IN, _LABELS_IN = 6.0, 2.3, 0.9


class View(NamedTuple):
    """The rectangle from ``low`` (2,) to ``high`` (2,), x and y in metres."""

    low: Array
    high: Array

    @property
    def ratio(self) -> float:
        width, height = self.high - self.low
        return float(height / width)

    def show(self, axes: Axes) -> None:
        axes.set_xlim(self.low[0], self.high[0])
        axes.set_ylim(self.low[1], self.high[1])
        axes.set_aspect("equal", adjustable="box")


def from_above(comparison: Comparison, run: Run, points_world: Array) -> Array:
    """Return x and y (M, 2) of the finite ones among points (N, 3), moved with the run onto the truth."""
    alignment = onto_truth(run, shown_output(run), comparison.sequence)
    finite = points_world[np.isfinite(points_world).all(axis=1)]
    above: Array = (finite @ alignment.rotation.T + alignment.translation)[:, :2]
    return above


def _track(comparison: Comparison, run: Run) -> Array:
    """Return a run's final answer from above (M, 2), without poses that are not finite; nothing of no trajectory."""
    trajectory = run.trajectory(shown_output(run))
    return NOWHERE if trajectory is None else from_above(comparison, run, trajectory.positions)


def _true_track(comparison: Comparison) -> Array:
    truth = truth_during(comparison.sequence)
    return NOWHERE if truth is None else truth.T_world_imu[:, :2, 3]


def view_of(tracks: Sequence[Array], landmarks: Array) -> View:
    """Return the view of all of the tracks (N, 2) and of all but the farthest of the landmarks (M, 2) near them."""
    track = np.vstack([NOWHERE, *tracks])
    if not track.size:
        track = np.zeros((1, 2))
    corners = np.quantile(landmarks, _LANDMARK_QUANTILES, axis=0) if len(landmarks) else NOWHERE
    reach = max(_LANDMARK_REACH * float(np.ptp(track, axis=0).max()), _LEAST_REACH_M)
    shown = np.vstack([track, np.clip(corners, track.min(axis=0) - reach, track.max(axis=0) + reach)])
    low, high = shown.min(axis=0), shown.max(axis=0)
    margin = max(_MARGIN * float((high - low).max()), 0.5)
    return View(low - margin, high + margin)


def draw_all(comparison: Comparison) -> Iterator[NamedFigure]:
    """Yield all trajectories in one figure, over the landmarks of the last run that is ok and has some."""
    runs = [run for run in comparison.runs if run.trajectory(shown_output(run)) is not None]
    if not runs:
        return
    mapper = next((run for run in reversed(runs) if run.status == "ok" and len(run.landmarks)), None)
    of_whom = "" if mapper is None else f" over the landmarks of {mapper.estimator}"
    caption = f"All trajectories{of_whom}, each from its dot on. {alignment_text(comparison.sequence)}"
    if any(run.status != "ok" for run in runs):
        caption += " One that is not ok may leave the picture."
    title = f"{comparison.name}: all estimators, from above"
    yield NamedFigure("top_all", caption, _figure(comparison, runs, mapper, title))


def draw_each(comparison: Comparison) -> Iterator[NamedFigure]:
    """Yield a top view for each run that has a trajectory, over its own landmarks."""
    for run in comparison.runs:
        if run.trajectory(shown_output(run)) is not None:
            map_size = f"{len(run.landmarks)} landmarks" if len(run.landmarks) else "it makes no map"
            where = f"Trajectory of {run.estimator} from above, from the dot on"
            figure = _figure(comparison, [run], run, f"{_name(run)} on {comparison.name}, from above")
            caption = f"{where}; {map_size}. {alignment_text(comparison.sequence)}"
            yield NamedFigure(f"top_{plain_name(run.estimator)}", caption, figure)


def _figure(comparison: Comparison, runs: Sequence[Run], mapper: Run | None, title: str) -> Figure:
    truth, tracks = _true_track(comparison), [_track(comparison, run) for run in runs]
    # A run that diverged would squash all the others; its own figure shows where it went.
    shown = [track for track, run in zip(tracks, runs, strict=True) if run.status == "ok" or len(runs) == 1]
    landmarks = NOWHERE if mapper is None else from_above(comparison, mapper, mapper.landmarks.points_world)
    view = view_of([*shown, truth], landmarks)
    figure = style.new_figure(min(max(style.WIDTH_IN * view.ratio, _LOWEST_IN), _HIGHEST_IN) + _LABELS_IN)
    axes, entries = figure.subplots(), []
    if len(truth):
        axes.plot(*truth.T, color=style.TRUTH_COLOUR, linewidth=_TRUTH_WIDTH, zorder=2)
        entries.append(Entry.of_line("truth", style.TRUTH_COLOUR, width=_TRUTH_WIDTH))
    for run, track in zip(runs, tracks, strict=True):
        width = _LINE_WIDTH if len(runs) == 1 else style.width_of(comparison, run.estimator)
        stroke = style.stroke_of(comparison.estimators, run.estimator, shown_output(run))
        axes.plot(*track.T, linewidth=width, zorder=3, **stroke)
        axes.plot(*track[:1].T, "o", color=stroke["color"], ms=5.0, markeredgecolor="white", zorder=4)
        entries.append(Entry.of_line(_name(run), stroke["color"], stroke["linestyle"], 1.8))
    if mapper is not None and len(mapper.landmarks):
        x, y = landmarks.T
        dots = axes.scatter(x, y, s=3.0, color=style.LANDMARK_COLOUR, alpha=0.5, linewidths=0, zorder=1)
        entries.append(Entry(f"landmarks of {mapper.estimator}", dots))
    view.show(axes)
    style.label_axes(axes, title, "x [m]", "y [m]")
    style.legend_below(figure, entries)
    return figure


def _name(run: Run) -> str:
    return run.estimator if run.status == "ok" else f"{run.estimator} ({run.status})"


# Plasma (Smith and van der Walt 2015) without its yellow, which white paper swallows: legible for the colour-blind.
_COLOURS = LinearSegmentedColormap.from_list("plasma without yellow", colormaps["plasma"](np.linspace(0.0, 0.85, 64)))
_QUANTILES = (0.02, 0.99)
_LEAST_M = 1e-4
_LEAST_SPAN = 3.0  # of the colour scale, as a ratio: errors that are all alike shall look so
_BAR_IN, _TITLE_IN = 1.1, 0.3


class _Coloured(NamedTuple):
    """What a panel shows: a run's distance (n,) m to the truth at points (n, 2) m of its way."""

    run: Run
    points: Array
    value: Array


def draw_trajectories(comparison: Comparison) -> Iterator[NamedFigure]:
    """Yield trajectories coloured by position error, a panel an estimator over one view, where there is a truth."""
    coloured = [found for run in comparison.runs if (found := _by_position(comparison, run)) is not None]
    if coloured:
        yield _coloured_figure(comparison, coloured)


def _by_position(comparison: Comparison, run: Run) -> _Coloured | None:
    truth, trajectory = truth_during(comparison.sequence), run.trajectory(shown_output(run))
    if truth is None or trajectory is None:
        return None
    alignment = onto_truth(run, shown_output(run), comparison.sequence)
    errors = errors_to(truth, trajectory, alignment, comparison.sequence)
    if errors is None:
        return None
    t_ns = trajectory.t_ns[np.isfinite(trajectory.positions).all(axis=1)]
    points = [np.interp(errors.t_ns, t_ns, along) for along in _track(comparison, run).T]
    return _Coloured(run, np.stack(points, axis=1), errors.position_m)


def _coloured_figure(comparison: Comparison, shown: Sequence[_Coloured]) -> NamedFigure:
    truth = _true_track(comparison)
    good = [one for one in shown if one.run.status == "ok"] or list(shown)
    view = view_of([truth, *(one.points for one in good)], NOWHERE)
    scale = ScalarMappable(_norm(np.concatenate([one.value for one in good])), _COLOURS)
    names = [_name(one.run) for one in shown]
    panel_in = (style.WIDTH_IN - _BAR_IN) / style.columns_for(len(names)) * view.ratio + _TITLE_IN
    figure, panels = style.panels_of(names, "", panel_in)
    for axes, one in zip(panels.values(), shown, strict=True):
        view.show(axes)
        axes.plot(*truth.T, color=style.TRUTH_COLOUR, linewidth=0.6, zorder=3)
        axes.add_collection(_line(one, scale))
        style.annotate(axes, f"{number(rmse(one.value))} m")
    bar = figure.colorbar(scale, ax=list(panels.values()), shrink=0.9, aspect=35, pad=0.02, extend="both")
    bar.set_label("position error [m]", fontsize=style.LABEL_PT)
    bar.ax.tick_params(labelsize=style.TICK_PT)
    bar.ax.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0), numticks=8))
    bar.ax.yaxis.set_major_formatter("{x:g}")
    bar.ax.yaxis.set_minor_locator(NullLocator())
    style.add_title(figure, f"{comparison.name}: position error, from above")
    figure.supxlabel("x [m]", fontsize=style.LABEL_PT)
    figure.supylabel("y [m]", fontsize=style.LABEL_PT)
    caption = (
        "Trajectories from above, coloured by the distance to the truth (thin line); its RMS stands above each. "
        f"{alignment_text(comparison.sequence)} All panels have one scale of colours, which is logarithmic."
    )
    return NamedFigure("trajectory_error", caption, figure)


def _line(one: _Coloured, scale: ScalarMappable) -> LineCollection:
    """Return a trajectory as a line whose pieces have the colour of the error where each begins."""
    pieces = np.stack([one.points[:-1], one.points[1:]], axis=1)
    return LineCollection(list(pieces), colors=scale.to_rgba(one.value[:-1]), linewidths=3.0, zorder=2)


def _norm(value: Array) -> LogNorm:
    """Return a scale that holds nearly all of the values (n,), and spans some even where they are all alike."""
    low, high = np.maximum(np.quantile(value, _QUANTILES), _LEAST_M)
    widen = max(1.0, float(np.sqrt(_LEAST_SPAN * low / high)))
    return LogNorm(float(low) / widen, float(high) * widen)
