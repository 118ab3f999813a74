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
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, TypeVar

import msgspec
import numpy as np
from msgspec import UNSET, Meta, Struct, UnsetType

from toolkit.answers import Output
from toolkit.errors import EstimatorError
from toolkit.experiment.comparison import NEES, Row
from toolkit.experiment.contests import HELD_OUT, error_of
from toolkit.experiment.grid import Grid, Trial, prepared_case, run_grid
from toolkit.experiment.pipeline import Plan
from toolkit.experiment.recording import Prepared
from toolkit.experiment.statistics import LEVEL, Paired, holm
from toolkit.files.documents import Count, rounded
from toolkit.geometry import Array
from toolkit.jackknife import STRETCHES, jackknife_cov
from toolkit.progress import ProgressFor, silent
from toolkit.registry import EstimatorEntry, defaults, find, find_all
from toolkit.settings import Metrics, Scalar, Settings, as_values
from toolkit.settings.reading import value_at

Key = TypeVar("Key")
EXCESS = "excess_pose"
# What differences are taken of: the error, the variance beyond the Cramér-Rao bound, and the NEES.
ERROR: Literal["error"] = "error"
Other = Literal["variance", "nees"]
OTHERS: tuple[Other, ...] = ("variance", "nees")
# Factors of more than this stand for any larger one, which a diverged run may have.
_MOST = 1e6
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

    @property
    def record(self) -> "VariantRecord":
        return VariantRecord(estimator=self.name, output=self.output, has=tuple(sorted(self.has)), without=self.without)


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


class VariantRecord(Struct, frozen=True, kw_only=True):
    """One kind of output of an estimator, what it has, and what of it was taken away."""

    estimator: str
    output: Output
    has: tuple[str, ...]
    without: tuple[str, ...]

    def __str__(self) -> str:
        lacking = ", ".join(f"no {one.removeprefix('the ')}" for one in self.without)
        return f"{self.estimator} ({lacking})" if lacking else self.estimator


class FactorRecord(Struct, frozen=True, kw_only=True):
    """How many times as large a figure is without the ingredient as with it, with its 95 % interval."""

    factor: float
    low: float
    high: float

    @classmethod
    def of(cls, one: Paired) -> "FactorRecord":
        """Return the factor whose logarithm is given."""
        most = math.log(_MOST)
        factor, low, high = (rounded(math.exp(min(max(end, -most), most))) for end in one.interval)
        return cls(factor=factor, low=low, high=high)

    @property
    def is_off(self) -> bool:
        return not self.low <= 1.0 <= self.high

    def inverse(self) -> "FactorRecord":
        """Return how many times as large it is with the ingredient as without it."""
        return FactorRecord(factor=1.0 / self.factor, low=1.0 / self.high, high=1.0 / self.low)


class ContributionRecord(Struct, frozen=True, kw_only=True):
    """What an ingredient brings between two variants; null is what is not known."""

    less: VariantRecord
    more: VariantRecord
    distance: Annotated[Count, Meta(description="ingredients in which the pair differs from the estimator it tells of")]
    runs: Count
    ok: Annotated[Count, Meta(description="runs in which both ended well")]
    shown: Annotated[bool, Meta(description="whether the error differs by more than chance, by Holm's test over all")]
    error: FactorRecord | None
    variance: Annotated[FactorRecord | None, Meta(description="variance of the pose over the Cramér-Rao bound")]
    nees: FactorRecord | None
    also_shown: Annotated[tuple[Other, ...] | UnsetType, Meta(description="of the others, those beyond chance")] = UNSET

    def shows(self, measure: str) -> bool:
        return self.shown if measure == "error" else measure in (self.also_shown or ())


class IngredientRecord(Struct, frozen=True, kw_only=True):
    """An ingredient: what it brings the first estimator alone, and what the second loses without it."""

    ingredient: str
    first_in: Annotated[ContributionRecord | None, Meta(description="null where no two variants differ in it alone")]
    last_in: ContributionRecord | None
    order_matters: Annotated[bool, Meta(description="whether the two differ by more than chance")]

    @property
    def effects(self) -> tuple[ContributionRecord, ...]:
        """Return the effects first in and last in, one where both are of the same pair, none where there is none."""
        if self.first_in is None or self.last_in is None:
            return ()
        same = (self.first_in.less, self.first_in.more) == (self.last_in.less, self.last_in.more)
        return (self.first_in,) if same else (self.first_in, self.last_in)


