"""An explanation as bars, with intervals: from the left what each ingredient brings the first estimator, from the right
what the second loses without it.
"""

import math
from collections.abc import Iterator
from typing import NamedTuple

from matplotlib.axes import Axes
from matplotlib.patches import Patch

from toolkit.experiment.explanation import ContributionRecord
from toolkit.report.explanation import ExplanationRecord, Kind, over, placed, where
from toolkit.report.figures import style
from toolkit.report.figures.style import Entry, NamedFigure
from toolkit.report.text import number

_FIRST, _LAST, _WHOLE = "#0072B2", "#D55E00", "#5b6670"
# Bars of effects that may be chance are pale.
_PALE = 0.3
_ROW_IN, _AROUND_IN, _BAR = 0.46, 1.9, 0.38
# The axis has this room on either side of the bars, which it cuts where they reach further than the second.
_ROOM, _MOST = math.log(1.25), math.log(30.0)
_TICKS = (0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0, 200.0, 500.0, 1000.0)
_FINE_TICKS = (0.5, 0.6, 0.8, 1.0, 1.2, 1.5, 2.0)
# Where the columns beside the bars begin.
_EFFECT_AT, _BASE_AT = 0.0, 0.36


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


def draw_explanation(found: ExplanationRecord) -> Iterator[NamedFigure]:
    """Yield the figure of an explanation; none where the two estimators cannot be compared."""
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
    least, most = (min(max(end, min(0.0, gap) - _MOST), max(0.0, gap) + _MOST) for end in (min(ends), max(ends)))
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
        _draw(axes, words, bar)
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


def _draw(axes: Axes, words: Axes, bar: _Bar) -> None:
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
