"""Compare a handwritten stereo visual-inertial EKF with a GTSAM smoother on the same measurements.

``toolkit.compare("drive", ["ekf", "batch"])`` runs a comparison, ``toolkit.sweep`` many, ``toolkit.explain`` says why
one wins. Submodules are imported when first used.

Reading order: measurements (what estimators read), sequence (the recording it comes from; its parts are motion_samples,
track_budget) -> estimator, estimate (the output; answers checks it) -> models -> filters/ekf -> filters/batch -> runner
(an estimator over a sequence, with divergence) -> metrics -> experiment -> report. docs/architecture.md has the
picture. Before a run: datasets, frontend and simulation make a sequence, audit finds its faults, noise measures how
noisy it is, initialization finds the first state. gate, evaluation and verify judge results; users call cli and api.
registry and discovery find what packages announce. The lowest layers: settings, files, progress, arrays,
jackknife, geometry, threads, errors.
"""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from toolkit.api import ExplainResult, Result, SweepResult, compare, explain, sweep
    from toolkit.datasets import load_sequence
    from toolkit.datasets.own_tables import save
    from toolkit.settings import Settings

    __version__: str

_HOME = {
    "toolkit.api": ("ExplainResult", "Result", "SweepResult", "compare", "explain", "sweep"),
    "toolkit.settings": ("Settings",),
    "toolkit.datasets": ("load_sequence",),
    "toolkit.datasets.own_tables": ("save",),
}
__all__ = ["ExplainResult", "Result", "Settings", "SweepResult", "compare", "explain", "load_sequence", "save", "sweep"]


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from importlib.metadata import version

        return version("vislam-toolkit")
    home = next((module for module, names in _HOME.items() if name in names), None)
    if home is None:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib import import_module

    return getattr(import_module(home), name)


def __dir__() -> list[str]:
    return [*globals(), *__all__]
