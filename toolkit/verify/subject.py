"""Finds the estimator to verify: by name where it is installed, or by the file or module that defines it."""

import importlib
import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import cast

from toolkit.discovery import shown_name
from toolkit.errors import EstimatorError
from toolkit.estimator import Build
from toolkit.registry import cannot_import, discover, find

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
    if _MODULE.fullmatch(word) and not word.endswith(".py") and word not in discover():
        return Subject(shown_name(word), lambda: _build_of(word))
    entry = find(word)
    return Subject(entry.name, entry.load)


def _build_of(word: str) -> Build:
    try:
        module = importlib.import_module(word)
    except (Exception, SystemExit) as error:  # a script may end where it is imported
        raise cannot_import(word, error) from error
    if not callable(getattr(module, "build", None)):
        raise EstimatorError(f"{word}: it defines no function build(setup)")
    return cast(Build, module.build)
