"""A sweep: errors, NEES and withheld tracks over the values of an axis, and error against time.

And an explanation as bars, with intervals: from the left what each ingredient brings the first estimator, from the
right what the second loses without it.
"""

import math
from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple, TypeGuard

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Patch
from matplotlib.transforms import Bbox

from toolkit.experiment.explanation import ContributionRecord, Explanation
from toolkit.experiment.statistics import Interval
from toolkit.experiment.sweep import BREAKS_AT, CLEAN, Axis, Point, Sweep
from toolkit.files.writing import plain_name
from toolkit.report.explanation import ExplanationRecord, Kind, explanation_document, over, placed, where
from toolkit.report.figures import style
from toolkit.report.figures.style import Entry, NamedFigure
from toolkit.report.sweep import metric_of, shown_value
from toolkit.report.text import number

# Doses that span more than this factor are laid out by their logarithm.
_WIDE = 8.0
# Beyond this a ratio or NEES is drawn at the limit.
_MOST = 1e6
_HEIGHT_IN = 2.9

_FIRST, _LAST, _WHOLE = "#0072B2", "#D55E00", "#5b6670"
# Bars of effects that may be chance are pale.
_PALE = 0.3
_ROW_IN, _AROUND_IN, _BAR = 0.46, 1.9, 0.38
# The axis has this room on either side of the bars, which it cuts where they reach further than the second.
_ROOM, _REACH = math.log(1.25), math.log(30.0)
_TICKS = (0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0, 200.0, 500.0, 1000.0)
_FINE_TICKS = (0.5, 0.6, 0.8, 1.0, 1.2, 1.5, 2.0)
# Where the columns beside the bars begin.
_EFFECT_AT, _BASE_AT = 0.0, 0.36


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
    everywhere = [(one.cpu_ms, one.error) for spots in reached.values() for one in spots]
    words: list[tuple[str, tuple[float, float]]] = []
    for name, spots in reached.items():
        stroke = style.stroke_of(reached, name)
        line = [(one.cpu_ms, one.error) for one in spots if one.values]
        axes.plot(*np.reshape(line, (-1, 2)).T, linewidth=1.0, alpha=0.6, **stroke)
        for one in spots:
            at = one.cpu_ms, one.error
            on_front = not any(other != at and other[0] <= at[0] and other[1] <= at[1] for other in everywhere)
            face = stroke["color"] if on_front else "white"
            axes.plot(*at, marker="o", markersize=6.0 if on_front else 3.5, markerfacecolor=face, **stroke)
            values = one.values if len(spots) > 1 else ()
            words.append((" = ".join([*values, *([_word(axis)] if one.is_clean else [])]), at))
    cpu_ms, errors = np.reshape(everywhere, (-1, 2)).T
    if cpu_ms.size:
        style.scale_by_decades(axes, 0.8 * cpu_ms.min(), 1.6 * cpu_ms.max(), "x")
        style.scale_by_decades(axes, 0.8 * errors.min(), 1.25 * errors.max())
    title = f"{sweep.grid.case.name}: error against time over {axis.name}"
    style.add_title(figure, title)
    style.legend_below(figure, style.entries_of(sweep.estimators, [(name, "final") for name in sweep.estimators]))
    figure.draw_without_rendering()  # where words are is known of what is laid out
    _label(axes, words)
    caption = (
        f"{metric.name} against processor time over the values of {axis.name} on {sweep.grid.case.name}, means over "
        "the runs; values of one error are one point, at the fastest. Filled: on the Pareto front, no other is both "
        "more accurate and faster."
    )
    return NamedFigure(f"pareto_{plain_name(axis.name)}", caption, figure)


def _label(axes: Axes, words: list[tuple[str, tuple[float, float]]]) -> None:
    """Write a word beside each point, on the first side where it covers no other word, or not where there is none."""
    taken: list[Bbox] = []
    for word, at in words:
        for x, y in ((4, 4), (4, -9), (-4, 4), (-4, -9)):
            side = "left" if x > 0 else "right"
            text = axes.annotate(word, at, (x, y), textcoords="offset points", ha=side, fontsize=style.SMALL_PT)
            text.set_color(style.MUTED_COLOUR)
            box = text.get_window_extent()
            if not any(box.overlaps(other) for other in taken):
                taken.append(box)
                break
            text.remove()


class _Spot(NamedTuple):
    """Where values of an axis lead to that have one error: the CPU (ms) of the fastest of them, and the error."""

    cpu_ms: float
    error: float
    values: tuple[str, ...]
    is_clean: bool


def _reached(sweep: Sweep, axis: Axis, name: str) -> list[_Spot]:
    """Return what an estimator reaches where all its runs are ok, in the order of the axis and the clean one last."""
    by_error: dict[float, list[tuple[float, Point]]] = {}
    for point in (*axis.points, CLEAN):
        one = sweep.effects[name, point]
        if one.ok == one.runs and one.error and one.cpu_ms:
            by_error.setdefault(one.error, []).append((one.cpu_ms, point))
    return [
        _Spot(min(alike)[0], error, tuple(shown_value(p[0][1]) for _, p in alike if p), any(not p for _, p in alike))
        for error, alike in by_error.items()
    ]


class _Bar(NamedTuple):
    """A bar: its row, colour, the line that it starts from, its effect and what is done there.

    It goes to the left where an ingredient is taken away.
    """

    row: float
    colour: str
    start: float
    effect: ContributionRecord
    kind: Kind | None

    @property
    def ends(self) -> tuple[float, float, float]:
        one, sign = self.effect.error, -1.0 if self.kind == "taken" else 1.0
        assert one is not None
        end, *interval = (self.start + sign * math.log(value) for value in (one.factor, one.low, one.high))
        return end, min(interval), max(interval)


