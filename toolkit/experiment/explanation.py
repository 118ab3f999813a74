"""Why one estimator is more accurate than another: what each ingredient brings to the first, and costs the second.

An estimator declares what it has, and the settings that take some of it away (:mod:`toolkit.registry`). Gate and loss,
the measured noise and the audit's repairs are not declared: settings take them away from every estimator alike. A
variant is an estimator without some of its ingredients. Two variants whose sets differ by one ingredient, of one
estimator or of two, show by their difference what it brings, beside the ingredients that both have.

For each ingredient the pair of variants nearest to the first estimator tells what it brings there alone (*first in*),
the pair nearest to the second what is lost without it (*last in*). The two need not agree, and the effects of all
ingredients need not add up to the whole: what one brings depends on what else is there.

Effects are differences of logarithms, paired by seed, or of a single recording over its stretches, with Student's
intervals. Several are tested at once, so an effect on a measure is called shown only where Holm's test over all effects
on that measure finds it.
"""

import math
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import msgspec
import numpy as np

from toolkit.answers import Output
from toolkit.errors import EstimatorError
from toolkit.experiment.comparison import NEES, Row
from toolkit.experiment.contests import HELD_OUT, error_of
from toolkit.experiment.grid import Grid, Trial, prepared_case, run_grid
from toolkit.experiment.pipeline import Plan
from toolkit.experiment.recording import Prepared
from toolkit.experiment.statistics import LEVEL, Paired, holm
from toolkit.geometry import Array
from toolkit.jackknife import STRETCHES, jackknife_cov
from toolkit.progress import ProgressFor, silent
from toolkit.registry import EstimatorEntry, defaults, find, find_all
from toolkit.settings import Metrics, Scalar, Settings, as_values
from toolkit.settings.reading import value_at

Key = TypeVar("Key")
EXCESS = "excess_pose"
# What differences are taken of: the error, the variance beyond the Cramér-Rao bound, and the NEES.
ERROR, VARIANCE = "error", "variance"
# With fewer seeds, or values of one recording, nothing is tested.
FEWEST_SEEDS, _FEWEST_VALUES = 3, 2 * STRETCHES
GATE, NOISE, FUTURE = "gate and loss", "measured noise", "the future"
OUTPUT, _REPAIR = "output", "repair of "
_STATED: Mapping[str, Scalar] = {"noise.track_weight": 1.0, "noise.motion_scale": 1.0}


@dataclass(frozen=True)
class Variant:
    """One kind of output of an estimator without some ingredients, and what it has: how it is run is its trial."""

    name: str
    trial: Trial
    output: Output
    has: frozenset[str]
    without: tuple[str, ...] = ()

    def __str__(self) -> str:
        return called(self.name, self.without)


def called(estimator: str, without: Iterable[str]) -> str:
    """Return how an estimator without some ingredients is called."""
    lacking = ", ".join(f"no {one.removeprefix('the ')}" for one in without)
    return f"{estimator} ({lacking})" if lacking else estimator


class Edge(NamedTuple):
    """Two variants that differ in one ingredient, and in how many others they differ from the one they are to tell of.

    ``at`` says whether that one is among the two.
    """

    ingredient: str
    less: Variant
    more: Variant
    distance: int
    at: bool


def variants_of(entry: EstimatorEntry, settings: Settings, case: Prepared) -> Iterator[Variant]:
    """Yield an estimator with all that it has under the settings, then without each part that can be taken away.

    Measured noise and repairs, which every estimator can lack by itself, are taken away one at a time. An estimator
    that declares nothing has no variants.
    """
    declared = entry.ingredients()
    if not declared:
        return
    own = {name: _full_keys(entry.name, taking) for name, taking in declared.items()}
    if entry.obeys("outliers", case.sequence.motion_kind):
        own[GATE] = {"outliers.policy": "none"}
    values = as_values(settings)
    own = {name: taking for name, taking in own.items() if not (taking and _are_set(values, taking))}
    shared = _shared(values, case)
    has = frozenset({*own, *shared})
    able = [name for name, taking in own.items() if taking]
    for count in range(len(able) + 1):
        for lacking in combinations(able, count):
            for data in ((), *((name,) for name in shared)):
                taken = {key: value for name in lacking for key, value in own[name].items()}
                taken |= {key: value for name in data for key, value in shared[name].items()}
                output = taken.pop(OUTPUT, "final" if FUTURE in has else "causal")
                keep = {name.removeprefix(_REPAIR) for name in data if name.startswith(_REPAIR)}
                trial = Trial.of(entry.word, taken, keep=keep)
                without = (*lacking, *data)
                yield Variant(
                    entry.name, trial, "causal" if output == "causal" else "final", has - set(without), without
                )


