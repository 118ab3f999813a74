"""A comparison: the world from above, then what changes over time: errors, the loss against the bound, NEES and NIS.

Errors are whole and by component, against the truth; without truth they are the differences between estimators. Over
seeds, and of NEES and NIS, there is a panel an estimator. Bands: Bar-Shalom, Li and Kirubarajan, "Estimation with
applications to tracking and navigation" (2001), section 5.4.
"""

from collections.abc import Collection, Iterator, Sequence
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from msgspec.structs import asdict

from toolkit.answers import Output, Run
from toolkit.experiment.comparison import Comparison, Row
from toolkit.files.writing import plain_name
from toolkit.geometry import Array
from toolkit.metrics.bound import against_bound
from toolkit.metrics.parts.evaluation import rmse
from toolkit.models.state import POSITION, ROTATION
from toolkit.report import curves
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

_SIGMAS = 3.0
# An axis shows all of the error, and of the band at most this many times the largest error.
_BAND_REACH = 6.0
_BAND_ALPHA = 0.16
# Estimators that agree to rounding shall look so: no axis is narrower than this (m, deg).
_LEAST = 1e-3


def from_above(comparison: Comparison, run: Run, points_world: Array) -> Array:
    """Return x and y (M, 2) of the finite ones among points (N, 3), moved with the run onto the truth."""
    alignment = curves.onto_truth(run, curves.shown_output(run), comparison.sequence)
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
    runs = [run for run in comparison.runs if run.trajectory(curves.shown_output(run)) is not None]
    if not runs:
        return
    mapper = next((run for run in reversed(runs) if run.status == "ok" and len(run.landmarks)), None)
    of_whom = "" if mapper is None else f" over the landmarks of {mapper.estimator}"
    caption = f"All trajectories{of_whom}, each from its dot on. {curves.alignment_text(comparison.sequence)}"
    if any(run.status != "ok" for run in runs):
        caption += " One that is not ok may leave the picture."
    title = f"{comparison.name}: all estimators, from above"
    yield NamedFigure("top_all", caption, _map(comparison, runs, mapper, title))


def draw_each(comparison: Comparison) -> Iterator[NamedFigure]:
    """Yield a top view for each run that has a trajectory, over its own landmarks."""
    for run in comparison.runs:
        if run.trajectory(curves.shown_output(run)) is not None:
            map_size = f"{len(run.landmarks)} landmarks" if len(run.landmarks) else "it makes no map"
            where = f"Trajectory of {run.estimator} from above, from the dot on"
            figure = _map(comparison, [run], run, f"{_name(run)} on {comparison.name}, from above")
            caption = f"{where}; {map_size}. {curves.alignment_text(comparison.sequence)}"
            yield NamedFigure(f"top_{plain_name(run.estimator)}", caption, figure)


def _map(comparison: Comparison, runs: Sequence[Run], mapper: Run | None, title: str) -> Figure:
    during = curves.truth_during(comparison.sequence)
    truth = NOWHERE if during is None else during.T_world_imu[:, :2, 3]
    answers = [(run, run.trajectory(curves.shown_output(run))) for run in runs]
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
        stroke = style.stroke_of(comparison.estimators, run.estimator, curves.shown_output(run))
        axes.plot(*track.T, linewidth=width, zorder=3, **stroke)
        axes.plot(*track[:1].T, "o", color=stroke["color"], ms=5.0, markeredgecolor="white", zorder=4)
        entries.append(Entry.of_line(_name(run), stroke["color"], stroke["linestyle"], 1.8))
    if mapper is not None and len(mapper.landmarks):
        x, y = landmarks.T
        axes.scatter(x, y, s=3.0, color=style.LANDMARK_COLOUR, alpha=0.5, linewidths=0, zorder=1)
        dot = Line2D([], [], color=style.LANDMARK_COLOUR, marker="o", markersize=4.0, linestyle="")
        entries.append(Entry(f"landmarks of {mapper.estimator}", dot))
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
    axes.set_aspect("equal", adjustable="box")
    style.label_axes(axes, title, "x [m]", "y [m]")
    style.legend_below(figure, entries)
    return figure


def _name(run: Run) -> str:
    return run.estimator if run.status == "ok" else f"{run.estimator} ({run.status})"