def draw_explanation(explanation: Explanation) -> Iterator[NamedFigure]:
    """Yield the figure of an explanation; none where the two estimators cannot be compared."""
    found = explanation_document(explanation)
    whole, (start, goal) = found.gap.error, (str(found.gap.less), str(found.gap.more))
    if whole is None:
        return
    parts, gap = [part for part in found.parts if part.effects], math.log(whole.factor)
    bars = [_Bar(0.0, _WHOLE, 0.0, found.gap, None)]
    for row, part in enumerate(parts, start=1):
        top = row - 0.5 * _BAR * (len(part.effects) - 1)
        for k, (of_second, kind, effect) in enumerate(placed(found, part)):
            bars.append(_Bar(top + k * _BAR, *((_LAST, gap) if of_second else (_FIRST, 0.0)), effect, kind))
    figure = style.new_figure(_AROUND_IN + _ROW_IN * (1 + len(parts)))
    axes, words = figure.subplots(1, 2, sharey=True, width_ratios=(1.0, 1.2))
    ends = [0.0, gap, *(bar.ends[0] for bar in bars if bar.effect.error is not None)]
    least, most = (min(max(end, min(0.0, gap) - _REACH), max(0.0, gap) + _REACH) for end in (min(ends), max(ends)))
    axes.set_xlim(least - _ROOM, most + _ROOM)
    axes.set_ylim(len(parts) + 0.6, -0.7)
    style.label_axes(axes, "", f"times as accurate as {start}", "")
    _log_ticks(axes)
    axes.set_yticks(range(len(parts) + 1), ["all of it", *(part.ingredient for part in parts)], fontsize=style.LABEL_PT)
    for at, name, colour in ((0.0, start, _FIRST), (gap, goal, _LAST)):
        axes.axvline(at, color=colour, linewidth=1.0)
        axes.annotate(
            name, (at, 1.0), (0.0, 3.0), xycoords=("data", "axes fraction"), textcoords="offset points",
            color=colour, fontsize=style.TICK_PT, ha="right" if at == min(0.0, gap) else "left",
        )  # fmt: skip
    words.axis("off")
    words.set_xlim(0.0, 1.0)
    for at, head in ((_EFFECT_AT, "error without/with"), (_BASE_AT, "base")):
        words.text(at, -0.62, head, fontsize=style.TICK_PT, color=style.MUTED_COLOUR)
    for bar in bars:
        _draw_bar(axes, words, bar)
    style.legend(figure, _key(found), columns=1, loc="outside lower left")
    yield NamedFigure(
        "waterfall",
        f"What each ingredient brings near {start} (blue) and near {goal} (orange), in the pair of estimators that "
        "is named beside it: to the right where it is added, to the left where it is taken away. The bars need not "
        "add up.",
        figure,
    )


def _key(found: ExplanationRecord) -> list[Entry]:
    start, goal = found.gap.less, found.gap.more
    drawn = "world and noise" if found.settings.get("vary") == "world" else "the noise of the sensors"
    what = f"; each draws {drawn} anew, the same for all estimators" if found.intervals == "seeds" else ""
    named = {
        f"{goal} against {start}": (_WHOLE, 1.0),
        f"an ingredient at the base nearest to {start}, drawn from the line of {start}": (_FIRST, 1.0),
        f"an ingredient at the base nearest to {goal}, drawn from the line of {goal}": (_LAST, 1.0),
        "pale: no more than chance": (_FIRST, _PALE),
    }
    bars = [Entry(label, Patch(color=colour, alpha=alpha)) for label, (colour, alpha) in named.items()]
    return [*bars, Entry.of_line(f"95 % interval over {over(found)}{what}", "black", width=1.0)]


def _draw_bar(axes: Axes, words: Axes, bar: _Bar) -> None:
    one, effect = bar.effect.error, bar.effect
    told = f"{effect.ok} of {effect.runs} ended well"
    is_sure = effect.shown or (bar.kind is None and one is not None and one.is_off)
    if one is not None:
        end, *interval = bar.ends
        axes.barh(bar.row, end - bar.start, _BAR, bar.start, color=bar.colour, alpha=1.0 if is_sure else _PALE)
        axes.plot(interval, [bar.row, bar.row], color="black", linewidth=1.0, marker="|", markersize=5.0)
        told = f"{number(one.factor)} ({number(one.low)}-{number(one.high)})"
    colour = bar.colour if is_sure else style.MUTED_COLOUR
    words.text(_EFFECT_AT, bar.row, told, fontsize=style.SMALL_PT, color=colour, va="center")
    if bar.kind is not None:
        at = where(bar.kind, effect)
        words.text(_BASE_AT, bar.row, at, fontsize=style.SMALL_PT, color=style.MUTED_COLOUR, va="center", wrap=True)


def _log_ticks(axes: Axes) -> None:
    low, high = axes.get_xlim()
    ticks = [tick for tick in _TICKS if low <= math.log(tick) <= high]
    if len(ticks) < 3:
        ticks = [tick for tick in _FINE_TICKS if low <= math.log(tick) <= high]
    axes.set_xticks([math.log(tick) for tick in ticks], [f"{tick:g}" for tick in ticks])


# By the document that the figures stand beside.
DRAWN: Mapping[str, Callable[[Any], Iterator[NamedFigure]]] = {
    "sweep.json": draw_sweep,
    "explain.json": draw_explanation,
}
