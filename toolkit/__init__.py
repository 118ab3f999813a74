"""Compare a handwritten stereo visual-inertial EKF with a GTSAM smoother on the same measurements.

``toolkit.compare("drive", ["ekf", "batch"])`` is the whole of it; what the package offers is imported when first used.

Reading order: sequence (what comes in; its parts are measured_motion, resampling, track_noise, track_budget) ->
estimator, estimate, answers (what comes out) -> models -> filters/ekf -> filters/batch -> runner (one over the other,
with divergence) -> metrics -> experiment -> report. docs/architecture.md has the picture.
Before a run: datasets, frontend and simulation make a sequence, audit looks for its faults, track_errors for its noise,
initialization for a first state. Beside it: gate, evaluation and verify judge; cli and api are what users call. Below
all: settings, files, progress, discovery, compilation, arrays, jackknife, geometry, threads, errors.
"""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from toolkit.api import Result, compare
    from toolkit.datasets import load_sequence
    from toolkit.datasets.own_tables import save
    from toolkit.settings import Settings

    __version__: str

__all__ = ["Result", "Settings", "compare", "load_sequence", "save"]

_HOME = {
    "Result": "toolkit.api",
    "Settings": "toolkit.settings",
    "compare": "toolkit.api",
    "load_sequence": "toolkit.datasets",
    "save": "toolkit.datasets.own_tables",
}


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from importlib.metadata import version

        return version("vislam-toolkit")
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib import import_module

    return getattr(import_module(_HOME[name]), name)


def __dir__() -> list[str]:
    return [*globals(), *_HOME]
