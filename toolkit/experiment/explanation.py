"""Why one estimator is more accurate than another: what each ingredient brings to the first, and costs the second.

For each ingredient the pair of variants nearest to the first estimator tells what it brings there alone (*first in*),
the pair nearest to the second what is lost without it (*last in*). The two need not agree, and the effects of all
ingredients need not add up to the whole: what one brings depends on what else is there.

Effects are differences of logarithms, paired by seed, or of a single recording over its stretches, with Student's
intervals. Several are tested at once, so an effect on a measure is called shown only where Holm's test over all effects
on that measure finds it.
"""

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import NamedTuple, TypeVar

import msgspec
import numpy as np

from toolkit.errors import EstimatorError
from toolkit.experiment.comparison import NEES, Row
from toolkit.experiment.contests import HELD_OUT, accuracy_of
from toolkit.experiment.grid import Grid, prepared_case, run_grid
from toolkit.experiment.ingredients import Edge, Pairings, Variant, compared, variants_of
from toolkit.experiment.pipeline import Plan
from toolkit.experiment.statistics import LEVEL, Paired, holm
from toolkit.geometry import Array
from toolkit.jackknife import STRETCHES, jackknife_cov
from toolkit.progress import ProgressFor, silent
from toolkit.registry import EstimatorEntry, defaults, find, find_all
from toolkit.settings.records import Metrics

Key = TypeVar("Key")
EXCESS = "excess_pose"
# What differences are taken of: the error, the variance beyond the Cramér-Rao bound, and the NEES.
ERROR, VARIANCE = "error", "variance"
# With fewer seeds, or values of one recording, nothing is tested.
_FEWEST_SEEDS, _FEWEST_VALUES = 3, 2 * STRETCHES


class Measure(NamedTuple):
    """How rows are compared: the values (n,) of one, by seed or in order of time, and the logarithm of their level.

    Of fewer values than ``fewest`` nothing is told. A jackknife leaves out one of ``blocks``, or one value, at a time.
    """

    values: Callable[[Row], Array]
    level: Callable[[Array], float]
    fewest: int
    blocks: int | None = None


@dataclass(frozen=True, eq=False)
class Contribution:
    """What an ingredient brings between two variants, by measure: the logarithm of that without it over that with it.

    Under ``ok`` of ``runs`` seeds both ended well. ``shown`` has the measures that it changes by more than chance.
    """

    edge: Edge
    runs: int
    ok: int
    by: Mapping[str, Paired | None]
    shown: frozenset[str] = frozenset()

    @property
    def on_error(self) -> Paired | None:
        """Return the effect on the error."""
        return self.by[ERROR]


@dataclass(frozen=True, eq=False)
class Ingredient:
    """An ingredient's effect first in and last in; both are one effect where there is one pair, None where none.

    ``order`` is how much more it brings first in, None unless that is more than chance.
    """

    ingredient: str
    first: Contribution | None
    last: Contribution | None
    order: Paired | None = None


@dataclass(frozen=True, eq=False)
class Explanation:
    """Two estimators, how much more accurate the second is, and what each ingredient brings, the most first.

    ``metric`` is the key of the error. ``gap`` compares the two themselves.
    """

    start: Variant
    goal: Variant
    grid: Grid
    metric: str
    gap: Contribution
    parts: tuple[Ingredient, ...]

    @property
    def over_seeds(self) -> bool:
        """Say whether intervals are over seeds, not over stretches of one recording."""
        return len(self.grid.plan.seeds) > 1


def run_explanation(
    plan: Plan, start: str, goal: str, directory: Path | None = None, progress_for: ProgressFor = silent
) -> Explanation:
    """Run what tells why one estimator is more accurate than another on the plan's one source, and compare.

    Steps between the two are variants of the plan's estimators. Outcomes are kept in a directory and found there again.
    Raises as :func:`toolkit.experiment.grid.run_grid` and :func:`toolkit.experiment.ingredients.compared` do.
    """
    steps = {name: one for name, one in find_all(plan.estimators).items() if _is_usable(one)}
    entries = {**find_all((start, goal)), **steps}
    settings = msgspec.structs.replace(plan.settings, metrics=Metrics(bound=len(plan.seeds) > 1))
    plan = replace(plan, settings=settings, estimators=tuple(entry.word for entry in entries.values()))
    case = prepared_case(plan, progress_for)
    variants = [one for entry in entries.values() for one in variants_of(entry, settings, case)]
    found = compared(find(start).name, find(goal).name, variants)
    return explained(found, run_grid(plan, {one.trial: None for one in _all(found)}, directory, progress_for, case))


def default_ends() -> tuple[str, str]:
    """Return the lowest and the highest rung of those compared by default that declare their ingredients.

    Raises EstimatorError where there are not two.
    """
    names = [name for name in defaults() if find(name).ingredients()]
    if len(names) < 2:
        raise EstimatorError("no two estimators that are compared by default declare INGREDIENTS; name the two")
    return names[0], names[-1]


def _is_usable(entry: EstimatorEntry) -> bool:
    try:
        entry.load()
    except EstimatorError:
        return False
    return True


def _all(found: Pairings) -> tuple[Variant, ...]:
    edges = [edge for pair in found.edges.values() for edge in pair or ()]
    return tuple(dict.fromkeys([found.start, found.goal, *(one for edge in edges for one in (edge.less, edge.more))]))


