"""``manifest.json``, the contract ``vislam.manifest/1``: how a run can be repeated."""

from typing import Annotated, Literal

from msgspec import UNSET, Meta, Struct, UnsetType

from toolkit.estimate import ArithmeticOfRuns
from toolkit.experiment.configuration import Request
from toolkit.settings import Settings

Versions = Annotated[dict[str, str | None], Meta(description="by package; null where it is not installed")]


class RecordingRecord(Struct, frozen=True, kw_only=True):
    """The recording that was read; over seeds, that of the first."""

    name: Annotated[str, Meta(description="the sequence's name")]
    hash: Annotated[str, Meta(description="SHA-256 over measurements, calibration, noise, prior and truth")]
    format: str
    source: str


class SeedsUsed(Struct, frozen=True, kw_only=True):
    """The seed a simulation was drawn from, or the first of several."""

    sequence: int
    count: Annotated[int, Meta(description="how many, from the first on; only over seeds", ge=1)] | UnsetType = UNSET


class Manifest(Struct, frozen=True, kw_only=True):
    """The command, every version, the data's hash, seeds, threads and the machine."""

    schema: Literal["vislam.manifest/1"]
    command: Annotated[str, Meta(description="that repeats the run; empty where it was made in another way")]
    compare: Annotated[Request, Meta(description="what was compared; a run is repeated from it")] | UnsetType = UNSET
    settings: Annotated[Settings, Meta(description="with which settings, whole")] | UnsetType = UNSET
    date: Annotated[str, Meta(description="ISO 8601, UTC")]
    versions: Versions
    git_revision: Annotated[str | None, Meta(description="-dirty where edited; null outside a checkout")]
    sequence: RecordingRecord
    start: Annotated[str, Meta(description="where every run started")]
    estimators: Annotated[tuple[str, ...], Meta(description="that ran here")]
    references: (
        Annotated[tuple[str, ...], Meta(description="that were read from files; not over seeds")] | UnsetType
    ) = UNSET
    seeds: SeedsUsed
    threads: Annotated[
        dict[str, int | str | None],
        Meta(description="processors, and the limits of threads: variables, or over seeds workers and threads of each"),
    ]
    arithmetic: (
        Annotated[
            dict[str, ArithmeticOfRuns],
            Meta(description="that ran, by estimator, of those that have compiled code; both only over seeds"),
        ]
        | UnsetType
    ) = UNSET
    cpu: str
    os: str
    files: (
        Annotated[tuple[str, ...], Meta(description="that the run wrote, relative to its directory, this one too")]
        | UnsetType
    ) = UNSET
