"""Read a baseline back; whatever is wrong with the file is told in one line, with the place."""

from pathlib import Path

from toolkit import documents
from toolkit.gate import releases
from toolkit.gate.baseline import Baseline, BaselineError
from toolkit.gate.baseline_json import BaselineRecord, from_document

_REMEDY = "make the baseline with vislam baseline"


def load_baseline(path: Path) -> Baseline:
    """Read a baseline from its file, or from a folder the one made with the releases installed here.

    Raises BaselineError where there is none, or it is not one.
    """
    if path.is_dir():
        return _of_these_releases(path)
    return from_document(documents.read(path, BaselineRecord, remedy=_REMEDY, error=BaselineError))


def _of_these_releases(folder: Path) -> Baseline:
    known = {path: load_baseline(path) for path in sorted(folder.glob("*.json"))}
    fitting = {path: one for path, one in known.items() if not releases.differences(one.releases)}
    if len(fitting) == 1:
        return next(iter(fitting.values()))
    here = ", ".join(f"{name} {release}" for name, release in releases.installed().items())
    if not fitting:
        raise BaselineError(f"{folder}: none of {len(known)} baselines is for {here}; make one with vislam baseline")
    raise BaselineError(f"{folder}: {', '.join(path.name for path in fitting)} are all for {here}; name one of them")


def check_releases(baseline: Baseline, name: str) -> None:
    """Raise BaselineError where the baseline was made with other releases than are installed."""
    others = releases.differences(baseline.releases)
    if others:
        raise BaselineError(
            f"{name}: made with {'; '.join(others)}, which alone may change results; make a baseline with these "
            "releases, or compare all the same with --allow-other-releases"
        )
