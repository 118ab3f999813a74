"""The world from above: one figure an estimator over its landmarks, and all trajectories in one."""

from collections.abc import Iterator

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from toolkit.estimate import Output, Run
from toolkit.experiment.comparison import Comparison, plain_name
from toolkit.geometry import Array
from toolkit.report.figures.alignment import alignment_words, onto_truth, truth_during
from toolkit.report.figures.style import (
    LANDMARK_COLOUR,
    TRUTH_COLOUR,
    NamedFigure,
    colour_of,
    line_of_estimator,
    new_figure,
    quiet,
    width_of,
)

_LINE_WIDTH = 1.5
_TRUTH_WIDTH = 4.0
_LANDMARK_QUANTILES = (0.02, 0.98)
_MARGIN = 0.06
_LARGEST_IN = (10.0, 7.5)
_LEAST_HEIGHT_IN = 3.5
# Landmarks widen the view by at most this share of the tracks' extent, and by this much where the camera hardly moved.
_LANDMARK_REACH = 0.5
_LEAST_REACH_M = 30.0


def draw(comparison: Comparison) -> Iterator[NamedFigure]:
    """Yield a top view for each run that has a trajectory, then the combined one."""
    drawable = [run for run in comparison.runs if run.trajectory(last_word(run)) is not None]
    for run in drawable:
        yield _one(comparison, run)
    if drawable:
        yield _all(comparison, drawable)


def last_word(run: Run) -> Output:
    """Return the kind of output a figure with room for one shows: the final one where there is one."""
    return "final" if run.final is not None else "causal"


def _one(comparison: Comparison, run: Run) -> NamedFigure:
    figure = new_figure(*_LARGEST_IN)
    axes = figure.add_subplot()
    landmarks = _draw_landmarks(axes, comparison, run)
    tracks = [_draw_truth(axes, comparison), _draw_run(axes, comparison, run, _LINE_WIDTH)]
    _finish(figure, axes, tracks, landmarks)
    quiet(axes, f"{run.estimator}{_trouble(run)} on {comparison.sequence.name}, from above", "x [m]", "y [m]")
    mapped = f"{len(run.landmarks)} landmarks" if len(run.landmarks) else "it makes no map"
    caption = (
        f"Trajectory of {run.estimator} from above, from the dot on; {mapped}. {alignment_words(comparison.sequence)}"
    )
    return NamedFigure(f"top_{plain_name(run.estimator)}", caption, figure)


def _all(comparison: Comparison, runs: list[Run]) -> NamedFigure:
    figure = new_figure(*_LARGEST_IN)
    axes = figure.add_subplot()
    mapping = [run for run in runs if run.status == "ok" and len(run.landmarks)]
    landmarks = _draw_landmarks(axes, comparison, mapping[-1]) if mapping else np.empty((0, 2))
    tracks = [_draw_truth(axes, comparison)]
    for run in runs:
        track = _draw_run(axes, comparison, run, width_of(comparison, run.estimator))
        # A run that flew off would squash all the others; its own figure shows where it went.
        if run.status == "ok" or len(runs) == 1:
            tracks.append(track)
    _finish(figure, axes, tracks, landmarks)
    quiet(axes, f"{comparison.sequence.name}: all estimators, from above", "x [m]", "y [m]")
    of_whom = f" over the landmarks of {mapping[-1].estimator}" if mapping else ""
    caption = f"All trajectories{of_whom}, each from its dot on. {alignment_words(comparison.sequence)}"
    if any(run.status != "ok" for run in runs):
        caption += " One that is not ok may leave the picture."
    return NamedFigure("top_all", caption, figure)


def _trouble(run: Run) -> str:
    return "" if run.status == "ok" else f" ({run.status})"


def _draw_truth(axes: Axes, comparison: Comparison) -> Array:
    truth = truth_during(comparison.sequence)
    if truth is None:
        return np.empty((0, 2))
    positions = truth.T_world_imu[:, :2, 3]
    axes.plot(*positions.T, color=TRUTH_COLOUR, linewidth=_TRUTH_WIDTH, label="truth", zorder=2)
    return positions


def _draw_run(axes: Axes, comparison: Comparison, run: Run, width: float) -> Array:
    """Draw the run's last word, and where it starts; return its positions (N, 2)."""
    output = last_word(run)
    trajectory = run.trajectory(output)
    assert trajectory is not None, "only runs with a trajectory are drawn"
    positions = _from_above(comparison, run, trajectory.positions)
    colour, label = colour_of(comparison, run.estimator), f"{run.estimator} {output}{_trouble(run)}"
    line = line_of_estimator(comparison, run.estimator, output)
    axes.plot(*positions.T, color=colour, linewidth=width, linestyle=line, label=label, zorder=3)
    axes.plot(*positions[:1].T, "o", color=colour, markersize=7, markeredgecolor="white", zorder=4)
    return positions


def _draw_landmarks(axes: Axes, comparison: Comparison, run: Run) -> Array:
    """Draw the landmarks of a run; return the corners (2, 2) of the range that holds all but the farthest."""
    points = _from_above(comparison, run, run.landmarks.points_world)
    if points.shape[0] == 0:
        return np.empty((0, 2))
    label = f"landmarks of {run.estimator}"
    axes.scatter(
        points[:, 0], points[:, 1], s=4.0, color=LANDMARK_COLOUR, alpha=0.6, linewidths=0, label=label, zorder=1
    )
    corners: Array = np.quantile(points, _LANDMARK_QUANTILES, axis=0)
    return corners


def _from_above(comparison: Comparison, run: Run, points_world: Array) -> Array:
    """Return x and y (M, 2) of the finite ones among points (N, 3), moved with the run onto the truth."""
    alignment = onto_truth(run, last_word(run), comparison.sequence)
    finite = points_world[np.isfinite(points_world).all(axis=1)]
    above: Array = (finite @ alignment.rotation.T + alignment.translation)[:, :2]
    return above


def _finish(figure: Figure, axes: Axes, tracks: list[Array], landmarks: Array) -> None:
    """Show all of the tracks and the landmarks near them in equal scale, with the legend beside the map."""
    track = np.vstack(tracks)
    if track.shape[0]:
        reach = max(_LANDMARK_REACH * float(np.ptp(track, axis=0).max()), _LEAST_REACH_M)
        shown = np.vstack([track, np.clip(landmarks, track.min(axis=0) - reach, track.max(axis=0) + reach)])
        low, high = shown.min(axis=0), shown.max(axis=0)
        margin = max(_MARGIN * float((high - low).max()), 0.5)
        axes.set_xlim(low[0] - margin, high[0] + margin)
        axes.set_ylim(low[1] - margin, high[1] + margin)
        width, height = high - low + 2.0 * margin
        # A long straight drive gets a flat picture, a turn in place a square one.
        figure.set_figheight(float(np.clip(_LARGEST_IN[0] * height / width, _LEAST_HEIGHT_IN, _LARGEST_IN[1])))
    axes.set_aspect("equal", adjustable="box")
    legend = axes.legend(frameon=False, loc="upper left", bbox_to_anchor=(1.0, 1.0), fontsize=9, markerscale=2.5)
    for handle in legend.legend_handles:
        if handle is not None:
            handle.set_alpha(1.0)
