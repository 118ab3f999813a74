"""Comparisons from a script, a notebook or standard input: what ``vislam compare`` does, with values in return.

::

    import toolkit

    result = toolkit.compare("drive", ["ekf", "batch"])
    result.table()                        # a short table; columns by name, or "all"
    result.figures["top_all"]             # a matplotlib figure
    result.metrics["batch", "final"]      # every metric of one line of the table
"""

import importlib.util
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Generic, NoReturn, TypedDict, TypeVar, Unpack, get_args

import numpy as np
from msgspec import Meta

from toolkit.answers import Output, Run
from toolkit.errors import VislamError, no_such, type_of
from toolkit.estimator import Build
from toolkit.experiment.comparison import Comparison, Record
from toolkit.experiment.configuration import Request, plan_of, record_of
from toolkit.experiment.explanation import Explanation, default_ends, run_explanation
from toolkit.experiment.pipeline import Plan
from toolkit.experiment.pipeline import run as run_plan
from toolkit.experiment.sweep import Sweep, run_sweep
from toolkit.metrics import describe
from toolkit.progress import silent
from toolkit.registry import discover, find_all
from toolkit.report import FigureChoice, FigureFormat
from toolkit.report.comparison_table import comparison_latex, comparison_table
from toolkit.report.explanation import EXPLANATIONS, ExplanationRecord
from toolkit.report.headers import Columns, requested_columns
from toolkit.report.run_directory import MadeBy, Results, write_run
from toolkit.report.sweep import SWEEPS, SweepRecord
from toolkit.report.text import WIDTH, Table, as_markdown, as_text, in_markdown
from toolkit.sequence import Sequence
from toolkit.settings import DEFAULTS, Settings, SettingsError, as_values
from toolkit.settings.reading import settings_of
from toolkit.threads import MOST_WORKERS

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from pandas import DataFrame

Source = str | Path | Sequence
Names = str | Iterable[str]
Found = TypeVar("Found")
Document = TypeVar("Document")


class _Asked(Request, frozen=True):
    """What is compared, and how it is run: seeds, processes, and where outcomes are kept."""

    seed: Annotated[int, Meta(ge=0)] | None = None
    seeds: Annotated[int, Meta(ge=1)] | None = None
    workers: Annotated[int, Meta(ge=1, le=MOST_WORKERS)] | None = None
    scheduler: str | None = None
    resume: str | None = None


