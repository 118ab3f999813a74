"""The world from above: all trajectories, and each over its own landmarks."""

from collections.abc import Iterator, Sequence

import numpy as np
from matplotlib.figure import Figure

from toolkit.answers import Run
from toolkit.experiment.comparison import Comparison
from toolkit.files.writing import plain_name
from toolkit.geometry import Array
from toolkit.report.curves import alignment_text, onto_truth, shown_output, truth_during
from toolkit.report.figures import style
from toolkit.report.figures.style import Entry, NamedFigure

_LANDMARK_QUANTILES = (0.02, 0.98)
_MARGIN = 0.05
# Landmarks widen the view by at most this share of the tracks' extent, and by this much where the camera hardly moved.
_LANDMARK_REACH = 0.5
_LEAST_REACH_M = 30.0
NOWHERE: Array = np.empty((0, 2))
_LINE_WIDTH, _TRUTH_WIDTH = 1.5, 4.0
# How high a map may be, and the room for labels and legend.
_HIGHEST_IN, _LOWEST_IN, _LABELS_IN = 6.0, 2.3, 0.9


def from_above(comparison: Comparison, run: Run, points_world: Array) -> Array:
    """Return x and y (M, 2) of the finite ones among points (N, 3), moved with the run onto the truth."""
    alignment = onto_truth(run, shown_output(run), comparison.sequence)
    finite = points_world[np.isfinite(points_world).all(axis=1)]
    above: Array = (finite @ alignment.rotation.T + alignment.translation)[:, :2]
    return above


def view_of(tracks: Sequence[Array], landmarks: Array) -> tuple[Array, Array]:
    """Return lower left and upper right (2,) of all tracks (N, 2) and of all but the farthest landmarks (M, 2)."""
    track = np.vstack([NOWHERE, *tracks])
    if not track.size:
        track = np.zeros((1, 2))
    corners = np.quantile(landmarks, _LANDMARK_QUANTILES, axis=0) if len(landmarks) else NOWHERE
    reach = max(_LANDMARK_REACH * float(np.ptp(track, axis=0).max()), _LEAST_REACH_M)
    shown = np.vstack([track, np.clip(corners, track.min(axis=0) - reach, track.max(axis=0) + reach)])
    low, high = shown.min(axis=0), shown.max(axis=0)
    margin = max(_MARGIN * float((high - low).max()), 0.5)
    return low - margin, high + margin


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
    during = truth_during(comparison.sequence)
    truth = NOWHERE if during is None else during.T_world_imu[:, :2, 3]
    answers = [(run, run.trajectory(shown_output(run))) for run in runs]
    tracks = [NOWHERE if one is None else from_above(comparison, run, one.positions) for run, one in answers]
    # A run that diverged would squash all the others; its own figure shows where it went.
    shown = [track for track, run in zip(tracks, runs, strict=True) if run.status == "ok" or len(runs) == 1]
    landmarks = NOWHERE if mapper is None else from_above(comparison, mapper, mapper.landmarks.points_world)
    low, high = view_of([*shown, truth], landmarks)
    width, height = high - low
    figure = style.new_figure(min(max(style.WIDTH_IN * height / width, _LOWEST_IN), _HIGHEST_IN) + _LABELS_IN)
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
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
    axes.set_aspect("equal", adjustable="box")
    style.label_axes(axes, title, "x [m]", "y [m]")
    style.legend_below(figure, entries)
    return figure


def _name(run: Run) -> str:
    return run.estimator if run.status == "ok" else f"{run.estimator} ({run.status})"
