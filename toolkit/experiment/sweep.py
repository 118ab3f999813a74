"""A sweep: how the errors of estimators change along axes of settings or of planted faults, relative to neither.

Every trial is paired with the clean one of its seed, and an interval is that of Student's t over the seeds, on the
logarithm. Where runs did not end well, each counts as infinitely bad: the median over all runs is told, and the
interval has no upper end. A recording that is not drawn from a seed is compared over its stretches, by a jackknife
(:mod:`toolkit.jackknife`).

An estimator breaks where its error passes three times that on the clean recording. The interval of that dose are the
doses at which the interval of the ratio has three inside, read off the curves of its two ends.
"""

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import cached_property, partial
from itertools import pairwise, product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from msgspec import Struct

from toolkit.answers import Output
from toolkit.audit import faults
from toolkit.errors import no_such
from toolkit.experiment.comparison import NEES, Row
from toolkit.experiment.contests import COST, HELD_OUT, error_of
from toolkit.experiment.grid import Grid, Trial, run_grid
from toolkit.experiment.pipeline import Plan, located, workers_of
from toolkit.experiment.recording import found_where_planted
from toolkit.experiment.statistics import Interval, jackknife_interval, mean_interval
from toolkit.experiment.workers import LostUnit
from toolkit.jackknife import STRETCHES
from toolkit.progress import ProgressFor, silent
from toolkit.registry import find_all
from toolkit.settings import Scalar, SettingsError, as_values
from toolkit.settings.reading import describe, value_at
from toolkit.simulation.faults import INJECTORS

FAULT = "fault:"
# An estimator breaks where its error passes this many times that on the clean recording.
BREAKS_AT = 3.0
# The lower end of an interval over a single run is zero, which has no logarithm.
_LEAST = 1e-6
# Of fewer stretches no jackknife is made.
_FEWEST = 2 * STRETCHES
# A filter's final answer is its causal one.
OUTPUT: Output = "final"
Point = tuple[tuple[str, Scalar], ...]
CLEAN: Point = ()


@dataclass(frozen=True)
class Axis:
    """What is varied, a setting by its key or a fault as ``fault:NAME``, and its values without the clean one.

    ``clean`` is the dose of a recording without the fault, or the value that the plan has, None where that is none.
    """

    name: str
    values: tuple[Scalar, ...]
    clean: Scalar | None
    unit: str
    meaning: str

    @classmethod
    def of(cls, name: str, values: Iterable[Any], plan: Plan) -> "Axis":
        """Return an axis; raises SettingsError for a fault or a value there is not."""
        given = tuple(dict.fromkeys(values))
        if name.startswith(FAULT):
            fault = name.removeprefix(FAULT)
            if fault not in INJECTORS:
                raise SettingsError(f"{name}: {no_such('fault that can be planted', fault, INJECTORS)}")
            one = INJECTORS[fault]
            if wrong := [value for value in given if isinstance(value, bool) or not isinstance(value, int | float)]:
                raise SettingsError(f"{name}: {wrong[0]!r} is no dose; give numbers, in {one.unit}")
            axis = cls(name, tuple(sorted(map(float, given))), one.clean, one.unit, one.meaning)
        else:
            about = next((setting for setting in describe() if setting.key == name), None)
            if about and (name in ("first_seed", "seeds", "card") or name.startswith("metrics.")):
                raise SettingsError(f"{name}: a sweep sets it itself, or no run depends on it; name another setting")
            unit, meaning = ("", "an option of an estimator") if about is None else (about.unit, about.meaning)
            axis = cls(name, given, value_at(as_values(plan.settings), name), unit, meaning)
        varied = tuple(value for value in axis.values if value != axis.clean)
        if not varied:
            raise SettingsError(f"{name}: there is no value to vary it over but that of the clean recording")
        return cls(name, varied, axis.clean, axis.unit, axis.meaning)

    @property
    def is_fault(self) -> bool:
        return self.name.startswith(FAULT)

    @property
    def points(self) -> tuple["Point", ...]:
        return tuple(((self.name, value),) for value in self.values)

    @property
    def sides(self) -> tuple[tuple[float, ...], ...]:
        """Return the doses of a fault below and above the clean one, each from there outwards, where there are any."""
        doses = [float(value) for value in self.values]
        clean = float(self.clean) if isinstance(self.clean, int | float) else math.nan
        below, above = (sorted(dose for dose in doses if dose < clean), sorted(dose for dose in doses if dose > clean))
        return tuple(side for side in (tuple(below[::-1]), tuple(above)) if side)


