"""Judge a run: every module here is one file of metrics, discovered by being here.

A metric file defines ``METRICS`` (key -> one line with the unit, in the order of a table), ``ORDER`` (where
its keys stand among those of other files) and ``score(evaluation) -> Scores``. What several files need lives in
:mod:`toolkit.metrics._shared`.
What each number means and what it is blind to: docs/metrics.md.
"""

import importlib
import pkgutil
from functools import cache
from typing import Protocol, cast

import numpy as np

from toolkit.estimate import Output, Run
from toolkit.metrics._shared.evaluation import Evaluation
from toolkit.metrics._shared.scores import Scores, Unavailable
from toolkit.sequence import Sequence

__all__ = ["Evaluation", "Scores", "describe", "score_run"]


class MetricFile(Protocol):
    """What a module of this package defines."""

    METRICS: dict[str, str]
    ORDER: int

    def score(self, evaluation: Evaluation) -> Scores:
        """Return a value, or None and the reason, for each key of METRICS.

        Raises Unavailable where none of them can be computed.
        """


@cache
def _metric_files() -> tuple[MetricFile, ...]:
    """Import every module of this package, in the order of their keys."""
    names = sorted(f"{__name__}.{m.name}" for m in pkgutil.iter_modules(__path__) if not m.ispkg)
    files = [cast(MetricFile, importlib.import_module(name)) for name in names]
    return tuple(sorted(files, key=lambda file: file.ORDER))


def describe() -> dict[str, str]:
    """Return every metric's key with its one-line description, unit included, in the order of a table."""
    return {key: line for file in _metric_files() for key, line in file.METRICS.items()}


def score_run(run: Run, output: Output, sequence: Sequence) -> Scores:
    """Score one output of a run against its sequence, with every key of :func:`describe`.

    A metric that cannot be computed, or is not finite, is None and has its reason in the notes. Raises
    ValueError where the run has no output of that kind; an error inside a metric is a defect and passes through.
    """
    evaluation = Evaluation(run, output, sequence)
    values: dict[str, float | None] = {}
    notes: dict[str, str] = {}
    with np.errstate(all="ignore"):  # a diverged run overflows; that ends as None with its reason, below
        for file in _metric_files():
            scores = _score_file(file, evaluation)
            if list(scores.values) != list(file.METRICS):
                raise ValueError(f"{file} scored {list(scores.values)}, it promises {list(file.METRICS)}")
            values |= scores.values
            notes |= scores.notes
    return Scores(values, notes)


def _score_file(file: MetricFile, evaluation: Evaluation) -> Scores:
    """Score one file; where it cannot be computed at all, each of its keys gets the reason."""
    try:
        return file.score(evaluation)
    except Unavailable as reason:
        return Scores(dict.fromkeys(file.METRICS), dict.fromkeys(file.METRICS, str(reason)))