def draw_errors(comparison: Comparison) -> Iterator[NamedFigure]:
    """Yield the figure of errors from the common start, or without truth of differences between two trajectories."""
    kind, found = curves.error_curves(comparison)
    if kind is None:
        return
    figure = style.new_figure(4.4)
    position, heading = figure.subplots(2, 1, sharex=True)
    position_m = {row: _known(errors.position_m) for row, errors in found.items()}
    heading_deg = {row: np.abs(_known(errors.heading_deg)) for row, errors in found.items()}
    for axes, unit, of_rows in ((position, "m", position_m), (heading, "deg", heading_deg)):
        for row, sizes in of_rows.items():
            stroke = style.stroke_of(comparison.estimators, row.estimator, curves.shown_as(row))
            width = style.width_of(comparison, row.estimator)
            axes.plot(found[row].t_s, sizes, linewidth=width, **stroke)
        _scale(axes, of_rows, unit)
    style.label_axes(position, f"{comparison.name}: position {kind.what}, {kind.placing}", "", "position [m]")
    style.label_axes(heading, f"size of the heading {kind.what}", "time [s]", "|heading| [deg]")
    figure.align_ylabels()
    told = {row.estimator: f"{number(rmse(sizes))} m" for row, sizes in position_m.items()}
    entries = style.entries_of(comparison.estimators, [(row.estimator, curves.shown_as(row)) for row in found])
    style.legend_below(figure, [entry._replace(label=f"{entry.label}: {told[entry.label]}") for entry in entries])
    caption = f"Position and heading {kind.what} over time, in the legend the RMS of the position, of the final output"
    yield NamedFigure("errors_over_time", f"{caption} where there is one. {kind.caption}", figure)


def _known(values: curves.Numbers) -> Array:
    return np.array(values, dtype=float)


def _scale(axes: Axes, of_rows: dict[Row, Array], unit: str) -> None:
    """Keep an axis to what the runs that are ok need, so that a diverged one does not flatten them."""
    largest = {row: float(np.nanmax(sizes)) for row, sizes in of_rows.items()}
    good = [size for row, size in largest.items() if row.status == "ok"] or largest.values()
    reach = 1.05 * max(*good, _LEAST)
    style.scale_errors(axes, [rmse(sizes) for row, sizes in of_rows.items() if row.status == "ok"], reach)
    beyond = {row.estimator: size for row, size in largest.items() if size > 1.01 * reach}
    if beyond:
        listed = ", ".join(f"{name} (to {size:.3g} {unit})" for name, size in beyond.items())
        style.annotate(axes, f"beyond it: {listed}")


def draw_telling_components(comparison: Comparison) -> Iterator[NamedFigure]:
    """Yield the components of the least and the most consistent estimator, by the mean pose NEES of its rows."""
    for name in _telling(comparison):
        yield from _components_of(comparison, name)


def draw_other_components(comparison: Comparison) -> Iterator[NamedFigure]:
    for run in comparison.runs:
        if run.estimator not in _telling(comparison):
            yield from _components_of(comparison, run.estimator)


def _telling(comparison: Comparison) -> list[str]:
    """Name the estimators of the rows whose mean pose NEES is farthest from and nearest to 1; none without truth."""
    nees = [(row, value) for row in comparison.lines if (value := row.value("nees_pose_mean")) and row.status == "ok"]
    off = sorted((abs(np.log(value)), row.estimator) for row, value in nees)
    return list(dict.fromkeys((off[-1][1], off[0][1]))) if off else []


def _components_of(comparison: Comparison, name: str) -> Iterator[NamedFigure]:
    rows = [row for row in comparison.lines if row.estimator == name]
    found = [(row, one) for row in rows if (one := curves.components(comparison, row)) is not None]
    if not found:
        return
    reference = None if comparison.sequence.truth is not None else curves.reference_estimate(comparison)
    what = "error" if reference is None else f"difference from {reference.name}"
    figure, colour, entries = style.new_figure(4.6), style.stroke_of(comparison.estimators, name)["color"], []
    grid = figure.subplots(3, 2, sharex=True)
    in_order = [*grid[:, 1], *grid[:, 0]]  # rotations first, as in COMPONENTS
    shown: dict[str, list[tuple[Array, Array]]] = {name: [] for name in curves.COMPONENTS}
    for row, one in found:
        output, columns = curves.shown_as(row), {name: _known(column) for name, column in asdict(one).items()}
        line, alpha = style.line_of(output), _BAND_ALPHA if output == "final" else 0.0
        label, is_stated = "causal = final" if row.label == "both" else row.output, False
        for column, axes in zip(curves.COMPONENTS, in_order, strict=True):
            error, band = columns[column], _SIGMAS * columns[f"sigma_{column}"]
            if np.isfinite(band).any():
                is_stated = True
                axes.fill_between(one.t_s, -band, band, color=colour, alpha=alpha, linewidth=0.0)
                axes.plot(one.t_s, np.stack([-band, band], axis=1), color=colour, linestyle=line, linewidth=0.6)
            axes.plot(one.t_s, error, color=colour, linestyle=line, linewidth=1.1)
            shown[column].append((error, band))
        entries.append(Entry.of_line(f"{label}: {what.split(maxsplit=1)[0]}", colour, line))
        if is_stated:
            filled = Patch(facecolor=to_rgba(colour, alpha), edgecolor=colour, linestyle=line, linewidth=0.6)
            entries.append(Entry(f"{label}: ± 3 standard deviations", filled))
    for i, (column, axes) in enumerate(zip(curves.COMPONENTS, in_order, strict=True)):
        _limit(axes, shown[column])
        axis = f"about {'xyz'[i]} [deg]" if i < len("xyz") else f"{'xyz'[i - 3]} [m]"
        style.label_axes(axes, "", "time [s]" if i % 3 == 2 else "", axis)
    nees = [number(value) for row, _ in found if (value := row.value("nees_pose_mean")) is not None]
    stated = f" (mean NEES {', '.join(nees)})" if nees and reference is None else ""
    style.add_title(figure, f"{comparison.name}: {name}{stated}")
    for axes, kind in zip(grid[0], ("position", "rotation"), strict=True):
        axes.set_title(f"{kind} {what}", fontsize=style.TITLE_PT, loc="left")
    figure.align_ylabels(grid)
    style.legend_below(figure, entries)
    yield NamedFigure(f"components_{plain_name(name)}", _OF_COMPONENTS[reference is None].format(name, what), figure)


