"""How a run can be repeated: the command, every version, the data's hash, seeds, threads and the machine."""

import os
import platform
import subprocess
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import toolkit
from toolkit.experiment.comparison import Comparison
from toolkit.experiment.workers import usable_cpus
from toolkit.report.metrics_json import Json
from toolkit.sequence import Sequence

SCHEMA = "vislam.manifest/1"
_PACKAGES = {
    "toolkit": "vislam-toolkit",
    "numpy": "numpy",
    "scipy": "scipy",
    "gtsam": "gtsam",
    "opencv": "opencv-python-headless",
    "matplotlib": "matplotlib",
}
_THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "TBB_NUM_THREADS")


def build(comparison: Comparison, command: str) -> Json:
    """Return the manifest of a comparison made by ``command``."""
    here, seeds = _estimators(comparison), {"sequence": comparison.seeds[0]}
    if comparison.over_seeds:
        seeds["count"] = len(comparison.seeds)
    return {
        **_made_by(command),
        "sequence": _sequence(comparison.sequence),
        "start": comparison.prior.source,
        "estimators": here,
        "references": [name for name in comparison.estimators if name not in here],
        "seeds": seeds,
        "threads": {
            "cpus": usable_cpus(),
            "workers": comparison.workers,
            "per_worker": 1,
            **{name: os.environ.get(name) for name in _THREAD_VARIABLES},
        },
        **_machine(),
    }


def _estimators(comparison: Comparison) -> list[str]:
    """Return the estimators that were run here."""
    others = {run.estimator for run in comparison.runs if run.timings is None}
    return [name for name in comparison.estimators if name not in others]


def _made_by(command: str) -> Json:
    return {
        "schema": SCHEMA,
        "command": command,
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "versions": {"python": platform.python_version(), **{name: _version(p) for name, p in _PACKAGES.items()}},
        "git_revision": git_revision(Path(toolkit.__file__).parent),
    }


def _sequence(sequence: Sequence) -> Json:
    return {
        "name": sequence.name,
        "hash": sequence.content_hash(),
        "format": sequence.provenance.format,
        "source": sequence.provenance.source,
    }


def _machine() -> Json:
    return {"cpu": cpu_model(), "os": platform.platform()}


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