def compare(  # noqa: PLR0913 - keyword arguments that all have a default
    source: Source,
    estimators: Names | None = None,
    *,
    own: Mapping[str, Build] | None = None,
    truth: str | Path | None = None,
    trajectories: Mapping[str, str | Path] | None = None,
    cov_convention: str | None = None,
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
    ``truth`` is a TUM file, ``trajectories`` are files of other systems by name, final output unless they end in
    ":causal", ``cov_convention`` is that of their covariances where they do not say it; ``keep`` names faults that the
    audit reports and leaves alone. ``seeds`` is the number of seeds, from ``seed`` on, over which a simulated source is
    repeated. ``settings`` is a record or nested values as in TOML, as in ``{"window": {"lag_s": 3.0}}``. ``workers`` is
    the number of processes, one a processor by default; ``scheduler`` the address of a Dask cluster in their place.
    ``resume`` is a run directory in which every run over seeds is kept as it ends, and found by the next comparison.

    Raises EstimatorError for an estimator that is unknown or cannot be used, DataError for a recording, truth or
    trajectory that cannot, SettingsError for an argument or a setting that does not exist or has a wrong value,
    ClusterError for a cluster that cannot be used, OutputError where what is to be kept cannot be written.
    """
    plan, kept = _planned(
        source,
        estimators,
        own=own,
        truth=truth,
        trajectories=trajectories,
        cov_convention=cov_convention,
        max_frames=max_frames,
        from_s=from_s,
        to_s=to_s,
        every=every,
        keep=keep,
        seed=seed,
        seeds=seeds,
        settings=settings,
        workers=workers,
        scheduler=scheduler,
        resume=resume,
    )
    if kept is not None and plan.settings.seeds == 1:
        raise SettingsError("resume keeps the runs of a comparison over seeds, and there is one seed: give seeds")
    return Result(run_plan(plan, silent, () if kept is None else (kept,))[0])


class SweepOptions(TypedDict, total=False):
    """What :func:`sweep` takes beside what is varied, as :func:`compare` does."""

    own: Mapping[str, Build] | None
    truth: str | Path | None
    max_frames: int | None
    from_s: float
    to_s: float | None
    every: int
    keep: Names
    seed: int | None
    seeds: int | None
    settings: Settings | Mapping[str, Any]
    workers: int | None
    scheduler: str | None
    resume: str | Path | None


def sweep(
    source: Source,
    over: Mapping[str, Iterable[Any]],
    estimators: Names | None = None,
    *,
    each: bool = False,
    **options: Unpack[SweepOptions],
) -> "SweepResult":
    """Run estimators on a recording at every value of settings, or with faults planted in it in doses.

    ``over`` has values by setting, as in ``{"window.lag_s": [0.3, 1.0]}``, and doses by fault, as in
    ``{"fault:dropped_frames": [0.1, 0.5]}`` (``vislam list injectors``). Two are crossed, every value with every other,
    unless ``each`` is varied by itself. All else is as in :func:`compare`; the result is the long table.

    Raises as :func:`compare` does, and SettingsError for a fault or a value there is not.
    """
    plan, kept = _planned(source, estimators, **_checked(options))
    return SweepResult(run_sweep(plan, over, crossed=not each, directory=kept))


def explain(
    source: Source,
    start: str | Path | None = None,
    goal: str | Path | None = None,
    *,
    estimators: Names | None = None,
    **options: Unpack[SweepOptions],
) -> "ExplainResult":
    """Say what makes the estimator ``goal`` more accurate than ``start``, ingredient by ingredient (docs/explain.md).

    By default they are the lowest and highest rung of the estimators that are compared by default. ``estimators`` are
    those whose variants may lie between the two, by default all installed ones. All else is as in :func:`compare`.

    Raises as :func:`compare` does, and EstimatorError for an estimator that does not say what it has.
    """
    if options.get("own"):
        raise SettingsError(
            "own has functions, which cannot say what they have; give the path of a file with INGREDIENTS"
        )
    usual = default_ends() if None in (start, goal) else ("", "")
    plan, kept = _planned(source, tuple(discover()) if estimators is None else estimators, **_checked(options))
    return ExplainResult(run_explanation(plan, str(start or usual[0]), str(goal or usual[1]), kept))


def _checked(options: SweepOptions) -> SweepOptions:
    """Return what was given by name; SettingsError for what only a comparison takes, or nothing."""
    if strange := sorted(options.keys() - SweepOptions.__annotations__.keys()):
        raise SettingsError(no_such("argument", strange[0], SweepOptions.__annotations__))
    return options


def _planned(source: Source, estimators: Names | None, **options: Any) -> tuple[Plan, Path | None]:
    """Return the plan of a function's arguments, and the directory its outcomes are kept in, if any."""
    if not isinstance(source, str | Path | Sequence):
        raise SettingsError(f"source is {type_of(source)}; give one recording: a path, a built-in name, a Sequence")
    given = {key: value for key, value in options.items() if key not in ("own", "settings")}
    given |= {"estimators": _names("estimators", estimators), "keep": _names("keep", given.get("keep", ()))}
    asked = record_of(_Asked, _plain({key: value for key, value in given.items() if value is not None}))
    settings = options.get("settings", DEFAULTS)
    if not isinstance(settings, Settings | Mapping):
        raise SettingsError(f"settings is {type_of(settings)}; give nested values, as {{'seeds': 3}}")
    values = as_values(settings) if isinstance(settings, Settings) else _plain(settings)
    seeds = {"first_seed": asked.seed, "seeds": asked.seeds}
    plan = plan_of(
        asked,
        settings_of({**values, **{key: value for key, value in seeds.items() if value is not None}}, "settings"),
        (source if isinstance(source, Sequence) else str(source),),
        _checked_own(options.get("own"), asked.estimators or ()),
        asked.workers,
        asked.scheduler,
    )
    return plan, None if asked.resume is None else Path(asked.resume)


def _names(what: str, given: Names | None) -> Any:
    """Return names as a tuple; what is not one or several is left to be refused by its type."""
    if isinstance(given, str) and "," in given:
        raise SettingsError(f"{what} is {given!r}; give several names as a list: {given.split(',')}")
    if isinstance(given, str):
        return (given,)
    if isinstance(given, Mapping) and any(map(callable, given.values())):
        raise SettingsError(f"{what} is {type_of(given)}; functions build(setup) go by name into own")
    return tuple(given) if isinstance(given, Iterable) else given


def _checked_own(own: Mapping[str, Build] | None, named: Iterable[str]) -> Mapping[str, Build] | None:
    if own is not None and not isinstance(own, Mapping):
        raise SettingsError(f"own is {type_of(own)}; give a dict, by name")
    for name, build in (own or {}).items():
        if not isinstance(name, str) or not name or not callable(build):
            raise SettingsError(f"own has {name!r}: {type_of(build)}; give functions build(setup), each by a name")
    both = sorted(set(find_all(named)) & set(own)) if own else []
    if both:
        raise SettingsError(f"own has a function called {both[0]}, and so has estimators: give it another name")
    return own


def _plain(values: Mapping[Any, Any]) -> dict[str, Any]:
    """Return nested values with Python's numbers in the place of NumPy's and paths as texts."""
    if strange := [key for key in values if not isinstance(key, str)]:
        raise SettingsError(f"there is {type_of(strange[0])} for a name, {strange[0]!r}; give a text")
    return {key: _plain_value(value) for key, value in values.items()}


def _plain_value(value: Any) -> Any:
    if isinstance(value, Mapping):
        return _plain(value)
    if isinstance(value, Path):
        return str(value)
    return value.item() if isinstance(value, np.generic) else value


@dataclass(frozen=True, eq=False, repr=False)
class Result:
    """What a comparison found. ``comparison`` holds the values themselves; the rest shows them."""

    comparison: Comparison

    def table(self, *columns: str) -> "ShownTable":
        """Return the table: the usual columns, those of the metric keys or column names given, or "all"."""
        return ShownTable(comparison_table(self.comparison, _checked_columns(columns)))

    @cached_property
    def figures(self) -> Mapping[str, "Figure"]:
        """Every figure there is data for, by the names of docs/figures.md."""
        from toolkit.report.figures import drawn

        return _ByName({one.name: one.figure for one in drawn(self.comparison)})

    @cached_property
    def metrics(self) -> Mapping[tuple[str, Output], Mapping[str, float | None]]:
        """Every metric by estimator and output: the value of the run, or the mean over the seeds whose runs are ok."""
        rows, keys = self.comparison.rows, describe()
        return _ByName({(row.estimator, row.output): _ByName({key: row.value(key) for key in keys}) for row in rows})

    @property
    def runs(self) -> Mapping[str, Run]:
        """The runs by estimator, with trajectories and landmarks; none where it was repeated over seeds."""
        return {run.estimator: run for run in self.comparison.runs}

    def records(self) -> Iterator[Record]:
        """Yield every value once as sequence, seed, estimator, output, metric, value: a table for pandas and its kin.

        The output is "both" for a filter's, whose final output repeats the causal one.
        """
        return self.comparison.records()

    def to_pandas(self) -> "DataFrame":
        """Return :meth:`records` as a DataFrame; raises VislamError where pandas is not installed."""
        if importlib.util.find_spec("pandas") is None:
            raise VislamError('to_pandas needs the package pandas; pip install "vislam-toolkit[pandas]"')
        import pandas as pd

        return pd.DataFrame(list(self.records()), columns=Record._fields)

    def to_latex(self, *columns: str) -> str:
        """Return :meth:`table` for a paper, after comments with recording and rules; it needs the package booktabs."""
        return comparison_latex(self.comparison, _checked_columns(columns))

    def save(self, directory: str | Path, figures: FigureChoice = "few", figure_format: FigureFormat = "png") -> Path:
        """Write the run directory that ``vislam compare`` writes, with "few", "all" or no ("none") figures.

        Raises OutputError where it cannot be written, SettingsError where there are no such figures.
        """
        for what, value, known in (("figures", figures, FigureChoice), ("figure_format", figure_format, FigureFormat)):
            if value not in get_args(known):
                raise SettingsError(f"{what} is {value!r}; there are {', '.join(get_args(known))}")
        if not isinstance(directory, str | Path):
            raise SettingsError(f"directory is {type_of(directory)}; give a path")
        write_run(self.comparison, Path(directory), MadeBy("toolkit.compare", Request(), figure_format, figures))
        return Path(directory)

    def __repr__(self) -> str:
        seeds = f", {len(self.comparison.seeds)} seeds" if self.comparison.over_seeds else ""
        return f"{self.comparison.name}{seeds}\n{self.table()}"

    def _repr_markdown_(self) -> str:
        return self.table()._repr_markdown_()


def _checked_columns(columns: tuple[str, ...]) -> Columns:
    strange = [column for column in columns if not isinstance(column, str)]
    if strange:
        raise SettingsError(f"a column is {type_of(strange[0])}; give names, as in table('ATE SE(3)', 'nis_mean')")
    return requested_columns(columns)


@dataclass(frozen=True, eq=False, repr=False)
class _OfTrials(Generic[Found, Document]):
    """What was found by many trials, and how it is shown: as a document, a table, figures and a folder."""

    found: Found
    _kind: ClassVar[Results[Any, Any]]
    _command: ClassVar[str]

    @cached_property
    def document(self) -> Document:
        """What the document of the folder has."""
        made: Document = self._kind.made(self.found, self._command, {}, ())
        return made

    def table(self) -> "ShownTable":
        """Return the table that the command prints."""
        return ShownTable(self._kind.shown(self.document).table)

    @cached_property
    def figures(self) -> Mapping[str, "Figure"]:
        """The figures by name."""
        return {one.name: one.figure for one in self._kind.drawn(self.found)}

    def save(self, directory: str | Path) -> Path:
        """Write the directory that the command writes; raises OutputError where it cannot be written."""
        self._kind.write(self.found, Path(directory), self._command)
        return Path(directory)

    def __repr__(self) -> str:
        return self._kind.text(self.document, WIDTH)

    def _repr_markdown_(self) -> str:
        return self.table()._repr_markdown_()


class SweepResult(_OfTrials[Sweep, SweepRecord]):
    """What a sweep found: an iterable of the rows of its long table, as pandas takes them. ``sweep`` has the values.

    A row has the sequence, a column an axis, seed, estimator, output, metric, value and status. Its table has errors
    over the clean ones with their intervals, and the dose at which each estimator breaks.
    """

    _kind, _command = SWEEPS, "toolkit.sweep"

    @property
    def sweep(self) -> Sweep:
        return self.found

    def __iter__(self) -> Iterator[dict[str, Any]]:
        return self.sweep.records()


class ExplainResult(_OfTrials[Explanation, ExplanationRecord]):
    """Why one estimator is more accurate than another. ``explanation`` holds the values themselves.

    Its table has the effect of every ingredient with its intervals.
    """

    _kind, _command = EXPLANATIONS, "toolkit.explain"

    @property
    def explanation(self) -> Explanation:
        return self.found

    @property
    def words(self) -> str:
        """The explanation in sentences."""
        return self.document.words

    def _repr_markdown_(self) -> str:
        return f"{in_markdown(self.words)}\n\n{super()._repr_markdown_()}"


@dataclass(frozen=True)
class ShownTable:
    """A table that a notebook shows as such and ``print`` shows as text."""

    table: Table

    def __repr__(self) -> str:
        return as_text(self.table)

    def _repr_markdown_(self) -> str:
        return as_markdown(self.table)


class _NotThereError(VislamError, KeyError):
    __str__ = Exception.__str__  # a KeyError's would put it in quotes


class _ByName(dict[Any, Any]):
    """What a result has by name; a name that it does not have is answered with those that it has."""

    def __missing__(self, key: object) -> NoReturn:
        raise _NotThereError(no_such("entry", str(key), map(str, self)))
