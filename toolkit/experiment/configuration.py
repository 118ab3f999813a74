"""A comparison as a file: a TOML file, or the manifest of a run that is to be repeated."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import msgspec
from msgspec import UNSET, Meta, Struct, UnsetType

from toolkit.errors import DataError, did_you_mean
from toolkit.files.documents import Record, readable
from toolkit.files.reading import read_text_input
from toolkit.settings import Scalar, Settings, SettingsError
from toolkit.settings.reading import read_toml, without_removed

if TYPE_CHECKING:
    from toolkit.estimator import Build
    from toolkit.experiment.pipeline import Plan
    from toolkit.sequence import Sequence as Recorded

# The table of a configuration that says what to compare; all others are settings.
COMPARE = "compare"
# And the one that says what to sweep over, which concerns vislam sweep alone.
SWEEP = "sweep"


class Request(Struct, frozen=True):
    """What to compare, named as the arguments of the command line; paths are from the folder one is in."""

    sequences: tuple[str, ...] | None = None
    estimators: tuple[str, ...] | None = None
    truth: str | None = None
    trajectories: dict[str, str] = {}
    max_frames: Annotated[int, Meta(ge=2)] | None = None
    from_s: Annotated[float, Meta(ge=0)] = 0.0
    to_s: Annotated[float, Meta(gt=0)] | None = None
    every: Annotated[int, Meta(ge=1)] = 1
    keep: tuple[str, ...] = ()
    keep_trajectories: bool = False
    cov_convention: str | UnsetType = UNSET


class SweepRequest(Struct, frozen=True):
    """What to sweep over: values by setting or fault; ``each`` axis by itself, or every value with every other."""

    over: dict[str, tuple[Scalar, ...]] = {}
    each: bool = False


def read_configuration(path: Path) -> tuple[Mapping[str, Any], Mapping[str, Any]]:
    """Return the comparison and the settings in a file, as nested values not yet checked.

    Raises SettingsError where it is neither TOML nor a manifest that holds settings.
    """
    values = _manifest(path) if path.suffix == ".json" else read_toml(path)
    values.pop(SWEEP, None)
    request = values.pop(COMPARE, {})
    if not isinstance(request, Mapping):
        raise SettingsError(f"{path}: {COMPARE} is not a table")
    return request, values


def read_sweep_request(path: Path) -> SweepRequest:
    """Return the sweep in a file, nothing where it has none; raises SettingsError where it is not TOML, or no sweep."""
    values = {} if path.suffix == ".json" else read_toml(path).get(SWEEP, {})
    return record_of(SweepRequest, values, str(path), SWEEP)


def record_of(record: type[Record], values: Mapping[str, Any], place: str = "", table: str = "") -> Record:
    """Return values as a record; raises SettingsError, with place and table, for one that it cannot have."""
    before, of = f"{place}: " if place else "", f"{table}." if table else ""
    for key in values:
        if key not in record.__struct_fields__:
            raise SettingsError(f"{before}there is no {of}{key}{did_you_mean(key, record.__struct_fields__)}")
    try:
        return msgspec.convert(dict(values), record)
    except msgspec.ValidationError as error:
        raise SettingsError(f"{before}{of}{readable(error, dict(values), record)}") from error


def plan_of(
    request: Request,
    settings: Settings,
    default: "Sequence[str | Recorded]",
    own: "Mapping[str, Build] | None" = None,
    workers: int | None = None,
    scheduler: str | None = None,
) -> "Plan":
    """Return the plan of a request; where it names no sequences ``default`` are compared.

    ``own`` are further estimators as functions by name. Raises SettingsError for what does not go together.
    """
    from toolkit.datasets.trajectories.covariances import convention_called
    from toolkit.experiment.pipeline import Plan
    from toolkit.experiment.recording import Part
    from toolkit.registry import defaults

    usual = () if own else defaults()
    return Plan(
        sources=tuple(request.sequences or default),
        estimators=usual if request.estimators is None else request.estimators,
        own=own or {},
        settings=settings,
        truth=None if request.truth is None else Path(request.truth),
        trajectories={name: Path(file) for name, file in request.trajectories.items()},
        keep=frozenset(request.keep),
        max_frames=request.max_frames,
        workers=workers,
        keep_trajectories=request.keep_trajectories,
        scheduler=scheduler,
        cov_convention=None if request.cov_convention is UNSET else convention_called(request.cov_convention),
        part=Part(request.from_s, request.to_s, request.every),
    )


def _manifest(path: Path) -> dict[str, Any]:
    try:
        document = json.loads(read_text_input(path, "name a manifest.json or a TOML file"))
    except DataError as error:
        raise SettingsError(str(error)) from error
    except (ValueError, RecursionError) as error:
        raise SettingsError(f"{path}: is not JSON ({error})") from error
    if not isinstance(document, dict) or not isinstance(document.get("settings"), dict):
        raise SettingsError(f"{path}: holds no settings; name the manifest.json of a comparison, or a TOML file")
    return {**without_removed(document["settings"]), COMPARE: document.get(COMPARE, {})}
