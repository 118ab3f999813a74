"""A sweep: errors, NEES and withheld tracks over the values of an axis, and error against time."""

import math
from collections.abc import Iterator
from typing import TypeGuard

import numpy as np
from matplotlib.axes import Axes

from toolkit.experiment.statistics import Interval
from toolkit.experiment.sweep import BREAKS_AT, CLEAN, Axis, Point, Sweep
from toolkit.files.writing import plain_name
from toolkit.report.figures import style
from toolkit.report.figures.style import NamedFigure
from toolkit.report.sweep import metric_of, shown_value

# Doses that span more than this factor are laid out by their logarithm.
_WIDE = 8.0
# Beyond this a ratio or NEES is drawn at the limit.
_MOST = 1e6
_HEIGHT_IN = 2.9


def draw_sweep(sweep: Sweep) -> Iterator[NamedFigure]:
    for axis in sweep.axes:
        yield _curves(sweep, axis)
    for axis in sweep.axes:
        if not axis.is_fault:
            yield _against_time(sweep, axis)


class _Places:
    """Where the values of an axis stand, and the clean one; wide ranges by their logarithm, words one after another."""

    def __init__(self, axis: Axis) -> None:
        clean = float(axis.clean) if _is_number(axis.clean) else math.nan
        numeric = all(map(_is_number, axis.values))
        doses = dict(zip(axis.values, map(float, axis.values if numeric else range(len(axis.values))), strict=True))
        least, most = min(doses.values()), max(doses.values())
        by_log = numeric and least > 0.0 and (most / least > _WIDE or clean == 1.0)
        self.of = {value: math.log(dose) if by_log else dose for value, dose in doses.items()}
        least, most = min(self.of.values()), max(self.of.values())
        step = (most - least) / max(len(doses) - 1, 1) or 1.0
        if math.isfinite(clean) and not (by_log and clean <= 0.0):
            self.clean = math.log(clean) if by_log else clean
        else:
            self.clean = most + step if clean == math.inf else least - step
        self.ticks = {self.clean: _word(axis), **{place: shown_value(value) for value, place in self.of.items()}}


def _is_number(value: object) -> TypeGuard[float]:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _word(axis: Axis) -> str:
    return "clean" if axis.is_fault else "default"


def _curves(sweep: Sweep, axis: Axis) -> NamedFigure:
    figure = style.new_figure(_HEIGHT_IN)
    panels, places = figure.subplots(1, 3, sharex=True), _Places(axis)
    points = {places.clean: CLEAN, **{places.of[point[0][1]]: point for point in axis.points}}
    titles = ("error over clean", "pose NEES / 6", "withheld tracks over clean")
    for axes, title, field in zip(panels, titles, ("over_clean", "nees", "held_out"), strict=True):
        style.label_axes(axes, title, f"{axis.name.removeprefix('fault:')}{f' [{axis.unit}]' if axis.unit else ''}", "")
        axes.axhline(1.0, color=style.ZERO_COLOUR, linewidth=0.8)
        lines: dict[str, list[tuple[float, Interval]]] = {}
        for name in sweep.estimators:
            effects = {at: getattr(sweep.effects[name, point], field) for at, point in sorted(points.items())}
            lines[name] = [(at, one) for at, one in effects.items() if one is not None]
        _draw_lines(axes, lines)
        axes.set_xticks(list(places.ticks), list(places.ticks.values()), fontsize=style.TICK_PT)
    panels[0].axhline(BREAKS_AT, color=style.MUTED_COLOUR, linewidth=0.8, linestyle=":")
    style.add_title(figure, f"{sweep.grid.case.name}: {axis.name}")
    style.legend_below(figure, style.entries_of(sweep.estimators, [(name, "final") for name in sweep.estimators]))
    over = f"{len(sweep.grid.plan.seeds)} seeds, paired" if sweep.over_seeds else "stretches of the recording"
    caption = (
        f"{axis.name} on {sweep.grid.case.name} ({axis.meaning.rstrip('.')}): error over that of the clean recording "
        f"(dotted: {BREAKS_AT:g} times), pose NEES over its 6 degrees of freedom, and error of withheld tracks over "
        f"the clean one; 95 % intervals over {over}. Crosses: runs that did not end well."
    )
    return NamedFigure(f"sweep_{plain_name(axis.name)}", caption, figure)


