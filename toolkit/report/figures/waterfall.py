"""An explanation as bars, with intervals: from the left what each ingredient brings the first estimator, from the right
what the second loses without it.
"""

import math
from collections.abc import Iterator
from typing import Literal

from matplotlib.axes import Axes

from toolkit.report.explanation import ContributionRecord, ExplanationRecord, Kind, kinds, where
from toolkit.report.figures.style import (
    LABEL_PT,
    MUTED_COLOUR,
    SMALL_PT,
    TICK_PT,
    NamedFigure,
    new_figure,
    style_axes,
)
from toolkit.report.text import number

_FIRST, _LAST = "#0072B2", "#D55E00"
_COLOUR_OF = {"from": "#5b6670", "added": _FIRST, "taken": _LAST}
# Bars of effects that may be chance are pale.
_PALE = 0.3
_ROW_IN, _AROUND_IN, _BAR = 0.46, 0.9, 0.38
# The axis has room for this part of the gap, and at least a factor of this size, on either side.
_ROOM, _LEAST_ROOM = 0.35, math.log(1.3)
_TICKS = (0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0, 200.0, 500.0, 1000.0)
_FINE_TICKS = (0.5, 0.6, 0.7, 0.8, 0.9, 1.0, 1.1, 1.2, 1.4, 1.6, 1.8, 2.0)


def draw_explanation(found: ExplanationRecord) -> Iterator[NamedFigure]:
    """Yield the figure of an explanation; none where the two estimators cannot be compared."""
    whole, (start, goal) = found.gap.error, (str(found.gap.less), str(found.gap.more))
    if whole is None:
        return
    parts, gap = [part for part in found.parts if part.effects], math.log(whole.factor)
    figure = new_figure(_AROUND_IN + _ROW_IN * (1 + len(parts)))
    axes, words = figure.subplots(1, 2, sharey=True, width_ratios=(1.0, 0.9))
    least, most = min(0.0, gap), max(0.0, gap)
    room = max(_ROOM * (most - least), _LEAST_ROOM)
    axes.set_xlim(least - room, most + room)
    axes.set_ylim(len(parts) + 0.6, -0.7)
    style_axes(axes, "", f"times as accurate as {start}", "")
    _log_ticks(axes)
    axes.set_yticks(range(len(parts) + 1), ["all of it", *(part.ingredient for part in parts)], fontsize=LABEL_PT)
    for at, name, colour in ((0.0, start, _FIRST), (gap, goal, _LAST)):
        axes.axvline(at, color=colour, linewidth=1.0)
        axes.annotate(
            name, (at, 1.0), (0.0, 3.0), xycoords=("data", "axes fraction"), textcoords="offset points",
            color=colour, fontsize=TICK_PT, ha="right" if at == least else "left",
        )  # fmt: skip
    words.axis("off")
    words.set_xlim(0.0, 1.0)
    _effect(axes, words, 0.0, found.gap, "from", 0.0)
    for row, part in enumerate(parts, start=1):
        for k, (kind, effect) in enumerate(kinds(found, part)):
            place = row + (k - 0.5 * (len(part.effects) - 1)) * _BAR
            _effect(axes, words, place, effect, kind, gap if kind == "taken" else 0.0)
    yield NamedFigure(
        "waterfall",
        f"What each ingredient brings {start} (blue, from the left) and what {goal} loses without it (orange, from the "
        "right), or the pairs of estimators nearest to them, with 95 % intervals; pale: no more than chance. The bars "
        "need not add up.",
        figure,
    )


def _effect(
    axes: Axes, words: Axes, row: float, effect: ContributionRecord, kind: Kind | Literal["from"], start: float
) -> None:
    """Draw a bar with its interval, to the left where an ingredient is taken away, and say beside it what it is."""
    one, sign = effect.error, -1.0 if kind == "taken" else 1.0
    told = f"{effect.ok} of {effect.runs} ended well"
    is_sure = effect.shown or (kind == "from" and one is not None and one.is_off)
    if one is not None:
        width, *ends = (sign * math.log(value) for value in (one.factor, one.low, one.high))
        axes.barh(row, width, _BAR, start, color=_COLOUR_OF[kind], alpha=1.0 if is_sure else _PALE)
        axes.plot([start + end for end in ends], [row, row], color="black", linewidth=1.0, marker="|", markersize=5.0)
        told = f"{number(one.factor)} ({number(one.low)}-{number(one.high)})"
    words.text(0.0, row, told, fontsize=SMALL_PT, color=_COLOUR_OF[kind] if is_sure else MUTED_COLOUR, va="center")
    told = "" if kind == "from" else where(kind, effect)
    words.text(0.36, row, told, fontsize=SMALL_PT, color=MUTED_COLOUR, va="center", wrap=True)


def _log_ticks(axes: Axes) -> None:
    low, high = axes.get_xlim()
    ticks = [tick for tick in _TICKS if low <= math.log(tick) <= high]
    if len(ticks) < 3:
        ticks = [tick for tick in _FINE_TICKS if low <= math.log(tick) <= high]
    axes.set_xticks([math.log(tick) for tick in ticks], [f"{tick:g}" for tick in ticks])