_OF_COMPONENTS = {
    True: "Error of {0} by component along and about the world's axes, z up, as the NEES takes it: where the start is "
    "not in the truth's world, its first pose is placed on the truth's. The band is three standard deviations that it "
    "states: a consistent estimator is inside nearly always, and fills it.",
    False: "There is no truth: {1}, of {0}, by component along and about the world's axes, z up, not aligned. The band "
    "is three standard deviations that {0} states; a difference far outside it means that one of the two is "
    "overconfident.",
}


def _limit(axes: Axes, drawn: Collection[tuple[Array, Array]]) -> None:
    """Show all of the errors around zero, and their bands unless those would flatten the errors."""
    error, widest = (
        float(np.fmax.reduce(np.abs(np.concatenate(one)), initial=0.0)) for one in zip(*drawn, strict=True)
    )
    reach = max(error, _LEAST, min(widest, _BAND_REACH * max(error, _LEAST)))
    axes.set_ylim(-1.08 * reach, 1.08 * reach)
    axes.axhline(0.0, color=style.ZERO_COLOUR, linewidth=0.8, zorder=1)


_OF_BOUND = (
    "How close to the limit. Black: the Cramér-Rao bound, one standard deviation (dashed: of what was known at the "
    "time, solid: of the whole recording). In colour, thick: the error of an estimator beyond the efficient estimate "
    "on the same measurements; well below the bound the loss is negligible. Thin: the standard deviation it "
    "states; below the bound it is overconfident."
)
_LEAST_SHARE, _STATED_WIDTH = 1e-3, 0.7


def draw_bound(comparison: Comparison) -> Iterator[NamedFigure]:
    if not comparison.settings.metrics.bound:
        return
    found = [
        (row, one)
        for row in comparison.lines
        if (one := curves.available(against_bound, row.run, row.output, comparison.sequence)) is not None
    ]
    if not found:
        return
    figure = style.new_figure(4.8)
    position, rotation = figure.subplots(2, 1, sharex=True)
    of_output = {row.output: one for row, one in reversed(found)}  # the bound is that of any estimator's output
    outputs = list(dict.fromkeys(row.output for row, _ in found))
    for axes, block, scale in ((position, POSITION, 1.0), (rotation, ROTATION, 180.0 / np.pi)):
        for row, one in found:
            t_s = comparison.sequence.elapsed_s(one.t_ns)
            stroke = style.stroke_of(comparison.estimators, row.estimator, curves.shown_as(row))
            lost = np.linalg.norm(one.excess[:, block], axis=1)
            axes.plot(t_s, scale * lost, linewidth=1.6, label=f"{row.estimator} {row.label}", **stroke)
            axes.plot(t_s, scale * _sigma(one.stated, block), linewidth=_STATED_WIDTH, **stroke)
        bounds = {output: scale * _sigma(of_output[output].bound, block) for output in outputs}
        for output, sigma in bounds.items():
            t_s, line = comparison.sequence.elapsed_s(of_output[output].t_ns), style.line_of(output)
            axes.plot(t_s, sigma, color=style.TRUTH_COLOUR, linestyle=line, linewidth=2.0, label=f"bound {output}")
        axes.set_yscale("log")
        # There is room for what is a thousand times below the bound.
        axes.set_ylim(bottom=_LEAST_SHARE * min(float(sigma.min()) for sigma in bounds.values()))
    style.label_axes(position, f"{comparison.name}: position beyond the efficient estimate", "", "position [m]")
    style.label_axes(rotation, "rotation beyond the efficient estimate", "time [s]", "rotation [deg]")
    figure.align_ylabels()
    entries = [Entry.of_line(f"bound {output}", style.TRUTH_COLOUR, style.line_of(output), 2.0) for output in outputs]
    entries += style.entries_of(comparison.estimators, [(row.estimator, curves.shown_as(row)) for row, _ in found])
    entries += [Entry.of_line("thin: stated", style.MUTED_COLOUR, width=_STATED_WIDTH)]
    style.legend_below(figure, entries)
    yield NamedFigure("against_bound", _OF_BOUND, figure)


