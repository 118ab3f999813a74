"""Find the modules of announced packages: the estimators, metrics and datasets of this and other distributions.

An installed distribution announces, under an entry-point group such as ``toolkit.metrics``, a package; every public
module directly in that package is one estimator, metric file or dataset. No list of names has to be edited.
"""

import ast
import importlib
import importlib.util
import pkgutil
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache
from importlib import metadata
from pathlib import Path
from types import ModuleType

from toolkit.errors import ExtensionError


def shown_name(module: str) -> str:
    """Return the name under which a user reads of a module: ``my_package.my_filter`` is ``my-filter``."""
    return module.rpartition(".")[2].replace("_", "-")


class MissingDependency(Exception):  # noqa: N818 - what a module needs and this installation lacks
    """Raised where a module cannot be imported because a package of another distribution is not installed."""

    def __init__(self, package: str) -> None:
        super().__init__(f"it needs the package {package}")


@dataclass(frozen=True)
class FoundModule:
    """A module of an announced package: its dotted name and its file."""

    module: str
    path: Path

    @property
    def name(self) -> str:
        return shown_name(self.module)

    def tree(self) -> ast.Module:
        """Return the module's syntax tree, without importing it."""
        file = self.path.stat()
        return _parsed(self.path, (file.st_mtime_ns, file.st_size))

    def constants(self) -> dict[str, object]:
        """Return the module's top-level assignments of literals, alone or in tuples, by name, without importing it."""
        found: dict[str, object] = {}
        for statement in self.tree().body:
            if isinstance(statement, ast.Assign):
                pairs = [pair for target in statement.targets for pair in _paired(target, statement.value)]
            elif isinstance(statement, ast.AnnAssign) and statement.value is not None:
                pairs = _paired(statement.target, statement.value)
            else:
                continue
            for target, value in pairs:
                with suppress(ValueError):  # not a literal, so nothing that is read here
                    found |= {target.id: ast.literal_eval(value)} if isinstance(target, ast.Name) else {}
        return found

    def load(self) -> ModuleType:
        """Import the module.

        Raises MissingDependency where it needs a package that is not installed. Any other error is a defect and
        passes through, a misspelt module of the module's own package or of the toolkit included.
        """
        try:
            return importlib.import_module(self.module)
        except ModuleNotFoundError as error:
            if error.name is None or error.name.split(".")[0] in (self.module.split(".")[0], "toolkit"):
                raise
            raise MissingDependency(error.name) from error


@lru_cache(maxsize=64)
def _parsed(path: Path, _state: tuple[int, int]) -> ast.Module:
    """Return a module's syntax, which is read once in each state of the file."""
    try:
        return ast.parse(path.read_text(encoding="utf-8"))
    except SyntaxError as error:
        raise ExtensionError(f"{path}: line {error.lineno} is no Python ({error.msg}); correct it there") from error


def _paired(target: ast.expr, value: ast.expr) -> list[tuple[ast.expr, ast.expr]]:
    """Pair each name on the left of an assignment with its expression on the right."""
    if isinstance(target, ast.Tuple) and isinstance(value, ast.Tuple) and len(target.elts) == len(value.elts):
        return list(zip(target.elts, value.elts, strict=True))
    return [(target, value)]


def modules_in(package: str, folders: Iterable[str]) -> list[FoundModule]:
    """Return the modules directly in a package's folders; sub-packages and private modules are parts, not members."""
    return [
        FoundModule(f"{package}.{module.name}", Path(folder) / f"{module.name}.py")
        for folder in folders
        for module in pkgutil.iter_modules([folder])
        if not module.ispkg and not module.name.startswith("_")
    ]


def announced(group: str) -> list[FoundModule]:
    """Return the modules of every package announced under an entry-point group, importing none of them.

    Raises ExtensionError where an entry point does not name a package.
    """
    found: list[FoundModule] = []
    for package in sorted({point.value for point in entry_points(group=group)}):
        try:
            spec = importlib.util.find_spec(package)
        except ModuleNotFoundError as error:
            if error.name is None or not f"{package}.".startswith(f"{error.name}."):
                raise
            spec = None  # a parent of the package does not exist
        if spec is None or spec.submodule_search_locations is None:
            raise ExtensionError(
                f"the entry point {group} names {package}, which is not a package here; install what announces it again"
            )
        found += modules_in(package, spec.submodule_search_locations)
    return found


@lru_cache(maxsize=8)
def entry_points(group: str) -> tuple[metadata.EntryPoint, ...]:
    """Return what installed distributions announce under a group; what is installed later is found by a new process."""
    return tuple(metadata.entry_points(group=group))
