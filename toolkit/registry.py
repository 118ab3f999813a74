"""How the toolkit finds estimators without naming one.

An installed package announces, in the entry-point group ``toolkit.estimators``, a package whose modules are estimators:
a file ``my_filter.py`` is the estimator ``my-filter``. The first line of its docstring is its summary and its function
``build(setup)`` makes one. Constants of literals say more of it: ``RUNG`` is its place on the ladder, in which every
rung changes one thing, and ``CHANGE`` what it changes; ``DEFAULT`` says that it is compared where no estimator is
named; ``OPTIONS`` names the settings that it alone reads, and may give the values that each takes, the default first;
``INGREDIENTS`` says what it has of what estimators differ in, and ``WITHOUT`` which settings take that away;
``RULES`` lists the common rules below for which it differs from the default: True where it obeys a rule, the kinds of
motion beside which it does, as ``("imu",)``, or the reason why it does not; ``CITES`` is what ``vislam cite`` prints
for it, keys of toolkit/report/references.bib or BibTeX itself.

Where a name is expected, ``my_filter.py`` names a file of one's own, which no package needs to announce.
"""

import ast
import hashlib
import sys
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from types import ModuleType
from typing import cast

import msgspec

from toolkit.discovery import FoundModule, MissingDependency, announced, shown_name
from toolkit.errors import DataError, EstimatorError, no_such, printable
from toolkit.estimator import Build
from toolkit.files.reading import read_input
from toolkit.measurements import MOTION_KINDS, MotionKind
from toolkit.settings import Scalar, Settings

ENTRY_POINT_GROUP = "toolkit.estimators"
# Among the names of estimators to compare, this word stands for all that have a rung.
LADDER = "ladder"
# Settings that are meant for all estimators, and whether an estimator obeys them by default, when its module has no
# entry for them: the outlier policy and the window.
RULES = {"outliers": True, "window": True}


@dataclass(frozen=True)
class OwnFile(FoundModule):
    """A file that no package announces. Its content is read once, and every process runs what was read."""

    content: bytes

    def tree(self) -> ast.Module:
        """Return the syntax tree of the content; raises EstimatorError where it is no Python."""
        try:
            return ast.parse(self.content, str(self.path))
        except (SyntaxError, ValueError) as error:
            raise cannot_import(str(self.path), error) from error

    def load(self) -> ModuleType:
        """Return the module, which may import what stands beside the file.

        Raises EstimatorError where it cannot be imported, for whatever reason.
        """
        return _imported(self)


@lru_cache(maxsize=16)
def _imported(file: OwnFile) -> ModuleType:
    module = ModuleType(file.module)
    module.__file__ = str(file.path)
    folder = str(file.path.resolve().parent)
    if folder not in sys.path:
        sys.path.insert(0, folder)
    # As an import does, because dataclasses look up their module there.
    sys.modules.setdefault(file.module, module)
    try:
        exec(compile(file.tree(), str(file.path), "exec"), vars(module))
    except EstimatorError:
        raise
    except (Exception, SystemExit) as error:  # a script may end where it is imported
        raise cannot_import(str(file.path), error) from error
    return module


def cannot_import(word: str, error: BaseException) -> EstimatorError:
    """Return the error for a file or module that cannot be imported, with the line where it is no Python."""
    where = f", line {error.lineno}" if isinstance(error, SyntaxError) and error.lineno else ""
    return EstimatorError(f"{word}{where}: it cannot be imported ({type(error).__name__}: {error})")