def _sigma(covs: Array, block: slice) -> Array:
    """Return the root (n,) of the trace of a block of covariances (n, d, d)."""
    return np.asarray(np.sqrt(np.trace(covs[:, block, block], axis1=1, axis2=2)))


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


def _in_bands(comparison: Comparison, found: Sequence[tuple[Row, Normalised]], what: str) -> Figure:
    """Draw each row's normalised errors over their band, in a panel an estimator that says how many are in it."""
    figure, panels = style.panels_of(list(dict.fromkeys(row.estimator for row, _ in found)))
    shares: dict[str, list[str]] = {}
    least = most = 1.0
    for row, series in found:
        axes, colour = panels[row.estimator], style.stroke_of(comparison.estimators, row.estimator)["color"]
        shown = np.clip(series.value, *RANGE)
        axes.fill_between(series.t_s, series.low, series.high, color=style.BAND_COLOUR, linewidth=0.0, zorder=1)
        axes.plot(series.t_s, shown, color=colour, linestyle=style.line_of(curves.shown_as(row)), linewidth=1.0)
        shares.setdefault(row.estimator, []).append(f"{series.in_band_percent:.0f}")
        style.annotate(axes, f"{', '.join(dict.fromkeys(shares[row.estimator]))} %")
        least = float(np.fmin.reduce(np.append(shown, series.low), initial=least))
        most = float(np.fmax.reduce(np.append(shown, series.high), initial=most))
    style.scale_by_decades(next(iter(panels.values())), max(0.7 * least, RANGE[0]), min(1.5 * most, RANGE[1]))
    entries = style.output_entries({curves.shown_as(row) for row, _ in found})
    seeds = f", {len(comparison.seeds)} seeds: mean" if comparison.over_seeds else ":"
    band = Entry("95 % band", Patch(color=style.BAND_COLOUR, linewidth=0.0))
    style.finish(figure, panels, what, f"{comparison.name}{seeds} {what}", [*entries, band])
    return figure


def draw_nees(comparison: Comparison) -> Iterator[NamedFigure]:
    found = [
        (row, Normalised(series.t_s, _known(series.pose), *series.band))
        for row in comparison.lines
        if (series := curves.available(curves.nees_series, row.run, row.output, comparison.sequence)) is not None
    ]
    if found:
        yield NamedFigure("nees_over_time", _OF_NEES, _in_bands(comparison, found, "pose NEES / 6"))


def draw_nis(comparison: Comparison) -> Iterator[NamedFigure]:
    found = [
        (row, Normalised(series.t_s, *map(_known, (series.per_dof, series.low, series.high))))
        for row in comparison.lines
        if (series := curves.available(curves.nis_series, row.run, row.output, comparison.sequence)) is not None
    ]
    if found:
        yield NamedFigure("nis_over_time", _OF_NIS, _in_bands(comparison, found, "NIS / expected"))


def draw_over_seeds(over: Comparison) -> Iterator[NamedFigure]:
    """Yield the figure of position errors and that of NEES, each where there is anything to draw."""
    if any(group.position_m is not None for group in over.rows):
        yield _errors_over_seeds(over)
    means = [(group, nees) for group in over.lines if (nees := group.mean_nees) is not None]
    if means:
        t_s = over.sequence.frames_s
        found = [(group, Normalised(t_s, nees.mean, nees.low, nees.high)) for group, nees in means]
        caption = (
            f"Pose NEES over its 6 degrees of freedom on {over.name}, averaged over the runs that are ok of "
            f"{len(over.seeds)} seeds, and the 95 % chi-square band of a consistent estimator (grey). Above the band "
            f"an estimator is overconfident. What is beyond {RANGE[0]:g} and {RANGE[1]:g} is drawn there."
        )
        yield NamedFigure("nees_over_seeds", caption, _in_bands(over, found, "pose NEES / 6"))


def _errors_over_seeds(over: Comparison) -> NamedFigure:
    figure, panels = style.panels_of(over.estimators)
    kinds: set[Output] = set()
    for group in over.lines:
        errors_m = group.position_m
        if errors_m is None:
            continue
        known = np.isfinite(errors_m).any(axis=0)
        lower, median, upper = np.nanpercentile(errors_m[:, known], [25.0, 50.0, 75.0], axis=0)
        kind = curves.shown_as(group)
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
