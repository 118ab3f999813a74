"""How a run can be repeated: the command, every version, the data's hash, seeds, threads and the machine."""

import os
import platform
import subprocess
from collections.abc import Mapping
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from msgspec import UNSET, UnsetType

import toolkit
from toolkit.experiment.monte_carlo import OverSeeds
from toolkit.experiment.workers import usable_cpus
from toolkit.report.comparison import Comparison
from toolkit.report.records.manifest import Manifest, Recording, SeedsUsed
from toolkit.sequence import Sequence

_PACKAGES = {
    "toolkit": "vislam-toolkit",
    "numpy": "numpy",
    "scipy": "scipy",
    "gtsam": "gtsam",
    "opencv": "opencv-python-headless",
    "matplotlib": "matplotlib",
}
_THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "TBB_NUM_THREADS")


def manifest_document(comparison: Comparison, command: str, seed: int) -> Manifest:
    """Return the manifest of a comparison made by ``command`` with ``seed``."""
    return _manifest(
        command,
        comparison.sequence,
        start=comparison.prior.source,
        estimators=tuple(run.estimator for run in comparison.runs if run.timings is not None),
        references=tuple(run.estimator for run in comparison.runs if run.timings is None),
        seeds=SeedsUsed(sequence=seed),
        threads={name: os.environ.get(name) for name in _THREAD_VARIABLES},
    )


def seeds_manifest_document(over: OverSeeds, first: Sequence, command: str) -> Manifest:
    """Return the manifest of a comparison over seeds; ``first`` is the recording of the first seed."""
    return _manifest(
        command,
        first,
        start=over.start,
        estimators=over.estimators,
        references=UNSET,
        seeds=SeedsUsed(sequence=over.seeds[0], count=len(over.seeds)),
        threads={"workers": over.workers, "per_worker": 1},
    )


def _manifest(
    command: str,
    sequence: Sequence,
    *,
    start: str,
    estimators: tuple[str, ...],
    references: tuple[str, ...] | UnsetType,
    seeds: SeedsUsed,
    threads: Mapping[str, int | str | None],
) -> Manifest:
    """Return a manifest with what is asked of this machine and installation: versions, revision, processors."""
    versions = {name: _version(package) for name, package in _PACKAGES.items()}
    return Manifest(
        schema="vislam.manifest/1",
        command=command,
        date=datetime.now(UTC).isoformat(timespec="seconds"),
        versions={"python": platform.python_version(), **versions},
        git_revision=git_revision(Path(toolkit.__file__).parent),
        sequence=_recording(sequence),
        start=start,
        estimators=estimators,
        references=references,
        seeds=seeds,
        threads={"cpus": usable_cpus(), **threads},
        cpu=cpu_model(),
        os=platform.platform(),
    )


def _recording(sequence: Sequence) -> Recording:
    return Recording(
        name=sequence.name,
        hash=sequence.content_hash(),
        format=sequence.provenance.format,
        source=sequence.provenance.source,
    )


def git_revision(package: Path) -> str | None:
    """Return the commit a package's folder is checked out at, ``-dirty`` where it was edited, or None.

    A package installed somewhere inside another project's checkout is not at that project's revision.
    """
    if not (package.parent / ".git").exists():
        return None
    try:
        described = subprocess.run(
            ["git", "-C", str(package.parent), "describe", "--always", "--dirty", "--abbrev=40", "--exclude=*"],
            capture_output=True,
            text=True,
            timeout=10,
            check=True,
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return described.stdout.strip() or None


def cpu_model() -> str:
    """Return the processor's name as the system tells it."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        lines = []
    named = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    return next(named, "") or platform.processor() or platform.machine()


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None