@dataclass(frozen=True)
class EstimatorEntry:
    """One estimator: its name and the module it lives in."""

    name: str
    found: FoundModule

    @property
    def own_digest(self) -> str:
        """Return the SHA-256 of a file of one's own; empty for an announced estimator, which is code of a package."""
        return hashlib.sha256(self.found.content).hexdigest() if isinstance(self.found, OwnFile) else ""

    @property
    def word(self) -> str:
        """Return what finds this estimator again: its name, or the path of a file of one's own."""
        return str(self.found.path) if isinstance(self.found, OwnFile) else self.name

    def summary(self) -> str:
        """Return the first line of the module's docstring, without importing the module."""
        return (ast.get_docstring(self.found.tree()) or "").partition("\n")[0]

    def rung(self) -> int | None:
        """Return the estimator's place on the ladder, or None; read without importing the module, as is all here."""
        rung = self.found.constants().get("RUNG")
        return rung if isinstance(rung, int) else None

    def is_default(self) -> bool:
        """Say whether the estimator is compared where none is named: its module's constant ``DEFAULT``."""
        return self.found.constants().get("DEFAULT") is True

    def change(self) -> str:
        """Return what the estimator changes against the rung before it; empty where the module does not say."""
        change = self.found.constants().get("CHANGE")
        return change if isinstance(change, str) else ""

    def options(self) -> Mapping[str, tuple[Scalar, ...]]:
        """Return the settings that this estimator alone reads, each with the values it takes: ``OPTIONS``.

        The first value is the default; there is none where the module names no values, and any may be set. Raises
        EstimatorError where it is not so.
        """
        options = self.found.constants().get("OPTIONS", ())
        try:
            if isinstance(options, dict):
                return msgspec.convert(options, dict[str, tuple[Scalar, ...]])
            return dict.fromkeys(msgspec.convert(options, tuple[str, ...]), ())
        except msgspec.ValidationError as error:
            raise self._refused("OPTIONS has to be a tuple of names, or to map names to tuples of values") from error

    def ingredients(self) -> Mapping[str, Mapping[str, Scalar]]:
        """Return what the estimator has of what estimators differ in, each with the settings that take it away.

        These are its constants ``INGREDIENTS`` and ``WITHOUT``. A key without a dot is an option of its own, ``output``
        the kind of output. Raises EstimatorError where they are not so.
        """
        constants = self.found.constants()
        try:
            names = msgspec.convert(constants.get("INGREDIENTS", ()), tuple[str, ...])
            without = msgspec.convert(constants.get("WITHOUT", {}), dict[str, dict[str, Scalar]])
        except msgspec.ValidationError as error:
            raise self._refused("INGREDIENTS has to be a tuple of names, WITHOUT to map some to settings") from error
        if strange := without.keys() - set(names):
            raise self._refused(f"WITHOUT takes away {min(strange)}, which INGREDIENTS does not have")
        return {name: without.get(name, {}) for name in names}

    def obeys(self, rule: str, motion_kind: MotionKind | None = None) -> bool:
        """Say whether the estimator obeys a common rule, one of :data:`RULES`, beside a kind of motion or any."""
        value = self._rules().get(rule, RULES[rule])
        return motion_kind in value if isinstance(value, tuple) else value is True

    def ignores(self) -> Mapping[str, str]:
        """Return the common rules that the estimator does not obey although most do, and why."""
        return {rule: why for rule, why in self._rules().items() if isinstance(why, str)}

    def _rules(self) -> Mapping[str, bool | str | tuple[str, ...]]:
        rules = self.found.constants().get("RULES", {})
        declared = rules if isinstance(rules, dict) else {"": False}
        if not all(rule in RULES and _is_rule_value(what) for rule, what in declared.items()):
            raise self._refused(
                f"RULES has to map some of {', '.join(RULES)} to True, to kinds of motion ({', '.join(MOTION_KINDS)}), "
                "or to the reason why it does not obey the rule"
            )
        return declared

    def _refused(self, what: str) -> EstimatorError:
        return EstimatorError(f"estimator {self.name}: in {self.found.path.name} {what}")

    def check_usable(self, settings: Settings) -> None:
        """Raise EstimatorError unless the estimator can be imported and reads every option set for it."""
        self._rules()
        self.load()
        self.check_options(settings)

    def check_options(self, settings: Settings) -> None:
        """Raise EstimatorError unless the estimator names every option that is set for it."""
        known = self.options()
        for option, value in settings.options_of(self.name).items():
            if option not in known:
                names = ", ".join(sorted(known)) or "none"
                others = [name for name, entry in discover().items() if option in entry.options()]
                there = f"; {' and '.join(others)} {'have' if others[1:] else 'has'} it" if others else ""
                raise EstimatorError(f"estimator {self.name} has no option {option}; it has {names}{there}")
            if known[option] and value not in known[option]:
                values = " or ".join(str(one).lower() if isinstance(one, bool) else str(one) for one in known[option])
                raise EstimatorError(f"estimator {self.name}: option {option} is {value!r}; it takes {values}")

    def load(self) -> Build:
        """Import the estimator and return its ``build``.

        Raises EstimatorError where an optional dependency is missing or the module has no ``build``; any
        other error in the module is a defect and passes through.
        """
        try:
            module = self.found.load()
        except MissingDependency as missing:
            raise EstimatorError(f"estimator {self.name} is unavailable: {missing}") from missing
        if not callable(getattr(module, "build", None)):
            raise EstimatorError(f"estimator {self.name}: {self.found.path.name} defines no function build(setup)")
        return cast(Build, module.build)