class Effect(NamedTuple):
    """What a point of a sweep does to an estimator: error and error of withheld tracks over the clean ones, and NEES.

    ``error`` is the mean over the runs that are ok, ``cpu_ms`` that of a frame; None is what is not known.
    """

    estimator: str
    point: Point
    runs: int
    ok: int
    error: float | None
    over_clean: Interval | None
    held_out: Interval | None
    nees: Interval | None
    cpu_ms: float | None


class Breaking(Struct, frozen=True):
    """The dose at which an estimator passes three times its clean error, on a side of the clean one, with its interval.

    None is beyond the largest dose, ``tried``, that was run, or unknown as the effect there is; a ``dose`` is between
    two that were.
    """

    estimator: str
    axis: str
    tried: float
    dose: float | None
    low: float | None
    high: float | None


@dataclass(frozen=True, eq=False)
class Sweep:
    """The grid of a sweep; ``found`` has what the audit finds in addition, by fault and dose."""

    grid: Grid
    axes: tuple[Axis, ...]
    points: tuple[Point, ...]
    found: Mapping[Point, tuple[str, ...]]

    @property
    def estimators(self) -> tuple[str, ...]:
        return tuple(dict.fromkeys(trial.estimator for trial in self.grid.outcomes))

    @cached_property
    def metric(self) -> str:
        """The metric of the error: ATE, or without a truth the error of withheld tracks."""
        return error_of([self._row(name, CLEAN) for name in self.estimators])

    @property
    def over_seeds(self) -> bool:
        return len(self.grid.plan.seeds) > 1

    @cached_property
    def effects(self) -> Mapping[tuple[str, Point], Effect]:
        return {(name, point): self._effect(name, point) for point in self.points for name in self.estimators}

    @cached_property
    def breaking(self) -> tuple[Breaking, ...]:
        return tuple(
            self._breaking(name, axis, side)
            for axis in self.axes
            if axis.is_fault
            for side in axis.sides
            for name in self.estimators
        )

    def records(self) -> Iterator[dict[str, Any]]:
        """Yield every value of every metric of every run, a row of the long table; each axis is a column of it.

        A run that gave no output has one row, without metric and value.
        """
        clean = {axis.name: axis.clean for axis in self.axes}
        for point, name in product(self.points, self.estimators):
            for one in self.grid.outcomes[_trial(name, point)]:
                about = {"sequence": self.grid.case.name, **clean, **dict(point), "seed": one.seed}
                given = [(kind, *item) for kind, scored in one.outputs.items() for item in scored.scores.values.items()]
                for output, key, value in given or [("final", "", None)]:
                    row = {"estimator": one.estimator, "output": output, "metric": key, "value": value}
                    yield {**about, **row, "status": one.status}

    def _row(self, estimator: str, point: Point) -> Row:
        return self.grid.row(_trial(estimator, point), OUTPUT)

    def _effect(self, estimator: str, point: Point) -> Effect:
        row, clean = self._row(estimator, point), self._row(estimator, CLEAN)
        ratio = _over_seeds if self.over_seeds else _over_stretches
        return Effect(
            estimator,
            point,
            len(row.outcomes),
            row.counts["ok"],
            _mean(row, self.metric),
            ratio(clean, row, self.metric),
            ratio(clean, row, HELD_OUT),
            _nees(row),
            _mean(row, COST),
        )

    def _breaking(self, estimator: str, axis: Axis, side: Sequence[float]) -> Breaking:
        ratios = [self.effects[estimator, ((axis.name, dose),)].over_clean for dose in side]
        known = [(dose, ratio) for dose, ratio in zip(side, ratios, strict=True) if ratio is not None]
        assert isinstance(axis.clean, int | float)
        doses, crossing = (axis.clean, *(dose for dose, _ in known)), partial(_crossing, factors=axis.clean != 0.0)
        low, dose, high = (
            crossing(doses, (1.0, *(ratio[end] for _, ratio in known)), place)
            for end, place in ((2, 0.0), (0, 0.5), (1, 1.0))
        )
        return Breaking(estimator, axis.name, side[-1], dose, low, high)


def run_sweep(
    plan: Plan,
    over: Mapping[str, Iterable[Any]],
    *,
    crossed: bool,
    directory: Path | None = None,
    progress_for: ProgressFor = silent,
) -> Sweep:
    """Run the estimators of a plan at every value of each axis; ``crossed`` are two axes, every value with every other.

    Outcomes are kept in a directory and found there again. Raises as :func:`toolkit.experiment.grid.run_grid`, and
    SettingsError for an axis that cannot be.
    """
    axes = tuple(Axis.of(name, values, plan) for name, values in over.items())
    if not axes:
        raise SettingsError("there is nothing to sweep over: name a setting or a fault and its values")
    if crossed and len(axes) > 2:
        raise SettingsError(f"{len(axes)} axes make no grid that can be shown; cross two, or sweep each by itself")
    steps = [[CLEAN, *axis.points] for axis in axes]
    points = product(*steps) if crossed else ([step] for of_axis in steps for step in of_axis)
    unique = tuple(dict.fromkeys(tuple(one for step in point for one in step) for point in points))
    names = [*(entry.word for entry in find_all(plan.estimators).values()), *plan.own]
    grid = run_grid(plan, [_trial(name, point) for point in unique for name in names], directory, progress_for)
    return Sweep(grid, axes, unique, _found_by_the_audit(plan, axes, progress_for))


