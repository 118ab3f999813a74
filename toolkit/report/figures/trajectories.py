"""Trajectory files of any systems: the map, errors over time, and every run's error as boxes.

Of each system it is the run of the middle error that is drawn, after the fit of SE(3) to its positions, as evo's -a.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from toolkit.errors import DataError
from toolkit.evaluation.scoring import TruthFile, aligned_file
from toolkit.evaluation.standings import EvaluatedSystems, RunRecord
from toolkit.files.writing import plain_name
from toolkit.measurements import NS_PER_S
from toolkit.metrics import Unavailable
from toolkit.metrics.parts.evaluation import Matched, angles_deg, changes, lengths, rmse
from toolkit.report.figures import style
from toolkit.report.figures.style import Entry, NamedFigure
from toolkit.report.text import number

# Systems in a figure of trajectories, from the first of the leaderboard; sequences that are drawn unless all are asked
# for; and sequences that have a panel of boxes each.
_MOST_SYSTEMS, _FEW_SEQUENCES, _MOST_PANELS = 7, 3, 12
_FITTED = "after the fit of SE(3)"
_TRUTH = Entry.of_line("truth", style.TRUTH_COLOUR)


class _Drawn(NamedTuple):
    """What is drawn of a system: its colour, and its pairs with the truth."""

    system: str
    colour: str
    matched: Matched


def draw(evaluation: EvaluatedSystems, *, all_sequences: bool = False) -> Iterator[NamedFigure]:
    """Yield boxes of all runs, then the figures of the first few sequences or of all, each when it is reached."""
    yield from _boxes(evaluation)
    sequences = evaluation.ranked_sequences[: None if all_sequences else _FEW_SEQUENCES]
    for i, sequence in enumerate(sequences):
        truth, drawn = evaluation.truths[sequence], _drawn(evaluation, sequence)
        if not drawn:
            continue
        name = plain_name(sequence) or "sequence"
        name = f"{name}-{i + 1}" if name in map(plain_name, sequences[:i]) else name
        yield _map(name, truth, drawn)
        yield _errors(name, truth, drawn)


def _drawn(evaluation: EvaluatedSystems, sequence: str) -> list[_Drawn]:
    truth, found = evaluation.truths[sequence], []
    for standing in evaluation.leaderboard[:_MOST_SYSTEMS]:
        system = standing.estimator
        run = _middle(evaluation, system, sequence)
        if run is None or run.file is None:
            continue
        try:
            matched = aligned_file(Path(run.file), truth, evaluation.terms)
        except (DataError, Unavailable):  # a file that went away, or one whose positions nothing can be fitted to
            continue
        found.append(_Drawn(system, style.colour_at(evaluation.systems.index(system)), matched))
    return found


def _middle(evaluation: EvaluatedSystems, system: str, sequence: str) -> RunRecord | None:
    key, runs = evaluation.ranked_by.key, evaluation.ok_runs(system, sequence)
    good = [(value, run) for run in runs if (value := run.metrics.get(key)) is not None]
    ordered = sorted(good, key=lambda pair: pair[0])
    return ordered[(len(ordered) - 1) // 2][1] if ordered else None


def _map(name: str, truth: TruthFile, drawn: list[_Drawn]) -> NamedFigure:
    figure = style.new_figure(5.0)
    axes = figure.subplots()
    axes.plot(*truth.poses[:, :2, 3].T, color=style.TRUTH_COLOUR, linewidth=2.2)
    for one in drawn:
        axes.plot(*one.matched.estimate[:, :2, 3].T, color=one.colour, linewidth=1.2)
    axes.plot(*truth.poses[0, :2, 3], "o", color=style.TRUTH_COLOUR, markersize=5.0)
    axes.set_aspect("equal", adjustable="datalim")
    style.label_axes(axes, f"{truth.name} from above, {_FITTED}", "x [m]", "y [m]")
    style.legend_below(figure, [_TRUTH, *(Entry.of_line(one.system, one.colour) for one in drawn)])
    return NamedFigure(f"map_{name}", f"{truth.name} from above, from the dot on, {_FITTED} to all positions.", figure)


def _errors(name: str, truth: TruthFile, drawn: list[_Drawn]) -> NamedFigure:
    with_angles = changes(truth.poses[:, :3, :3])
    figure = style.new_figure(4.4 if with_angles else 2.8)
    grid = figure.subplots(1 + with_angles, 1, sharex=True, squeeze=False).ravel()
    entries: list[Entry] = []
    sizes: list[float] = []
    largest = 0.0
    for one in drawn:
        pairs = one.matched
        at_s = (pairs.t_ns - truth.t_ns[0]) / NS_PER_S if truth.is_timed else np.arange(pairs.t_ns.size)
        error_m = lengths(pairs.truth[:, :3, 3] - pairs.estimate[:, :3, 3])
        grid[0].plot(at_s, error_m, color=one.colour, linewidth=1.2)
        sizes, largest = [*sizes, rmse(error_m)], max(largest, float(error_m.max()))
        told = f"{one.system}: RMSE {number(rmse(error_m))} m, median {number(float(np.median(error_m)))} m"
        if with_angles:
            error_deg = angles_deg(np.swapaxes(pairs.truth[:, :3, :3], 1, 2) @ pairs.estimate[:, :3, :3])
            grid[1].plot(at_s, error_deg, color=one.colour, linewidth=1.2)
            told += f"; {number(rmse(error_deg))} deg, {number(float(np.median(error_deg)))} deg"
        entries.append(Entry.of_line(told, one.colour))
    style.label_axes(grid[0], f"{truth.name}: position error, {_FITTED}", "", "position [m]")
    if with_angles:
        style.label_axes(grid[1], "rotation error", "", "rotation [deg]")
        grid[1].set_ylim(bottom=0.0)
    grid[-1].set_xlabel("time [s]" if truth.is_timed else "pose")
    style.scale_errors(grid[0], sizes, 1.05 * largest)
    figure.align_ylabels()
    style.legend_below(figure, entries)
    return NamedFigure(
        f"errors_{name}", f"Errors on {truth.name} over time, {_FITTED}, with their RMSE and median.", figure
    )


def _boxes(evaluation: EvaluatedSystems) -> Iterator[NamedFigure]:
    """Yield boxes of the ranking error: over the runs of each sequence, or of many sequences over their medians."""
    metric, systems = evaluation.ranked_by, evaluation.systems
    cells, sequences = evaluation.cells, evaluation.ranked_sequences
    if len(sequences) > _MOST_PANELS:
        medians = {name: [cells[name, sequence].median(metric) for sequence in sequences] for name in systems}
        groups, over = {"all sequences": medians}, f"the medians of {len(sequences)} sequences"
    else:
        over = "the runs that are ok"
        groups = {
            sequence: {
                name: [run.metrics.get(metric.key) for run in evaluation.ok_runs(name, sequence)] for name in systems
            }
            for sequence in sequences
        }
    figure, panels = style.panels_of(list(groups), "", 2.0)
    every = []
    for sequence, axes in panels.items():
        axes.set_xticks([])
        for place, name in enumerate(systems):
            values = [value for value in groups[sequence][name] if value is not None]
            colour = style.colour_at(place)
            if values:
                line = {"color": colour, "linewidth": 1.3}
                axes.boxplot(
                    [values], positions=[place], widths=0.6, whis=(0.0, 100.0), manage_ticks=False,
                    boxprops=line, whiskerprops=line, capprops=line, medianprops=line,
                )  # fmt: skip
                axes.plot(np.full(len(values), place), values, ".", color=colour, markersize=4.0, alpha=0.6)
            every += values
    if not every:
        return
    style.scale_errors(next(iter(panels.values())), every, 1.2 * max(every))
    unit = f" [{metric.unit}]" if metric.unit not in ("", "1") else ""
    entries = [Entry.of_line(name, style.colour_at(place)) for place, name in enumerate(systems)]
    style.finish(figure, panels, f"{metric.name}{unit}", f"{metric.name} over {over}", entries)
    caption = f"{metric.name} over {over}: median, quartiles, least and most, and every value as a dot."
    yield NamedFigure("boxes", caption, figure)
