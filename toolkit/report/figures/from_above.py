"""The world from above: all trajectories with a closer look, and maps coloured by error, a panel an estimator.

The panels of a map share one scale of colours, which is logarithmic: estimators differ by orders of magnitude.
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
from matplotlib.lines import Line2D
from matplotlib.ticker import LogLocator, MaxNLocator, NullLocator, ScalarFormatter

from toolkit.answers import Run
from toolkit.experiment.comparison import Comparison
from toolkit.files.writing import plain_name
from toolkit.geometry import Array, IntArray
from toolkit.metrics import reprojection
from toolkit.metrics.parts.against_truth import rmse
from toolkit.report.curves import alignment_text, available, errors_to, onto_truth, shown_output, truth_during
from toolkit.report.figures.style import (
    LABEL_PT,
    LANDMARK_COLOUR,
    MUTED_COLOUR,
    SMALL_PT,
    TICK_PT,
    TITLE_PT,
    TRUTH_COLOUR,
    WIDTH_IN,
    Entry,
    NamedFigure,
    colour_of,
    columns_for,
    legend,
    new_figure,
    panels_of,
    stroke_of,
    style_axes,
    width_of,
)
from toolkit.report.text import number

_LANDMARK_QUANTILES = (0.02, 0.98)
_MARGIN = 0.05
# Landmarks widen the view by at most this share of the tracks' extent, and by this much where the camera hardly moved.
_LANDMARK_REACH = 0.5
_LEAST_REACH_M = 30.0
# Lines closer than this share of the view are one line to the eye.
_COINCIDE = 0.015
_LEAST_ZOOM = 1e-4
NOWHERE: Array = np.empty((0, 2))
_LINE_WIDTH, _TRUTH_WIDTH = 1.5, 4.0
# Room beside the map for legend and closer look, for the axes' labels, and how high a map may be.
_BESIDE_IN, _LABELS_IN, _HIGHEST_IN, _LOWEST_IN = 1.9, 0.55, 6.0, 2.3
_ENTRY_IN, _CLOSER_IN = 0.175, 1.6
_LEAST_SQUARE = 0.015  # of the square in the map, as a share of the map


class View(NamedTuple):
    """The rectangle from ``low`` (2,) to ``high`` (2,), x and y in metres."""

    low: Array
    high: Array

    @property
    def size(self) -> Array:
        """Return width and height (2,) in metres."""
        return self.high - self.low

    @property
    def ratio(self) -> float:
        """Return the height over the width."""
        return float(self.size[1] / self.size[0])

    def show(self, axes: Axes) -> None:
        """Have axes show this, in equal scale."""
        axes.set_xlim(self.low[0], self.high[0])
        axes.set_ylim(self.low[1], self.high[1])
        axes.set_aspect("equal", adjustable="box")


class PathFromAbove(NamedTuple):
    """Positions from above (N, 2) m at stamps (N,)."""

    t_ns: IntArray
    xy: Array


def from_above(comparison: Comparison, run: Run, points_world: Array) -> Array:
    """Return x and y (M, 2) of the finite ones among points (N, 3), moved with the run onto the truth."""
    alignment = onto_truth(run, shown_output(run), comparison.sequence)
    finite = points_world[np.isfinite(points_world).all(axis=1)]
    above: Array = (finite @ alignment.rotation.T + alignment.translation)[:, :2]
    return above


def track_of(comparison: Comparison, run: Run) -> PathFromAbove:
    """Return a run's final answer from above, without poses that are not finite; the run must have a trajectory."""
    trajectory = run.trajectory(shown_output(run))
    assert trajectory is not None, "only runs with a trajectory are drawn"
    finite = np.isfinite(trajectory.positions).all(axis=1)
    return PathFromAbove(trajectory.t_ns[finite], from_above(comparison, run, trajectory.positions))


def true_track(comparison: Comparison) -> PathFromAbove | None:
    """Return the truth from above while the camera ran, or None."""
    truth = truth_during(comparison.sequence)
    return None if truth is None else PathFromAbove(truth.t_ns, truth.T_world_imu[:, :2, 3])


def landmarks_shown(points: Array) -> Array:
    """Return the corners (2, 2) of the range that holds all but the farthest of points (M, 2), or nothing."""
    if not points.shape[0]:
        return NOWHERE
    corners: Array = np.quantile(points, _LANDMARK_QUANTILES, axis=0)
    return corners


def view_of(tracks: Sequence[PathFromAbove], landmarks: Array) -> View:
    """Return the view of all of the tracks and of landmarks (M, 2) near them."""
    track = np.vstack([NOWHERE, *(one.xy for one in tracks)])
    if not track.size:
        track = np.zeros((1, 2))
    reach = max(_LANDMARK_REACH * float(np.ptp(track, axis=0).max()), _LEAST_REACH_M)
    shown = np.vstack([track, np.clip(landmarks, track.min(axis=0) - reach, track.max(axis=0) + reach)])
    low, high = shown.min(axis=0), shown.max(axis=0)
    margin = max(_MARGIN * float((high - low).max()), 0.5)
    return View(low - margin, high + margin)


