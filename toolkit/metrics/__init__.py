"""Scores a run. Every module in this folder is a metric file and is found without being listed.

A metric file defines ``METRICS`` (a :class:`Metric` record for each of its metrics, with its presentation in tables and
files), ``ORDER`` (its place among other files) and ``score(evaluation) -> Scores``. If its metrics belong to the causal
output alone, ``CAUSAL_ONLY`` says why. ``GROUP`` is a name for all of them where a table's columns are asked for.
``ON_REQUEST`` names the setting ``metrics.<name>`` without which metrics that take long are not computed. Read
:mod:`toolkit.metrics.parts.evaluation`, then ``ate``, then the others; docs/metrics.md defines each number.

A package of another distribution is found by the entry-point group ``toolkit.metrics`` under which it is announced.
"""

from collections.abc import Collection, Iterable
from dataclasses import dataclass
from functools import cache
from types import ModuleType

import numpy as np

from toolkit.answers import Output, Run
from toolkit.discovery import FoundModule, MissingDependency, announced, modules_in
from toolkit.errors import ExtensionError, UnknownNameError, did_you_mean
from toolkit.metrics.parts.evaluation import Evaluation as Evaluation
from toolkit.metrics.parts.scores import Metric as Metric
from toolkit.metrics.parts.scores import Scores as Scores
from toolkit.metrics.parts.scores import Unavailable as Unavailable
from toolkit.metrics.parts.scores import evaluate as evaluate
from toolkit.sequence import Sequence

ENTRY_POINT_GROUP = "toolkit.metrics"
# The keys that every ``vislam.metrics/1`` document has, whatever metrics were added since.
_CONTRACT = """
ate_none_m ate_se3_m ate_yaw_m ate_sim3_m ate_se3_deg rpe_1s_m rpe_1s_deg rpe_100m_percent kitti_t_percent
kitti_r_deg_per_m end_drift_percent reproj_median_px reproj_rmse_px heldout_reproj_median_px heldout_reproj_rmse_px
nis_mean nees_pose_mean nees_ori_mean nees_pos_mean nees_pose_in_band_percent coverage_percent pairs
frame_ms_mean frame_ms_p95 frame_ms_max total_s cpu_s peak_rss_mb
"""
CONTRACT_KEYS = tuple(_CONTRACT.split())
_ON_REQUEST = "computed on request"


@dataclass(frozen=True)
class _MetricFile:
    """What a metric file defines, and where it is."""

    module: ModuleType
    path: str
    metrics: tuple[Metric, ...]
    order: float
    causal_only: str
    group: str
    on_request: str

    @property
    def keys(self) -> list[str]:
        return [metric.key for metric in self.metrics]

    @classmethod
    def loaded(cls, found: FoundModule) -> "_MetricFile":
        """Import a metric file; raises ExtensionError if it does not define what a metric file must."""
        try:
            file = found.load()
        except ExtensionError as error:
            raise ExtensionError(f"{found.path}: {error}") from error
        metrics, order, score = (getattr(file, name, None) for name in ("METRICS", "ORDER", "score"))
        records = isinstance(metrics, tuple) and all(isinstance(metric, Metric) for metric in metrics)
        if not (records and isinstance(metrics, tuple) and isinstance(order, int | float) and callable(score)):
            raise ExtensionError(
                f"{found.path}: a metric file defines METRICS, a tuple of Metric records, ORDER, a number, and "
                "score(evaluation)"
            )
        others = (str(getattr(file, name, "")) for name in ("CAUSAL_ONLY", "GROUP", "ON_REQUEST"))
        return cls(file, str(found.path), metrics, order, *others)

    def scored(self, evaluation: Evaluation, requested: Collection[str]) -> Scores:
        """Score the file; where it cannot be computed at all, each of its keys gets the reason."""
        try:
            if self.on_request and self.on_request not in requested:
                raise Unavailable(_how_to_request(self.on_request))
            if evaluation.output != "causal" and self.causal_only:
                raise Unavailable(self.causal_only)
            scores = self.module.score(evaluation)
        except Unavailable as lacking:
            return Scores.none(self.keys, str(lacking))
        if not isinstance(scores, Scores) or list(scores.values) != self.keys:
            given = list(scores.values) if isinstance(scores, Scores) else type(scores).__name__
            raise ExtensionError(f"{self.path}: score must return Scores of {self.keys}, and returned {given}")
        return scores


