"""The protocol every estimator follows, and how the toolkit finds estimators without naming one.

An installed package announces, in the entry-point group ``toolkit.estimators``, a package whose modules are
estimators: a file ``my_filter.py`` is the estimator ``my-filter``. The first line of its docstring is its
summary and its function ``build(setup)`` makes one.
"""

import ast
import importlib
import importlib.util
import pkgutil
from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import entry_points
from pathlib import Path
from typing import Literal, Protocol, cast

from toolkit.errors import EstimatorError
from toolkit.estimate import Estimate, Finished
from toolkit.geometry import Array
from toolkit.sequence import MotionNoise, Packet, Prior, StereoRig

ENTRY_POINT_GROUP = "toolkit.estimators"


@dataclass(frozen=True, eq=False)
class Setup:
    """All that an estimator knows before the first packet; ``gravity_world`` (3,) m/s^2."""

    rig: StereoRig
    noise: MotionNoise
    prior: Prior
    gravity_world: Array
    motion_kind: Literal["twist", "imu"]


class Estimator(Protocol):
    """Reads packets in order of time and says where the IMU is."""

    def step(self, packet: Packet) -> Estimate | None:
        """Answer for the packet's frame from the past alone, or return None to answer only at the end."""

    def finish(self) -> Finished:
        """Answer for every frame with all that is known at the end."""


Build = Callable[[Setup], Estimator]


@dataclass(frozen=True)
class EstimatorEntry:
    """One discovered estimator: its name, the module it lives in and the file it was found in."""

    name: str
    module: str
    path: Path

    def summary(self) -> str:
        """Return the first line of the module's docstring, without importing the module."""
        docstring = ast.get_docstring(ast.parse(self.path.read_text(encoding="utf-8"))) or ""
        return docstring.partition("\n")[0]

    def load(self) -> Build:
        """Import the estimator and return its ``build``.

        Raises EstimatorError where an optional dependency is missing or the module has no ``build``; any
        other error in the module is a defect and passes through.
        """
        try:
            module = importlib.import_module(self.module)
        except ModuleNotFoundError as error:
            if error.name is None or error.name.split(".")[0] in (self.module.split(".")[0], "toolkit"):
                raise
            raise EstimatorError(f"estimator {self.name} is unavailable: it needs the package {error.name}") from error
        if not callable(getattr(module, "build", None)):
            raise EstimatorError(f"estimator {self.name}: {self.path.name} defines no function build(setup)")
        return cast(Build, module.build)


def discover() -> dict[str, EstimatorEntry]:
    """Find every estimator of every announced package, by name, importing none of them."""
    found: dict[str, EstimatorEntry] = {}
    for package in sorted({point.value for point in entry_points(group=ENTRY_POINT_GROUP)}):
        spec = importlib.util.find_spec(package)
        if spec is None or spec.submodule_search_locations is None:
            raise EstimatorError(f"the entry point {ENTRY_POINT_GROUP} names {package}, which is not a package here")
        for folder in spec.submodule_search_locations:
            for module in pkgutil.iter_modules([folder]):
                if module.ispkg or module.name.startswith("_"):
                    continue
                name = module.name.replace("_", "-")
                found[name] = EstimatorEntry(name, f"{package}.{module.name}", Path(folder) / f"{module.name}.py")
    return dict(sorted(found.items()))


def find(name: str) -> EstimatorEntry:
    """Return the estimator of that name, or raise EstimatorError with the names there are."""
    known = discover()
    if name not in known:
        raise EstimatorError(f"no estimator is called {name}; there are {', '.join(known)}")
    return known[name]