@dataclass(frozen=True, eq=False)
class Explanation:
    """How much more accurate one of two estimators is, and what each ingredient brings, the most first.

    ``metric`` is the key of the error. ``gap`` compares the two themselves.
    """

    grid: Grid
    metric: str
    gap: ContributionRecord
    parts: tuple[IngredientRecord, ...]

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

    def record(edge: Edge, beyond: Collection[str]) -> ContributionRecord:
        ended = zip(rows[edge.less].outcomes, rows[edge.more].outcomes, strict=True)
        ok = [less.status == more.status == "ok" for less, more in ended]
        by = {key: FactorRecord.of(one) for key in measures if (one := difference(key, edge)) is not None}
        return ContributionRecord(
            less=edge.less.record,
            more=edge.more.record,
            distance=edge.distance,
            runs=len(ok),
            ok=sum(ok),
            shown=ERROR in beyond,
            error=by.get(ERROR),
            variance=by.get("variance"),
            nees=by.get("nees"),
            also_shown=tuple(key for key in OTHERS if key in beyond),
        )

    pairs = {name: pair for name, pair in found.edges.items() if pair is not None}
    # A pair that stands for first and last is tested once.
    edges = {(edge.less, edge.more): edge for pair in pairs.values() for edge in pair}
    shown = {key: _found_by_holm({ends: difference(key, one) for ends, one in edges.items()}) for key in measures}
    orders = {name: difference(ERROR, *pair) for name, pair in pairs.items() if pair[0].less != pair[1].less}
    clear = _found_by_holm(orders)

    def part(name: str, pair: tuple[Edge, Edge] | None) -> IngredientRecord:
        first, last = (
            one and record(one, {key for key, those in shown.items() if (one.less, one.more) in those})
            for one in pair or (None, None)
        )
        return IngredientRecord(ingredient=name, first_in=first, last_in=last, order_matters=name in clear)

    def size(name: str) -> float:
        effects = [one for edge in pairs.get(name, ()) if (one := difference(ERROR, edge)) is not None]
        return sum(one.mean for one in effects) / len(effects) if effects else -math.inf

    parts = [part(name, found.edges[name]) for name in sorted(found.edges, key=size, reverse=True)]
    gap = record(Edge("", found.start, found.goal, 0, at=True), ())
    return Explanation(grid, metric, gap, tuple(parts))


def _found_by_holm(tests: Mapping[Key, Paired | None]) -> dict[Key, Paired]:
    known = {key: one for key, one in tests.items() if one is not None}
    adjusted = holm(np.array([one.p for one in known.values()])).tolist()
    return {key: one for (key, one), p in zip(known.items(), adjusted, strict=True) if p <= LEVEL}


def _over_seeds(metric: str) -> dict[str, Measure]:
    def logs(key: str, beyond: float, row: Row) -> Array:
        values = np.array([np.nan if value is None else value for value in row.good_values(key)], dtype=float)
        with np.errstate(divide="ignore"):
            return np.asarray(np.log(beyond + values))

    keys = {ERROR: (metric, 0.0), "variance": (EXCESS, 1.0), "nees": (NEES, 0.0)}
    return {name: Measure(partial(logs, *key), np.mean, FEWEST_SEEDS) for name, key in keys.items()}


def _over_stretches(metric: str) -> dict[str, Measure]:
    def values(name: str, row: Row) -> Array:
        scored = row.outcomes[0].outputs.get(row.output) if row.status == "ok" else None
        return np.empty(0) if scored is None else np.asarray(getattr(scored, name))

    # Of withheld tracks the values are medians, of which one bad stretch is not to decide all.
    of_error = ("heldout_px", _mean_log) if metric == HELD_OUT else ("drift_m", _log_rms)
    error = Measure(partial(values, of_error[0]), of_error[1], _FEWEST_VALUES, STRETCHES)
    nees = Measure(partial(values, "nees_pose"), _log_mean, _FEWEST_VALUES, STRETCHES)
    return {ERROR: error, "nees": nees}


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
