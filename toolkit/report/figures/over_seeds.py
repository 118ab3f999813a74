"""Error and NEES over time, over the seeds: one small panel an estimator, all on the same axes."""

from collections.abc import Iterator

import numpy as np
from matplotlib.patches import Patch

from toolkit.estimate import Output
from toolkit.experiment.comparison import Comparison, Row
from toolkit.report.figures.panels import (
    RANGE,
    Drawn,
    Normalised,
    figure_with_bands,
    finish,
    output_entries,
    panels_of,
)
from toolkit.report.figures.style import MUTED_COLOUR, Entry, NamedFigure, colour_of, line_of


def draw(over: Comparison) -> Iterator[NamedFigure]:
    """Yield the figure of position errors and that of NEES, each where there is anything to draw."""
    if any(group.position_m is not None for group in over.rows):
        yield _errors(over)
    if any(group.mean_nees is not None for group in over.rows):
        yield _nees(over)


def _errors(over: Comparison) -> NamedFigure:
    figure, panels = panels_of(over.estimators)
    kinds: set[Output] = set()
    for group in over.rows:
        errors_m = group.position_m
        if errors_m is None or _repeats(over, group):
            continue
        known = np.isfinite(errors_m).any(axis=0)
        lower, median, upper = np.nanpercentile(errors_m[:, known], [25.0, 50.0, 75.0], axis=0)
        kind = _shown_as(over, group)
        axes, t_s, colour = panels[group.estimator], over.sequence.frames_s[known], colour_of(over, group.estimator)
        axes.fill_between(t_s, lower, upper, color=colour, alpha=0.2, linewidth=0.0)
        axes.plot(t_s, median, color=colour, linestyle=line_of(kind), linewidth=1.2)
        kinds.add(kind)
    title = f"{over.name}, {len(over.seeds)} seeds: position error from the common start"
    quartiles = Entry("quartiles (lines: medians)", (Patch(color=MUTED_COLOUR, alpha=0.2),))
    finish(figure, panels, "position error [m]", title, [*output_entries(kinds), quartiles])
    next(iter(panels.values())).set_ylim(bottom=0.0)
    caption = (
        f"Position error over time on {over.name}, {len(over.seeds)} seeds, from the common start: the median and, "
        "shaded, the quartiles over the runs that are ok. Dashed: causal, what was known at the time. Solid: final."
    )
    return NamedFigure("errors_over_seeds", caption, figure)


def _nees(over: Comparison) -> NamedFigure:
    drawn = [
        Drawn(
            group.estimator,
            colour_of(over, group.estimator),
            _shown_as(over, group),
            Normalised(over.sequence.frames_s, nees.mean, nees.low, nees.high),
        )
        for group in over.rows
        if (nees := group.mean_nees) is not None and not _repeats(over, group)
    ]
    caption = (
        f"Pose NEES over its 6 degrees of freedom on {over.name}, averaged over the runs that are ok of "
        f"{len(over.seeds)} seeds, and the 95 % chi-square band of a consistent estimator (grey). Above the band an "
        f"estimator is overconfident. What is beyond {RANGE[0]:g} and {RANGE[1]:g} is drawn there."
    )
    title = f"{over.name}, {len(over.seeds)} seeds: mean pose NEES / 6"
    figure = figure_with_bands(over.estimators, drawn, "pose NEES / 6", title)
    return NamedFigure("nees_over_seeds", caption, figure)


def _repeats(over: Comparison, group: Row) -> bool:
    """Say whether a group's errors are those of the estimator's other output, as a filter's final ones are."""
    return group.output == "final" and _same_as_causal(over, group)


def _same_as_causal(over: Comparison, group: Row) -> bool:
    causal = next((g for g in over.rows if g.estimator == group.estimator and g.output == "causal"), None)
    if causal is None or causal.position_m is None or group.position_m is None:
        return False
    return np.array_equal(causal.position_m, group.position_m, equal_nan=True)


def _shown_as(over: Comparison, group: Row) -> Output:
    """Return the output whose look a group has: a filter's only answer is drawn as a final one."""
    both = any(g.estimator == group.estimator and _repeats(over, g) for g in over.rows)
    return "final" if both else group.output
