"""What estimators differ in, ingredient by ingredient, and pairs of estimators that differ in a single one.

An estimator declares what it has, and the settings that take some of it away (:mod:`toolkit.registry`). Gate and loss,
the measured noise and the audit's repairs are not declared: settings take them away from every estimator alike.

A variant is an estimator without some of its ingredients. Two variants whose sets differ by one ingredient, of one
estimator or of two, show by their difference what it brings, beside the ingredients that both have.
"""

from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from itertools import combinations
from typing import Any, NamedTuple

from toolkit.answers import Output
from toolkit.errors import EstimatorError
from toolkit.experiment.grid import Trial
from toolkit.experiment.recording import Prepared
from toolkit.registry import EstimatorEntry
from toolkit.settings import Scalar, Settings, as_values
from toolkit.settings.reading import value_at

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
