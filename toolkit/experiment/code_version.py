"""Versions of the code and of the numeric packages, on which results depend besides data and settings."""

import hashlib
import platform
from collections.abc import Iterator
from functools import cache
from importlib.metadata import PackageNotFoundError, entry_points, version
from importlib.util import find_spec
from pathlib import Path

from toolkit import datasets, metrics, registry

# Distributions by their name in a manifest.
NUMERIC_PACKAGES = {
    "numpy": "numpy",
    "scipy": "scipy",
    "gtsam": "gtsam",
    "opencv": "opencv-python-headless",
    "numba": "numba",
}
# The toolkit's layers above the experiment, which it cannot import: they change no result.
_ABOVE = ("api.py", "cli", "evaluation", "gate", "report", "verify.py")
_CODE = (".py", ".so", ".pyd")
_ANNOUNCED = (registry.ENTRY_POINT_GROUP, metrics.ENTRY_POINT_GROUP, datasets.ENTRY_POINT_GROUP)


@cache
def code_digest() -> str:
    """Return the SHA-256 of the code that loads, runs and scores: the toolkit's, and every announced package's."""
    digest = hashlib.sha256()
    for name, path in sorted(_code_files()):
        digest.update(f"{name}\0{hashlib.sha256(path.read_bytes()).hexdigest()}\n".encode())
    return digest.hexdigest()


@cache
def numeric_versions() -> dict[str, str]:
    """Return the versions of Python and of the packages that compute, by name; empty for one not installed."""
    return {"python": platform.python_version()} | {
        name: installed_version(package) or "" for name, package in NUMERIC_PACKAGES.items()
    }


@cache
def installed_version(package: str) -> str | None:
    """Return the version of a distribution, or None where it is not installed."""
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def _code_files() -> Iterator[tuple[str, Path]]:
    """Yield every file of code by a name that does not depend on where it is installed."""
    toolkit = Path(__file__).parents[1]
    for name, path in _files_of("toolkit", toolkit):
        if path.relative_to(toolkit).parts[0] not in _ABOVE:
            yield name, path
    packages = {point.value.split(".")[0] for group in _ANNOUNCED for point in entry_points(group=group)}
    for package in packages - {"toolkit"}:
        spec = find_spec(package)
        for folder in [] if spec is None else spec.submodule_search_locations or []:
            yield from _files_of(package, Path(folder))


def _files_of(package: str, folder: Path) -> Iterator[tuple[str, Path]]:
    for path in folder.rglob("*"):
        if path.suffix in _CODE:
            yield f"{package}/{path.relative_to(folder).as_posix()}", path
