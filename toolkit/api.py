"""Comparisons from a script, a notebook or standard input: what ``vislam compare`` does, with values in return.

::

    import toolkit

    result = toolkit.compare("drive", ["ekf", "batch"])
    result.table()                        # a short table; columns by name, or "all"
    result.figures["top_all"]             # a matplotlib figure
    result.metrics["batch", "final"]      # every metric of one line of the table
"""

import operator
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar, get_args

import numpy as np

from toolkit.errors import VislamError, did_you_mean, type_of
from toolkit.estimate import Output, Run
from toolkit.estimator import Build
from toolkit.experiment import Comparison, Plan, Record
from toolkit.experiment import run as run_plan
from toolkit.experiment.configuration import Configuration, Request
from toolkit.experiment.recording import Part
from toolkit.progress import silent
from toolkit.registry import defaults, find_all
from toolkit.report.comparison_table import comparison_table, requested_columns
from toolkit.report.table import Table, as_markdown, as_text
from toolkit.sequence import Sequence
from toolkit.settings import DEFAULTS, Settings, SettingsError, as_values, settings_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from toolkit.report.figures import FigureChoice, FigureFormat

Named = TypeVar("Named")
Source = str | Path | Sequence
Names = str | Iterable[str]


def compare(  # noqa: PLR0913 - keyword arguments that all have a default
    source: Source,
    estimators: Names | None = None,
    *,
    own: Mapping[str, Build] | None = None,
    truth: str | Path | None = None,
    trajectories: Mapping[str, str | Path] | None = None,
    max_frames: int | None = None,
    from_s: float = 0.0,
    to_s: float | None = None,
    every: int = 1,
    keep: Names = (),
    seed: int | None = None,
    seeds: int | None = None,
    settings: Settings | Mapping[str, Any] = DEFAULTS,
    workers: int | None = None,
    scheduler: str | None = None,
    resume: str | Path | None = None,
) -> "Result":
    """Audit a recording, run estimators on it from the same start, and score them.

    ``source`` is a recording's path, a built-in name or a sequence; ``estimators`` one name or several, "mine.py" a
    file, "ladder" every rung, by default those of the command line; ``own`` further functions ``build(setup)`` by name.
    ``truth`` is a TUM file, ``trajectories`` are files of other systems by name, ``keep`` names faults that the audit
    reports and leaves alone. ``seeds`` repeats a simulated source over so many, from ``seed`` on. ``settings`` is a
    record or nested values as in TOML, as in ``{"window": {"lag_s": 3.0}}``. ``workers`` is the number of processes,
    one a processor by default; ``scheduler`` the address of a Dask cluster in their place. ``resume`` is a run
    directory in which every run over seeds is kept as it ends, and found by the next comparison of it.

    Raises EstimatorError for an estimator that is unknown or cannot be used, DataError for a recording, truth or
    trajectory that cannot, SettingsError for a setting that does not exist, ClusterError for a cluster that cannot be
    used, OutputError where what is to be kept cannot be written.
    """
    named = (() if own else defaults()) if estimators is None else _names("estimators", estimators)
    plan = Plan(
        sources=(_source(source),),
        estimators=named,
        own=_own_beside(named, own),
        settings=_with_seeds(settings, None if seed is None else _whole("seed", seed), seeds),
        truth=None if truth is None else _path("truth", truth),
        trajectories=_paths("trajectories", trajectories),
        keep=frozenset(_names("keep", keep)),
        max_frames=None if max_frames is None else _whole("max_frames", max_frames),
        part=Part(_number("from_s", from_s), None if to_s is None else _number("to_s", to_s), _whole("every", every)),
        workers=None if workers is None else _whole("workers", workers),
        scheduler=None if scheduler is None else _text("scheduler", scheduler),
    )
    if resume is not None and plan.settings.seeds == 1:
        raise SettingsError("resume keeps the runs of a comparison over seeds, and there is one seed: give seeds")
    return Result(run_plan(plan, silent, () if resume is None else (_path("resume", resume),))[0])


def _own_beside(named: Iterable[str], given: Mapping[str, Build] | None) -> Mapping[str, Build]:
    own = _by_name("own", given)
    for name, build in own.items():
        if not name or not callable(build):
            raise SettingsError(f"own has {name!r}: {type_of(build)}; give functions build(setup), each by a name")
    both = sorted(set(find_all(named)) & set(own))
    if both:
        raise SettingsError(f"own has a function called {both[0]}, and so has estimators: give it another name")
    return own