def _full_keys(estimator: str, taking: Mapping[str, Scalar]) -> dict[str, Scalar]:
    return {
        key if "." in key or key == OUTPUT else f"estimators.{estimator}.{key}": value for key, value in taking.items()
    }


def _are_set(values: Mapping[str, Any], taking: Mapping[str, Scalar]) -> bool:
    return all(value_at(values, key) == value for key, value in taking.items())


def _shared(values: Mapping[str, Any], case: Prepared) -> dict[str, Mapping[str, Scalar]]:
    """Return what the data have for every estimator alike, with the settings that take it away, none for a repair."""
    found: dict[str, Mapping[str, Scalar]] = {}
    measured = case.measured
    if measured is not None and (measured.tracks.value, measured.motion.value) != (1.0, 1.0):
        found[NOISE] = {key: value for key, value in _STATED.items() if value_at(values, key) == "auto"}
    return found | {f"{_REPAIR}{one.fault}": {} for one in case.findings if one.repaired}


class Pairings(NamedTuple):
    """Two estimators, and for each ingredient the pairs of variants nearest to the first and to the second of them.

    They are the ingredients that one of the two has and the other lacks, and those that can be taken away from both.
    Where no two variants differ in an ingredient alone there is no pair.
    """

    start: Variant
    goal: Variant
    edges: Mapping[str, tuple[Edge, Edge] | None]


def compared(start: str, goal: str, variants: Iterable[Variant]) -> Pairings:
    """Find the pairs of variants that tell in what two estimators differ.

    Raises EstimatorError for an estimator that declares nothing, and where both have the same.
    """
    whole: dict[str, Variant] = {}
    having: dict[frozenset[str], list[Variant]] = defaultdict(list)
    for variant in variants:
        whole.setdefault(variant.name, variant)  # the first of each is the whole estimator
        having[variant.has].append(variant)
    for name in (start, goal):
        if name not in whole:
            raise EstimatorError(f"{name} declares no INGREDIENTS (docs/explain.md says how); {', '.join(whole)} do")
    ends = whole[start], whole[goal]
    differing = ends[0].has ^ ends[1].has
    if not differing:
        raise EstimatorError(f"{start} and {goal} have the same ingredients: there is nothing to explain")
    edges = {name: _edges(name, ends, having) for name in sorted(ends[0].has | ends[1].has)}
    both = {name for name, pair in edges.items() if pair is not None and all(edge.at for edge in pair)}
    return Pairings(*ends, {name: pair for name, pair in edges.items() if name in differing | both})


def _edges(
    name: str, ends: tuple[Variant, Variant], having: Mapping[frozenset[str], list[Variant]]
) -> tuple[Edge, Edge] | None:
    """Return the pairs of variants that differ in one ingredient nearest to either end, None where there are none.

    Of equally near ones a pair of one estimator is taken, which differs in nothing undeclared either.
    """
    pairs = [
        (less, more)
        for has, those in having.items()
        if name not in has
        for more in having.get(has | {name}, ())
        for less in those
    ]
    if not pairs:
        return None
    first, last = (min((_edge(name, end, less, more) for less, more in pairs), key=_rank) for end in ends)
    return first, last


def _edge(name: str, end: Variant, less: Variant, more: Variant) -> Edge:
    return Edge(name, less, more, len(less.has ^ (end.has - {name})), end in (less, more))


def _rank(edge: Edge) -> tuple[object, ...]:
    _, less, more, distance, at = edge
    switched = len(less.without) + len(more.without)
    return distance, less.name != more.name, not at, switched, more.name, less.name


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
    Raises as :func:`toolkit.experiment.grid.run_grid` and :func:`compared` do.
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
    metric = error_of(list(rows.values()))
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
    return {name: Measure(partial(logs, *key), np.mean, FEWEST_SEEDS) for name, key in keys.items()}


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