def _trial(estimator: str, point: Point) -> Trial:
    doses = {name.removeprefix(FAULT): float(value) for name, value in point if name.startswith(FAULT)}
    return Trial.of(estimator, {name: value for name, value in point if not name.startswith(FAULT)}, doses)


def _found_by_the_audit(plan: Plan, axes: Iterable[Axis], progress_for: ProgressFor) -> dict[Point, tuple[str, ...]]:
    """Return what the audit finds where a fault is planted in the recording of the first seed, by axis and dose."""
    points = [point for axis in axes if axis.is_fault for point in axis.points]
    if not points:
        return {}
    source = located(plan.sources[0])
    asked = [plan.recording(source, plan.seeds[0], _trial("", point).faults) for point in points]
    with (
        workers_of(plan) as workers,
        progress_for("auditing each dose") as progress,
        closing(workers.results(asked, found_where_planted, progress)) as coming,
    ):
        found = {points[i]: () if isinstance(names, LostUnit) else names for i, names in coming}
    order = list(faults())
    return {point: tuple(sorted(names, key=order.index)) for point, names in found.items()}


def _mean(row: Row, key: str) -> float | None:
    spread = row.spread(key)
    return None if spread is None else spread.mean


def _over_seeds(clean: Row, row: Row, key: str) -> Interval | None:
    """Return how many times as large a metric is as on the clean recording, paired by seed; None without a pair."""
    pairs = zip(clean.good_values(key), row.good_values(key), row.outcomes, strict=True)
    ratios = [
        value / before if value else math.inf
        for before, value, outcome in pairs
        if before and (value or outcome.status != "ok")
    ]
    if not ratios:
        return None
    if math.inf in ratios:
        return Interval(float(np.median(ratios)), min(ratios), math.inf)
    return mean_interval(np.log(ratios)).exp()


def _over_stretches(clean: Row, row: Row, key: str) -> Interval | None:
    """Return the ratio of the root mean squares over the stretches of one recording, or None where none is known."""
    before, after = (one.outcomes[0].outputs.get(OUTPUT) for one in (clean, row))
    if clean.status != "ok" or before is None:
        return None
    if row.status != "ok" or after is None:
        return Interval(math.inf, math.inf, math.inf)
    series = [one.heldout_px if key == HELD_OUT else one.drift_m for one in (before, after)]
    both = np.isfinite(series).all(axis=0)
    if both.sum() < _FEWEST or not (series[0][both] > 0.0).any():
        return None
    before_m, after_m = (one[both] for one in series)
    return jackknife_interval(lambda a, b: float(0.5 * np.log((b**2).sum() / (a**2).sum())), before_m, after_m).exp()


def _nees(row: Row) -> Interval | None:
    if len(row.outcomes) > 1:
        known = [value for value in row.good_values(NEES) if value]
        return mean_interval(np.log(known)).exp() if known else None
    given = row.outcomes[0].outputs.get(OUTPUT)
    series = np.empty(0) if given is None else given.nees_pose[np.isfinite(given.nees_pose)]
    if series.size < _FEWEST:
        return None
    return jackknife_interval(lambda nees: float(np.log(nees.mean())), series).exp()


def _crossing(doses: Sequence[float], ratios: Sequence[float], place: float, *, factors: bool) -> float | None:
    """Return the dose at which a curve first passes BREAKS_AT, or None; a factor is interpolated by its logarithm.

    Between a finite ratio and an infinite one it is at ``place``, 0 to 1, of the step: no more is known.
    """
    for (dose, ratio), (next_dose, next_ratio) in pairwise(zip(doses, ratios, strict=True)):
        if next_ratio < BREAKS_AT:
            continue
        if math.isinf(dose):  # of tracks, of which a clean recording has any number
            return next_dose
        part = place
        if math.isfinite(next_ratio):
            finite = max(ratio, _LEAST)
            part = math.log(BREAKS_AT / finite) / math.log(next_ratio / finite)
        if factors and dose > 0.0 < next_dose:
            return float(dose * (next_dose / dose) ** part)
        return float(dose + part * (next_dose - dose))
    return None