def where_tracks_coincide(tracks: Sequence[PathFromAbove], view: View, at_ns: IntArray) -> View | None:
    """Return a square around the place to look closer at: where most tracks are one line, and differ most in it.

    Returns None where no two of them ever are.
    """
    there = [track for track in tracks if track.t_ns.size]
    if len(there) < 2 or not at_ns.size:
        return None
    xy = np.stack([_at(track, at_ns) for track in there])
    known = np.isfinite(xy[:, :, 0]).any(axis=0)
    middle = np.full(xy.shape[1:], np.nan)
    middle[known] = np.nanquantile(xy[:, known], 0.5, axis=0, method="lower")
    off = np.linalg.norm(xy - middle, axis=2)
    same = off < 0.5 * _COINCIDE * float(view.size.max())
    count = same.sum(axis=0)
    if count.max() < 2:
        return None
    spread = np.where(count == count.max(), np.where(same, off, 0.0).max(axis=0), -1.0)
    place = int(np.argmax(spread))
    centre = xy[same[:, place], place].mean(axis=0)
    half = max(1.8 * float(spread[place]), _LEAST_ZOOM * float(view.size.max()))
    return View(centre - half, centre + half)


def _at(track: PathFromAbove, at_ns: IntArray) -> Array:
    """Return the positions (K, 2) at stamps, between those of a track; NaN outside."""
    given = [np.interp(at_ns, track.t_ns, component, left=np.nan, right=np.nan) for component in track.xy.T]
    return np.stack(given, axis=1)


def draw_all(comparison: Comparison) -> Iterator[NamedFigure]:
    """Yield all trajectories in one figure, over the landmarks of the last run that is ok and has some."""
    runs = [run for run in comparison.runs if run.trajectory(shown_output(run)) is not None]
    if not runs:
        return
    mapper = next((run for run in reversed(runs) if run.status == "ok" and len(run.landmarks)), None)
    of_whom = "" if mapper is None else f" over the landmarks of {mapper.estimator}"
    caption = (
        f"All trajectories{of_whom}, each from its dot on. {alignment_text(comparison.sequence)} The square is "
        "enlarged beside the map: there most of them lie on one another, and differ most."
    )
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
    """Draw tracks over the truth and one run's landmarks, with legend and closer look beside the map."""
    truth, tracks = true_track(comparison), [track_of(comparison, run) for run in runs]
    # A run that diverged would squash all the others; its own figure shows where it went.
    shown = [track for track, run in zip(tracks, runs, strict=True) if run.status == "ok" or len(runs) == 1]
    shown += [] if truth is None else [truth]
    landmarks = NOWHERE if mapper is None else from_above(comparison, mapper, mapper.landmarks.points_world)
    view = view_of(shown, landmarks_shown(landmarks))
    closer = where_tracks_coincide(shown, view, comparison.sequence.frames_t_ns)
    entries = _entries(comparison, runs, truth, mapper)
    figure, axes, beside, under = _places(view, len(entries), closer)
    axes.scatter(landmarks[:, 0], landmarks[:, 1], s=3.0, color=LANDMARK_COLOUR, alpha=0.5, linewidths=0, zorder=1)
    for place in filter(None, (axes, under)):
        if truth is not None:
            place.plot(*truth.xy.T, color=TRUTH_COLOUR, linewidth=_TRUTH_WIDTH, zorder=2)
        for run, track in zip(runs, tracks, strict=True):
            width = _LINE_WIDTH if len(runs) == 1 else width_of(comparison, run.estimator)
            stroke = stroke_of(comparison, run.estimator, shown_output(run))
            place.plot(*track.xy.T, linewidth=width, zorder=3, **stroke)
    for run, track in zip(runs, tracks, strict=True):
        colour = colour_of(comparison, run.estimator)
        axes.plot(*track.xy[:1].T, "o", color=colour, ms=5.0, markeredgecolor="white", zorder=4)
    view.show(axes)
    style_axes(axes, title, "x [m]", "y [m]")
    legend(beside, entries, columns=1, loc="upper left", bbox_to_anchor=(0.0, 1.0), borderaxespad=0.0)
    if under is not None and closer is not None:
        _look_closer(axes, under, closer, view)
    return figure


def _entries(
    comparison: Comparison, runs: Sequence[Run], truth: PathFromAbove | None, mapper: Run | None
) -> list[Entry]:
    """Return the legend's entries: the truth, the estimators in their order, whose landmarks there are."""
    entries = [] if truth is None else [Entry.of_line("truth", TRUTH_COLOUR, width=_TRUTH_WIDTH)]
    for run in runs:
        line = Line2D([], [], linewidth=1.8, **stroke_of(comparison, run.estimator, shown_output(run)))
        entries.append(Entry(_name(run), (line,)))
    if mapper is not None and len(mapper.landmarks):
        dot = Line2D([], [], color=LANDMARK_COLOUR, linestyle="", marker="o", markersize=3.0)
        entries.append(Entry(f"landmarks of {mapper.estimator}", (dot,)))
    return entries


