"""``manifest.json``, the contract ``vislam.manifest/1``: how a run can be repeated.

It holds the command, every version, the data's hash, seeds, threads and the machine; ``made_here`` is the short form
that a baseline has.
"""

import os
import platform
import subprocess
from datetime import UTC, datetime
from functools import cache
from pathlib import Path
from typing import Annotated, Literal

import msgspec
from msgspec import UNSET, Meta, Struct, UnsetType

from toolkit.experiment.comparison import Comparison
from toolkit.experiment.configuration import Request
from toolkit.experiment.outcome_store import NUMERIC_PACKAGES, installed_version
from toolkit.experiment.workers import usable_cpus
from toolkit.files.documents import Json, reader
from toolkit.noise import MeasuredNoise
from toolkit.sequence import Sequence
from toolkit.settings import Settings
from toolkit.settings.reading import without_removed
from toolkit.threads import THREAD_VARIABLES

Versions = Annotated[dict[str, str | None], Meta(description="by package; null where it is not installed")]
_PACKAGES = {"toolkit": "vislam-toolkit", **NUMERIC_PACKAGES, "matplotlib": "matplotlib"}
_THREAD_VARIABLES = (*THREAD_VARIABLES, "TBB_NUM_THREADS")


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
    noise: Annotated[MeasuredNoise | UnsetType, Meta(description="as measured; absent where it is set")] = UNSET
    estimators: Annotated[tuple[str, ...], Meta(description="that ran here")]
    references: Annotated[tuple[str, ...] | UnsetType, Meta(description="read from files; not over seeds")] = UNSET
    seeds: SeedsUsed
    threads: Annotated[
        dict[str, int | str | None],
        Meta(description="processors, and the limits of threads: variables, or over seeds workers and threads of each"),
    ]
    cpu: str
    os: str
    files: Annotated[tuple[str, ...] | UnsetType, Meta(description="that the run wrote, this one too")] = UNSET


def _of_today(manifest: Json) -> Json:
    settings = manifest.get("settings")
    return {**manifest, "settings": without_removed(settings)} if isinstance(settings, dict) else manifest


read_manifest = reader(Manifest, "repeat the comparison", older={"vislam.manifest/1": _of_today})


def manifest_document(comparison: Comparison, command: str, requested: Request) -> Manifest:
    from_files = {run.estimator for run in comparison.runs if run.timings is None}
    here = tuple(name for name in comparison.estimators if name not in from_files)
    variables = {name: os.environ.get(name) for name in _THREAD_VARIABLES}
    versions = {name: installed_version(package) for name, package in _PACKAGES.items()}
    words = tuple(comparison.own_files.get(name, name) for name in here)
    request = msgspec.structs.replace(requested, sequences=(comparison.source,), estimators=words)
    return Manifest(
        schema="vislam.manifest/1",
        command=command,
        compare=request,
        settings=comparison.settings,
        date=_now(),
        versions={"python": platform.python_version(), **versions},
        git_revision=_git_revision(),
        sequence=recording_record(comparison.sequence),
        start=comparison.prior.source,
        noise=UNSET if comparison.measured is None else comparison.measured,
        estimators=here,
        references=tuple(name for name in comparison.estimators if name not in here),
        seeds=SeedsUsed(sequence=comparison.seeds[0], count=len(comparison.seeds) if comparison.over_seeds else UNSET),
        threads={"cpus": usable_cpus(), "workers": comparison.workers, "per_worker": 1, **variables},
        cpu=_cpu_model(),
        os=platform.platform(),
    )


def made_here(command: str) -> dict[str, str]:
    """Return what a baseline says of how, when and where it was made."""
    return {
        "command": command,
        "date": _now(),
        "git_revision": _git_revision() or "not from a checkout",
        "cpu": _cpu_model(),
    }


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")


def recording_record(sequence: Sequence) -> RecordingRecord:
    return RecordingRecord(
        name=sequence.name,
        hash=sequence.content_hash(),
        format=sequence.provenance.format,
        source=sequence.provenance.source,
    )


@cache
def _git_revision() -> str | None:
    """Return the commit the toolkit is checked out at, ``-dirty`` where it was edited, or None.

    A package installed somewhere inside another project's checkout is not at that project's revision.
    """
    checkout = Path(__file__).parents[2]
    if not (checkout / ".git").exists():
        return None
    try:
        described = subprocess.run(
            ["git", "-C", str(checkout), "describe", "--always", "--dirty", "--abbrev=40", "--exclude=*"],
            capture_output=True,
            text=True,
            timeout=10,
            check=True,
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return described.stdout.strip() or None


def _cpu_model() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        lines = []
    named = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    return next(named, "") or platform.processor() or platform.machine()