def _draw_lines(axes: Axes, lines: dict[str, list[tuple[float, Interval]]]) -> None:
    if not any(lines.values()):
        style.say(axes, "not known")
    values = [min(one.value, _MOST) for line in lines.values() for _, one in line if math.isfinite(one.value)]
    low, high = 0.7 * min([0.9, *values]), 1.5 * max([BREAKS_AT, *values])
    for name, line in lines.items():
        stroke, place = style.stroke_of(lines, name), [place for place, _ in line]
        value, below, above = (np.clip([one[end] for _, one in line], low, high) for end in range(3))
        axes.fill_between(place, below, above, color=stroke["color"], alpha=0.13, linewidth=0.0)
        axes.plot(place, value, linewidth=1.3, marker="o", markersize=2.5, **stroke)
        bad = [place for place, one in line if math.isinf(one.value)]
        axes.scatter(bad, [high] * len(bad), color=stroke["color"], marker="x", clip_on=False)
    style.scale_by_decades(axes, low, high)


def _against_time(sweep: Sweep, axis: Axis) -> NamedFigure:
    metric = metric_of(sweep)
    figure = style.new_figure(3.6)
    axes = figure.subplots()
    style.label_axes(axes, "", "CPU of a frame [ms]", f"{metric.name} [{metric.unit}]")
    reached = {name: _reached(sweep, axis, name) for name in sweep.estimators}
    everywhere = [at for points in reached.values() for at in points.values()]
    for name, points in reached.items():
        stroke = style.stroke_of(reached, name)
        line = [at for point, at in points.items() if point]
        axes.plot(*np.reshape(line, (-1, 2)).T, linewidth=1.0, alpha=0.6, **stroke)
        for point, at in points.items():
            on_front = not any(other != at and other[0] <= at[0] and other[1] <= at[1] for other in everywhere)
            face = stroke["color"] if on_front else "white"
            axes.plot(*at, marker="o", markersize=6.0 if on_front else 3.5, markerfacecolor=face, **stroke)
            word = shown_value(point[0][1]) if point else _word(axis)
            axes.annotate(
                word, at, (4, 4), textcoords="offset points", fontsize=style.SMALL_PT, color=style.MUTED_COLOUR
            )
    cpu_ms, errors = np.reshape(everywhere, (-1, 2)).T
    if cpu_ms.size:
        style.scale_by_decades(axes, 0.8 * cpu_ms.min(), 1.25 * cpu_ms.max(), "x")
        style.scale_by_decades(axes, 0.8 * errors.min(), 1.25 * errors.max())
    title = f"{sweep.grid.case.name}: error against time over {axis.name}"
    style.add_title(figure, title)
    style.legend_below(figure, style.entries_of(sweep.estimators, [(name, "final") for name in sweep.estimators]))
    caption = (
        f"{metric.name} against processor time over the values of {axis.name} on {sweep.grid.case.name}, means over "
        "the runs. Filled: on the Pareto front, no other is both more accurate and faster."
    )
    return NamedFigure(f"pareto_{plain_name(axis.name)}", caption, figure)


def _reached(sweep: Sweep, axis: Axis, name: str) -> dict[Point, tuple[float, float]]:
    """Return CPU (ms) and error at each point where all runs are ok; one point where the setting changes neither."""
    effects = {point: sweep.effects[name, point] for point in (CLEAN, *axis.points)}
    good = {
        point: (one.cpu_ms, one.error)
        for point, one in effects.items()
        if one.ok == one.runs and one.error and one.cpu_ms
    }
    return dict([*good.items()][: 1 if len({error for _, error in good.values()}) == 1 else None])