def _is_rule_value(what: object) -> bool:
    if isinstance(what, tuple):
        return bool(what) and set(what) <= set(MOTION_KINDS)
    return what is True or (isinstance(what, str) and bool(what))


def discover() -> dict[str, EstimatorEntry]:
    """Find every estimator of every announced package, by name, importing none of them."""
    found = {one.name: EstimatorEntry(one.name, one) for one in announced(ENTRY_POINT_GROUP)}
    return dict(sorted(found.items()))


def ladder() -> tuple[EstimatorEntry, ...]:
    """Return every estimator that stands on the ladder, from the lowest rung up."""
    on_it = [(rung, name, entry) for name, entry in discover().items() if (rung := entry.rung()) is not None]
    return tuple(entry for _, _, entry in sorted(on_it, key=lambda placed: placed[:2]))


def defaults() -> tuple[str, ...]:
    """Return the names of the estimators that are compared where none is named, from the lowest rung up."""
    chosen = [(entry.rung() or 0, name) for name, entry in discover().items() if entry.is_default()]
    return tuple(name for _, name in sorted(chosen))


def check_options(settings: Settings, own: Collection[str] = ()) -> None:
    """Raise EstimatorError where an option is set that no known estimator has, whether discovered or among ``own``."""
    found = discover() if settings.estimators else {}
    for name in settings.estimators:
        if name not in {*found, *own}:
            raise EstimatorError(
                f"an option is set for {name}, and {no_such('estimator', name, sorted({*found, *own}))}"
            )
        if name not in own:
            found[name].check_options(settings)


def find_all(names: Iterable[str]) -> dict[str, EstimatorEntry]:
    """Return the estimators of the names, each once and in their order; LADDER stands for all of its rungs.

    Raises EstimatorError as :func:`find` does, and for a file whose name another estimator has.
    """
    found: dict[str, EstimatorEntry] = {}
    for name in names:
        for entry in ladder() if name == LADDER else (find(name),):
            other = found.setdefault(entry.name, entry)
            if entry.own_digest:
                other = discover().get(entry.name, other)
            if other != entry:
                taken = f"{entry.name} is the name of {other.found.path} as well"
                raise EstimatorError(f"{entry.found.path}: {taken}; give the file another name")
    return found


def find(name: str) -> EstimatorEntry:
    """Return the estimator of that name, or of a file that ends in .py.

    Raises EstimatorError for a name that no estimator has, with the names there are, and for a file that cannot be
    read. What is in a file is looked at when the estimator is loaded.
    """
    if name.endswith(".py"):
        return _own(Path(name))
    known = discover()
    if name not in known:
        own = "an estimator of your own is given as its file, as in my_filter.py"
        raise EstimatorError(f"{no_such('estimator', name, known)}; {own}")
    return known[name]


def _own(path: Path) -> EstimatorEntry:
    if not path.exists():
        raise EstimatorError(f"{path}: there is no such file")
    try:
        return EstimatorEntry(printable(shown_name(path.stem)), OwnFile(path.stem, path, read_input(path)))
    except DataError as error:
        raise EstimatorError(str(error)) from error