def _places(view: View, entries: int, closer: View | None) -> tuple[Figure, Axes, Axes, Axes | None]:
    """Return a figure with a place for the map, and beside it one for the legend over one for the closer look."""
    legend_in, closer_in = _ENTRY_IN * entries + 0.1, 0.0 if closer is None else _CLOSER_IN
    width_in = WIDTH_IN - _BESIDE_IN - _LABELS_IN
    height_in = max(min(width_in * view.ratio, _HIGHEST_IN), legend_in + closer_in, _LOWEST_IN) + _LABELS_IN
    figure = new_figure(height_in)
    heights = (legend_in, max(height_in - legend_in, 0.1))
    grid = figure.add_gridspec(2, 2, width_ratios=(width_in, _BESIDE_IN), height_ratios=heights)
    legend_axes = figure.add_subplot(grid[0, 1])
    legend_axes.set_axis_off()
    the_map = figure.add_subplot(grid[:, 0], anchor="NW")
    return figure, the_map, legend_axes, None if closer is None else figure.add_subplot(grid[1, 1])


def _look_closer(axes: Axes, under: Axes, closer: View, view: View) -> None:
    """Show a part of the map enlarged, and in the map where it is."""
    closer.show(under)
    style_axes(under, "", "", "")
    # Below the panel, where no line to the square crosses it.
    under.set_xlabel("the square, enlarged", fontsize=SMALL_PT)
    under.tick_params(labelsize=SMALL_PT, colors=MUTED_COLOUR)
    for axis in (under.xaxis, under.yaxis):
        axis.set_major_locator(MaxNLocator(3))
        axis.set_major_formatter(ScalarFormatter(useOffset=False))
    under.spines[:].set(visible=True, color=MUTED_COLOUR, linewidth=0.8)
    # The square as it is may be too small to be seen.
    half = max(float(closer.size[0]), _LEAST_SQUARE * float(view.size.max())) / 2.0
    low = (closer.low + closer.high) / 2.0 - half
    place = (float(low[0]), float(low[1]), 2.0 * half, 2.0 * half)
    square = axes.indicate_inset(place, under, edgecolor=MUTED_COLOUR, alpha=1.0, linewidth=0.8, zorder=5)
    assert square.connectors is not None, "the panel is given"
    # The map is on the left, and so would be the numbers, under the lines.
    for line, shown in zip(square.connectors, (True, True, False, False), strict=True):
        line.set_visible(shown)
    under.yaxis.tick_right()
    # Drawn before the map, for its place is known then alone, and the lines end at its corners.
    under.set_zorder(axes.get_zorder() - 1)


def _name(run: Run) -> str:
    return run.estimator if run.status == "ok" else f"{run.estimator} ({run.status})"


# Plasma (Smith and van der Walt 2015) without its yellow, which white paper swallows: legible for the colour-blind.
_COLOURS = LinearSegmentedColormap.from_list("plasma without yellow", colormaps["plasma"](np.linspace(0.0, 0.85, 64)))
_QUANTILES = (0.02, 0.99)
_LEAST_SPAN = 3.0  # of the colour scale, as a ratio: errors that are all alike shall look so
_BAR_IN, _TITLE_IN = 1.1, 0.3


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
        yield _map(comparison, coloured, _TRAJECTORY)


def draw_maps(comparison: Comparison) -> Iterator[NamedFigure]:
    """Yield landmarks by reprojection error, where any estimator has landmarks."""
    coloured = [found for run in comparison.runs if (found := _by_pixel(comparison, run)) is not None]
    if coloured:
        yield _map(comparison, coloured, _MAP)


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
    found = available(reprojection.errors_of_landmarks, run, shown_output(run), comparison.sequence)
    if found is None:
        return None
    ids, error_px = found
    points = run.landmarks.points_world[np.searchsorted(run.landmarks.track_ids, ids)]
    finite = np.isfinite(points).all(axis=1)
    above = from_above(comparison, run, points[finite])
    return _Coloured(run, track_of(comparison, run), above, error_px[finite]) if finite.any() else None


def _map(comparison: Comparison, shown: Sequence[_Coloured], kind: _Kind) -> NamedFigure:
    """Draw a panel an estimator, all over one view and with one scale of colours."""
    truth = true_track(comparison)
    good = [one for one in shown if one.run.status == "ok"] or list(shown)
    tracks = [one.track for one in good] + ([] if truth is None else [truth])
    view = view_of(tracks, landmarks_shown(np.vstack([one.points for one in good])) if kind is _MAP else NOWHERE)
    scale = ScalarMappable(_norm(np.concatenate([one.value for one in good]), kind.least), _COLOURS)
    names = [_name(one.run) for one in shown]
    panel_in = (WIDTH_IN - _BAR_IN) / columns_for(len(names)) * view.ratio + _TITLE_IN
    figure, panels = panels_of(names, "", panel_in)
    for axes, one in zip(panels.values(), shown, strict=True):
        view.show(axes)
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
    bar = figure.colorbar(scale, ax=list(panels.values()), shrink=0.9, aspect=35, pad=0.02, extend="both")
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