@cache
def _found() -> tuple[tuple[_MetricFile, ...], dict[str, str]]:
    """Import every metric file of this package and of the announced ones.

    Return them by their ORDER, and for others by name why they cannot be used. Raises ExtensionError, naming the file,
    if one is no metric file or declares a key of another file.
    """
    files: list[_MetricFile] = []
    missing: dict[str, str] = {}
    own = sorted(modules_in(__name__, __path__), key=lambda module: module.module)
    for module in (*own, *announced(ENTRY_POINT_GROUP)):
        try:
            files.append(_MetricFile.loaded(module))
        except MissingDependency as dependency:
            missing[module.name] = str(dependency)
    keys = [key for file in files for key in file.keys]
    twice = sorted({key for key in keys if keys.count(key) > 1})
    if twice:
        here = [file.path for file in files if set(twice) & set(file.keys)]
        raise ExtensionError(f"{' and '.join(here)}: both declare {', '.join(twice)}; rename it in one of them")
    return tuple(sorted(files, key=lambda file: file.order)), missing


def _files() -> tuple[_MetricFile, ...]:
    return _found()[0]


def known_metrics() -> tuple[Metric, ...]:
    """Return every metric there is, in the order of tables and files."""
    return tuple(metric for file in _files() for metric in file.metrics)


def describe() -> dict[str, str]:
    """Return every metric's key with its one-line meaning, unit included, in the order of tables and files."""
    return {metric.key: metric.meaning for metric in known_metrics()}


def unavailable() -> dict[str, str]:
    """Return the metric files that cannot be imported here, by name, with the missing dependency."""
    return dict(_found()[1])


def metrics_called(names: Iterable[str]) -> tuple[Metric, ...]:
    """Return the metrics of the given keys, names, headings or groups ("ate_se3_m", "ATE SE(3)", "held-out", "bound").

    They come in the given order. Raises UnknownNameError for a name that no metric has, with the nearest one.
    """
    known = known_metrics()
    by_name: dict[str, tuple[Metric, ...]] = {metric.column: (metric,) for metric in known}
    by_name |= {metric.name: (metric,) for metric in known} | {metric.key: (metric,) for metric in known}
    by_name |= {file.group: file.metrics for file in _files() if file.group}
    chosen = tuple(names)
    for name in chosen:
        if name not in by_name:
            close = did_you_mean(name, by_name)
            lacking = "".join(f"; {file} is unavailable: {why}" for file, why in unavailable().items())
            raise UnknownNameError(
                f"no metric is called {name}{close}; 'vislam list metrics' names them all, by key{lacking}"
            )
    return tuple(metric for name in chosen for metric in by_name[name])


def requests_of(names: Iterable[str]) -> tuple[str, ...]:
    """Return the settings ``metrics.<name>`` without which the metrics of some keys or names are not computed."""
    selected = set(metrics_called(names))
    return tuple(sorted({file.on_request for file in _files() if selected.intersection(file.metrics)} - {""}))


def score_run(run: Run, output: Output, sequence: Sequence, requested: Collection[str] = ()) -> Scores:
    """Score one output of a run against its sequence, with every key of :func:`describe`.

    ``requested`` names the switches of metrics that are computed on request only. A metric that cannot be computed, or
    is not finite, is None and has its reason in the notes. Raises ValueError where the run has no output of that kind,
    ExtensionError where a file scores other keys than it declares; an error inside a metric is a defect and passes
    through.
    """
    return scores_of(Evaluation(run, output, sequence), requested)


def scores_of(evaluation: Evaluation, requested: Collection[str] = ()) -> Scores:
    """Score what is evaluated, as :func:`score_run` does; what the evaluation has computed already is used."""
    scores = Scores({})
    with np.errstate(all="ignore"):  # a diverged run may overflow; the value is then None with its reason
        for file in _files():
            scores |= file.scored(evaluation, requested)
    return scores


def repeated(causal: Scores) -> Scores:
    """Return the scores of a final output that equals the causal one: without metrics of causal outputs alone."""
    final = causal
    for file in _files():
        if file.causal_only:
            final = final.without(file.keys, file.causal_only)
    return final


def without_requests(scores: Scores, requested: Collection[str]) -> Scores:
    """Return the scores without metrics on request, except the ``requested`` ones."""
    for file in _files():
        if file.on_request and file.on_request not in requested:
            scores = scores.without(file.keys, _how_to_request(file.on_request))
    return scores


def is_on_request(reason: str) -> bool:
    return reason.startswith(_ON_REQUEST)


def _how_to_request(switch: str) -> str:
    return f"{_ON_REQUEST}: --set metrics.{switch}=true"
