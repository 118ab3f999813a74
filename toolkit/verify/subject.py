"""Finds the estimator to verify: by name where it is installed, or by the file or module that defines it."""

import importlib
import importlib.util
import re
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import cast

from toolkit.discovery import shown_name
from toolkit.errors import DataError, EstimatorError, no_such, printable
from toolkit.estimator import Build, discover
from toolkit.files.reading import open_input

_MODULE = re.compile(r"\w+(\.\w+)+")


@dataclass(frozen=True)
class Subject:
    """An estimator to verify: its name, and what loads its ``build``."""

    name: str
    load: Callable[[], Build]


def subject_of(word: str) -> Subject:
    """Return the estimator that an argument names: ``my_filter.py``, ``my_package.my_filter`` or ``ekf``.

    Loading it raises EstimatorError where the file cannot be imported or has no function ``build(setup)``. Raises
    EstimatorError where the argument names nothing.
    """
    if word.endswith(".py"):
        path = Path(word)
        if not path.exists():
            raise EstimatorError(f"{path}: there is no such file")
        try:
            open_input(path).close()
        except DataError as error:
            raise EstimatorError(str(error)) from error
        return Subject(printable(shown_name(path.stem)), lambda: _build_of(lambda: _imported(path), word))
    known = discover()
    if word in known:
        return Subject(word, known[word].load)
    if _MODULE.fullmatch(word):
        return Subject(shown_name(word), lambda: _build_of(lambda: importlib.import_module(word), word))
    raise EstimatorError(f"{no_such('estimator', word, known)}; a file ends in .py")


def _imported(path: Path) -> ModuleType:
    """Import a file as a module of its own, which may import what stands beside it."""
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    folder = str(path.resolve().parent)
    if folder not in sys.path:
        sys.path.insert(0, folder)
    # As an import does, because dataclasses look up their module there.
    sys.modules.setdefault(path.stem, module)
    spec.loader.exec_module(module)
    return module


def _build_of(imported: Callable[[], ModuleType], word: str) -> Build:
    try:
        module = imported()
    except EstimatorError:
        raise
    except (Exception, SystemExit) as error:  # a script may end where it is imported
        where = f", line {error.lineno}" if isinstance(error, SyntaxError) and error.lineno else ""
        raise EstimatorError(f"{word}{where}: it cannot be imported ({type(error).__name__}: {error})") from error
    if not callable(getattr(module, "build", None)):
        raise EstimatorError(f"{word}: it defines no function build(setup)")
    return cast(Build, module.build)