def explained(found: Pairings, grid: Grid) -> Explanation:
    """Return what the outcomes of all variants tell."""
    rows = {one: grid.row(one.trial, one.output) for one in _all(found)}
    metric = accuracy_of(rows.values())
    metric = metric if any(row.value(metric) is not None for row in rows.values()) else HELD_OUT
    measures = _over_seeds(metric) if len(grid.plan.seeds) > 1 else _over_stretches(metric)
    series = {(key, one): measure.values(row) for one, row in rows.items() for key, measure in measures.items()}

    def difference(key: str, *edges: Edge) -> Paired | None:
        """Return the effect of a pair, or how much larger that of a first pair is than that of a second."""
        arrays = [series[key, one] for edge in edges for one in (edge.less, edge.more)]
        return None if not all(map(len, arrays)) else _paired(np.array(arrays), measures[key])

    def effect(edge: Edge) -> Contribution:
        ended = zip(rows[edge.less].outcomes, rows[edge.more].outcomes, strict=True)
        ok = [less.status == more.status == "ok" for less, more in ended]
        return Contribution(edge, len(ok), sum(ok), {key: difference(key, edge) for key in measures})

    pairs = {name: pair for name, pair in found.edges.items() if pair is not None}
    effects = _tested({edge: effect(edge) for pair in pairs.values() for edge in pair}, measures)
    orders = {name: difference(ERROR, *pair) for name, pair in pairs.items() if pair[0].less != pair[1].less}
    clear = _found_by_holm(orders)
    parts = [
        Ingredient(name, pair and effects[pair[0]], pair and effects[pair[1]], clear.get(name))
        for name, pair in found.edges.items()
    ]
    gap = effect(Edge("", found.start, found.goal, 0, at=True))
    return Explanation(found.start, found.goal, grid, metric, gap, tuple(sorted(parts, key=_size, reverse=True)))


def _tested(effects: Mapping[Edge, Contribution], measures: Iterable[str]) -> dict[Edge, Contribution]:
    """Return effects with what the tests over all of them show; a pair that stands for first and last counts once."""
    shown = {
        key: _found_by_holm({(edge.less, edge.more): effect.by[key] for edge, effect in effects.items()})
        for key in measures
    }
    return {
        edge: replace(effect, shown=frozenset(key for key, pairs in shown.items() if (edge.less, edge.more) in pairs))
        for edge, effect in effects.items()
    }


def _found_by_holm(tests: Mapping[Key, Paired | None]) -> dict[Key, Paired]:
    known = {key: one for key, one in tests.items() if one is not None}
    adjusted = holm(np.array([one.p for one in known.values()])).tolist()
    return {key: one for (key, one), p in zip(known.items(), adjusted, strict=True) if p <= LEVEL}


def _size(part: Ingredient) -> float:
    known = [effect.on_error.mean for effect in (part.first, part.last) if effect and effect.on_error]
    return sum(known) / len(known) if known else -math.inf


def _over_seeds(metric: str) -> dict[str, Measure]:
    def logs(key: str, beyond: float, row: Row) -> Array:
        values = np.array([np.nan if value is None else value for value in row.good_values(key)], dtype=float)
        with np.errstate(divide="ignore"):
            return np.asarray(np.log(beyond + values))

    keys = {ERROR: (metric, 0.0), VARIANCE: (EXCESS, 1.0), NEES: (NEES, 0.0)}
    return {name: Measure(partial(logs, *key), np.mean, _FEWEST_SEEDS) for name, key in keys.items()}


def _over_stretches(metric: str) -> dict[str, Measure]:
    def values(name: str, row: Row) -> Array:
        scored = row.outcomes[0].outputs.get(row.output) if row.status == "ok" else None
        return np.empty(0) if scored is None else np.asarray(getattr(scored, name))

    # Of withheld tracks the values are medians, of which one bad stretch is not to decide all.
    of_error = ("heldout_px", _mean_log) if metric == HELD_OUT else ("drift_m", _log_rms)
    error = Measure(partial(values, of_error[0]), of_error[1], _FEWEST_VALUES, STRETCHES)
    nees = Measure(partial(values, "nees_pose"), _log_mean, _FEWEST_VALUES, STRETCHES)
    return {ERROR: error, NEES: nees}


def _log_rms(values: Array) -> float:
    return 0.5 * _log_mean(values**2)


def _mean_log(values: Array) -> float:
    return float(np.log(values).mean())


def _log_mean(values: Array) -> float:
    return float(np.log(values.mean()))


def _paired(rows: Array, measure: Measure) -> Paired | None:
    """Return level less level of two rows (2, n), less that of two more of (4, n); None with too few known values.

    By a jackknife, which over seeds gives the standard error of the mean difference.
    """
    rows = rows[:, np.isfinite(rows).all(axis=0)]
    blocks = measure.blocks or rows.shape[1]
    if rows.shape[1] < measure.fewest:
        return None

    def estimate(*given: Array) -> Array:
        return np.array([sum(sign * measure.level(row) for sign, row in zip((1, -1, -1, 1), given, strict=False))])

    mean, error = float(estimate(*rows)[0]), float(np.sqrt(jackknife_cov(estimate, *rows, stretches=blocks)[0, 0]))
    return Paired(blocks, mean, error) if np.isfinite([mean, error]).all() else None
