"""The one pipeline of every comparison: load, audit, start, run, score; one seed or many, here or on a cluster.

Reading order: recording (the data) -> units (one run of one estimator) -> workers, cluster (where units run) ->
outcome_store (results on disk, under a key that code_version is part of) -> references (estimates of other systems) ->
pipeline -> comparison (the result, with verdicts on stated uncertainty) -> contests (who wins, or that nobody does);
grid (many settings and planted faults at once) -> sweep (along axes), explanation (in what
estimators differ, and what each of these brings); statistics; disagreement (estimators that contradict the measured
motion). configuration: a comparison as a file. Names of the package are imported when first used, because its
statistics need neither estimators nor GTSAM.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from toolkit.experiment.comparison import Comparison, Record, Row
    from toolkit.experiment.pipeline import Plan, comparisons, prepared_cases, run, stores_of, workers_of

__all__ = ["Comparison", "Plan", "Record", "Row", "comparisons", "prepared_cases", "run", "stores_of", "workers_of"]

_OF_COMPARISON = ("Comparison", "Record", "Row")


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{'comparison' if name in _OF_COMPARISON else 'pipeline'}"), name)