def _with_seeds(settings: Settings | Mapping[str, Any], seed: int | None, seeds: int | None) -> Settings:
    if not isinstance(settings, Settings | Mapping):
        raise SettingsError(f"settings is {type_of(settings)}; give nested values, as {{'seeds': 3}}")
    values = as_values(settings) if isinstance(settings, Settings) else dict(settings)
    given = {"first_seed": seed, "seeds": seeds}
    return settings_of(_plain(values | {key: value for key, value in given.items() if value is not None}), "settings")


def _plain(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return nested values with Python's numbers in the place of NumPy's."""
    strange = [key for key in values if not isinstance(key, str)]
    if strange:
        raise SettingsError(f"settings has {type_of(strange[0])} for a key, {strange[0]!r}; settings have names")
    return {
        key: _plain(value) if isinstance(value, Mapping) else value.item() if isinstance(value, np.generic) else value
        for key, value in values.items()
    }


def _source(given: Source) -> str | Sequence:
    if isinstance(given, str | Path | Sequence):
        return given if isinstance(given, Sequence) else str(given)
    raise SettingsError(f"source is {type_of(given)}; give one recording: a path, a built-in name, a Sequence")


def _names(what: str, given: Names) -> tuple[str, ...]:
    if isinstance(given, str):
        if "," in given:
            raise SettingsError(f"{what} is {given!r}; give several names as a list: {given.split(',')}")
        return (given,)
    functions = isinstance(given, Mapping) and any(map(callable, given.values()))
    listed = isinstance(given, Iterable) and not functions
    names: tuple[Any, ...] = tuple(given) if listed else (given,)
    strange = [one for one in names if not isinstance(one, str)]
    if strange:
        otherwise = "; functions build(setup) go by name into own" if what == "estimators" else ""
        raise SettingsError(f"{what} has {type_of(strange[0])}, expected names{otherwise}")
    return names


def _by_name(what: str, given: Mapping[str, Named] | None) -> Mapping[str, Named]:
    if given is not None and not isinstance(given, Mapping):
        raise SettingsError(f"{what} is {type_of(given)}; give a dict, by name")
    strange = [name for name in given or {} if not isinstance(name, str)]
    if strange:
        raise SettingsError(f"{what} has {type_of(strange[0])} for a name, {strange[0]!r}; give a text")
    return given or {}


def _text(what: str, given: str) -> str:
    if isinstance(given, str):
        return given
    raise SettingsError(f"{what} is {type_of(given)}; give a text")


def _path(what: str, given: str | Path) -> Path:
    if isinstance(given, str | Path):
        return Path(given)
    raise SettingsError(f"{what} is {type_of(given)}; give a path")


def _paths(what: str, given: Mapping[str, str | Path] | None) -> dict[str, Path]:
    return {name: _path(f"{what}[{name!r}]", file) for name, file in _by_name(what, given).items()}


def _number(what: str, given: float) -> float:
    try:
        return float(operator.truediv(given, 1.0))
    except (TypeError, OverflowError) as error:
        raise SettingsError(f"{what} is {given!r}, expected a number") from error


def _whole(what: str, given: int) -> int:
    if not isinstance(given, bool):
        with suppress(TypeError):
            return operator.index(given)
    raise SettingsError(f"{what} is {given!r}, expected a whole number")


@dataclass(frozen=True, eq=False, repr=False)
class Result:
    """What a comparison found. ``comparison`` holds the values themselves; the rest shows them."""

    comparison: Comparison

    def table(self, *columns: str) -> "ShownTable":
        """Return the table: the usual columns, those of the metric keys or column names given, or "all"."""
        strange = [column for column in columns if not isinstance(column, str)]
        if strange:
            raise SettingsError(f"a column is {type_of(strange[0])}; give names, as in table('ATE SE(3)', 'nis_mean')")
        return ShownTable(comparison_table(self.comparison, requested_columns(columns)))

    @cached_property
    def figures(self) -> Mapping[str, "Figure"]:
        """Every figure there is data for, by the names of docs/figures.md; each is drawn when first asked for.

        To ask which there are draws them all.
        """
        return _Figures(self.comparison)

    @cached_property
    def metrics(self) -> Mapping[tuple[str, Output], Mapping[str, float | None]]:
        """Every metric by estimator and output: the value of the run, or the mean over the seeds whose runs are ok."""
        return _Metrics({(row.estimator, row.output): _Values(row.value) for row in self.comparison.rows})

    @property
    def runs(self) -> Mapping[str, Run]:
        """The runs by estimator, with trajectories and landmarks; none where it was repeated over seeds."""
        return {run.estimator: run for run in self.comparison.runs}

    def records(self) -> Iterator[Record]:
        """Yield every value as sequence, seed, estimator, output, metric, value: a table for pandas and its kin."""
        return self.comparison.records()

    def save(
        self, directory: str | Path, figures: "FigureChoice" = "few", figure_format: "FigureFormat" = "png"
    ) -> Path:
        """Write the run directory that ``vislam compare`` writes, with "few", "all" or no ("none") figures.

        Raises OutputError where it cannot be written, SettingsError where there are no such figures.
        """
        from toolkit.report.figures import FigureChoice, FigureFormat
        from toolkit.report.run_directory import MadeBy, write_run

        for what, value, known in (("figures", figures, FigureChoice), ("figure_format", figure_format, FigureFormat)):
            if value not in get_args(known):
                raise SettingsError(f"{what} is {value!r}; there are {', '.join(get_args(known))}")
        target = _path("directory", directory)
        requested = Configuration(Request(), self.comparison.settings)
        write_run(self.comparison, target, MadeBy("toolkit.compare", requested, figure_format, figures))
        return target

    def __repr__(self) -> str:
        seeds = f", {len(self.comparison.seeds)} seeds" if self.comparison.over_seeds else ""
        return f"{self.comparison.name}{seeds}\n{self.table()}"

    def _repr_markdown_(self) -> str:
        return self.table()._repr_markdown_()


@dataclass(frozen=True)
class ShownTable:
    """A table that a notebook shows as such and ``print`` shows as text."""

    table: Table

    def __str__(self) -> str:
        return as_text(self.table)

    def __repr__(self) -> str:
        return as_text(self.table)

    def _repr_markdown_(self) -> str:
        return as_markdown(self.table)


class _NotThereError(VislamError, KeyError):
    """What a mapping of a result does not hold, with what it holds."""

    __str__ = Exception.__str__  # a KeyError's would put it in quotes


class _Values(Mapping[str, float | None]):
    """The metrics of one line by key."""

    def __init__(self, value_of: Callable[[str], float | None]) -> None:
        from toolkit.metrics import describe

        self._value_of, self._keys = value_of, describe()

    def __getitem__(self, key: str) -> float | None:
        if key not in self._keys:
            raise _NotThereError(f"no metric is called {key}{did_you_mean(str(key), list(self._keys))}")
        return self._value_of(key)

    def __iter__(self) -> Iterator[str]:
        return iter(self._keys)

    def __len__(self) -> int:
        return len(self._keys)

    def __repr__(self) -> str:
        return repr(dict(self))


class _Figures(Mapping[str, "Figure"]):
    """The figures of a comparison by name, drawn in their order as far as one is asked for."""

    def __init__(self, comparison: Comparison) -> None:
        from toolkit.report.figures import drawn

        self._coming = drawn(comparison)
        self._drawn: dict[str, Figure] = {}

    def __getitem__(self, name: str) -> "Figure":
        while name not in self._drawn and self._draw_next():
            pass
        if name not in self._drawn:
            raise _NotThereError(f"there is no figure {name!r}; there are {', '.join(self._drawn)}")
        return self._drawn[name]

    def __iter__(self) -> Iterator[str]:
        while self._draw_next():
            pass
        return iter(self._drawn)

    def __len__(self) -> int:
        return len(list(iter(self)))

    def __contains__(self, name: object) -> bool:
        return name in list(iter(self))

    def __repr__(self) -> str:
        return f"<figures: {', '.join(self)}>"

    def _draw_next(self) -> bool:
        """Draw one more; return False where there is none."""
        figure = next(self._coming, None)
        if figure is None:
            return False
        self._drawn[figure.name] = figure.figure
        return True


class _Metrics(dict[tuple[str, Output], Mapping[str, float | None]]):
    """Metrics by estimator and output; a line that is not there is answered with those that are."""

    def __missing__(self, key: object) -> Mapping[str, float | None]:
        raise _NotThereError(f"there is no {key!r}; there are {', '.join(map(repr, self))}")
