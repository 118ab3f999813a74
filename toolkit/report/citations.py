"""What to cite for estimators and data sets: BibTeX, from the constant ``CITES`` of their own modules.

An entry of ``CITES`` is a key of references.bib beside this file, or BibTeX itself, so that a new estimator stays one
file. Nothing is imported to read it.
"""

import os
import re
from collections.abc import Iterable, Mapping
from functools import cache
from importlib.metadata import version
from importlib.resources import files
from pathlib import Path

from toolkit import datasets
from toolkit.discovery import FoundModule, shown_name
from toolkit.errors import EstimatorError, no_such
from toolkit.registry import discover
from toolkit.report.manifest import read_manifest
from toolkit.report.run_directory import MANIFEST

_ENTRY = re.compile(r"^@\w+\{\s*([^,\s]+)\s*,.*?^\}", re.MULTILINE | re.DOTALL)
_SOFTWARE = """@software{{vislam_toolkit,
  title = {{{{vislam-toolkit}}: filters and smoothers for stereo visual-inertial odometry on the same measurements}},
  author = {{{{The vislam-toolkit developers}}}},
  version = {{{version}}}
}}"""


def citations(names: Iterable[str]) -> dict[str, dict[str, str]]:
    """Return what to cite for estimators, formats, files of estimators and run directories; for all without names.

    It is BibTeX by key, by name, and empty where there is nothing to cite. Raises EstimatorError for a name nobody
    knows or a key that references.bib does not have, DataError for a directory that is no run's.
    """
    known = {name: entry.found for name, entry in discover().items()} | datasets.modules()
    wanted = [found for name in names for found in _meant(name, known)] or list(known.items())
    return {name: _entries(module) for name, module in dict(wanted).items()}


def bibtex(cited: Mapping[str, Mapping[str, str]]) -> str:
    """Return BibTeX: the toolkit itself, then every entry once, under the names that it is cited for."""
    entries = {key: text for of_one in cited.values() for key, text in of_one.items()}
    nothing = [name for name, of_one in cited.items() if not of_one]
    parts = [f"% the toolkit\n{_SOFTWARE.format(version=version('vislam-toolkit'))}"]
    for key, text in entries.items():
        parts.append(f"% {', '.join(name for name, of_one in cited.items() if key in of_one)}\n{text}")
    parts += [f"% nothing to cite for {', '.join(nothing)}"] if nothing else []
    return "\n\n".join(parts) + "\n"


def _meant(name: str, known: Mapping[str, FoundModule]) -> list[tuple[str, FoundModule]]:
    if name in known:
        return [(name, known[name])]
    path = Path(name)
    if path.suffix == ".py" and path.is_file():
        return [(shown_name(path.stem), FoundModule(path.stem, path))]
    if not name or not os.path.isdir(name):  # noqa: PTH112 - a name that is too long is no directory either
        raise EstimatorError(f"{no_such('estimator or format', name, known)}, or name a run directory")
    manifest = read_manifest(path / MANIFEST)
    inside = (*manifest.estimators, manifest.sequence.format)
    return [(one, known[one]) for one in inside if one in known]


def _entries(module: FoundModule) -> dict[str, str]:
    given = module.constants().get("CITES", ())
    found: dict[str, str] = {}
    for entry in (given,) if isinstance(given, str) else given if isinstance(given, tuple | list) else ():
        text = str(entry)
        if text.lstrip().startswith("@"):
            found |= _parsed(text)
        elif text in references():
            found[text] = references()[text]
        else:
            raise EstimatorError(f"{module.path}: {no_such('reference', text, references())}; or give BibTeX, @...")
    return found


@cache
def references() -> dict[str, str]:
    return _parsed(files("toolkit.report").joinpath("references.bib").read_text(encoding="utf-8"))


def _parsed(text: str) -> dict[str, str]:
    return {found[1]: found[0].strip() for found in _ENTRY.finditer(text.strip() + "\n")}
