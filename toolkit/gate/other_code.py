"""Another version of the code, a git revision or a wheel, unpacked beside the installed one."""

import io
import subprocess
import tarfile
import tempfile
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from toolkit.errors import printable
from toolkit.gate.baseline import BaselineError


@contextmanager
def unpacked(version: str) -> Iterator[tuple[Path, ...]]:
    """Unpack a wheel, or a git revision of the checkout one stands in, for a while; yield what to put on the path.

    Raises BaselineError where it is neither.
    """
    with tempfile.TemporaryDirectory(prefix="vislam-") as folder:
        tree = Path(folder).resolve()
        if Path(version).suffix == ".whl":
            _unpack_wheel(Path(version), tree)
        else:
            _unpack_revision(version, tree)
        yield tuple(path for path in (tree / "src", tree) if path.is_dir())


def _unpack_wheel(wheel: Path, folder: Path) -> None:
    try:
        with zipfile.ZipFile(wheel) as archive:
            archive.extractall(folder)
    except (OSError, zipfile.BadZipFile) as error:
        raise BaselineError(f"{wheel}: it is no wheel that can be read ({error}); build one with pip wheel") from error


def _unpack_revision(revision: str, folder: Path) -> None:
    top = _git("rev-parse", "--show-toplevel", remedy="stand in a checkout, or name a wheel")
    remedy = "name a revision of this checkout, or a wheel"
    commit = _git("rev-parse", "--verify", "--quiet", "--end-of-options", f"{revision}^{{commit}}", remedy=remedy)
    archive = _git("archive", commit.decode().strip(), remedy=remedy, folder=top.decode().removesuffix("\n"))
    with tarfile.open(fileobj=io.BytesIO(archive)) as packed:
        packed.extractall(folder, filter="data")


def _git(*words: str, remedy: str, folder: str = ".") -> bytes:
    try:
        done = subprocess.run(["git", "-C", folder, *words], capture_output=True, check=False)
    except OSError as error:
        raise BaselineError(f"git cannot be run ({error}); name a wheel") from error
    if done.returncode:
        said = printable(done.stderr.decode(errors="replace").strip()) or "it is not known here"
        raise BaselineError(f"git {words[0]} {words[-1]}: {said}; {remedy}")
    return done.stdout
