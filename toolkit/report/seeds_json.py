"""The JSON contract ``vislam.seeds/1``: how it is built, and a validator for it (see docs/metrics-json.md)."""

import math
from collections.abc import Iterator
from dataclasses import fields

import numpy as np

from toolkit.experiment.comparison import Comparison, Row
from toolkit.experiment.statistics import Spread
from toolkit.metrics import describe
from toolkit.report.contract import object_violations, schema_violations
from toolkit.report.metrics_json import METRIC_KEYS, Json

SCHEMA = "vislam.seeds/1"
STATUSES = ("ok", "diverged", "failed")
_SPREAD_FIELDS = tuple(field.name for field in fields(Spread))
_FIELDS: dict[str, tuple[type, ...]] = {
    "sequence": (dict,),
    "seeds": (list,),
    "hashes": (list,),
    "start": (str,),
    "estimators": (list,),
    "runs": (list,),
    "log": (list,),
}
_RUN_FIELDS: dict[str, tuple[type, ...]] = {
    "estimator": (str,),
    "output": (str,),
    "status": (list,),
    "counts": (dict,),
    "metrics": (dict,),
    "notes": (dict,),
    "over_seeds": (dict,),
}


def build(over: Comparison) -> Json:
    """Return the document of a comparison over seeds."""
    return {
        "schema": SCHEMA,
        "sequence": {
            "name": over.name,
            "source": over.source,
            "frames": over.frames_s.size,
            "duration_s": float(over.frames_s[-1]),
            "motion": over.sequence.motion_kind,
        },
        "seeds": list(over.seeds),
        "hashes": list(over.hashes),
        "start": over.prior.source,
        "estimators": list(over.estimators),
        "runs": [_run(group, over) for group in over.rows],
        "log": [
            {"estimator": o.estimator, "seed": o.seed, "status": o.status, "log": list(o.log)}
            for o in over.outcomes
            if o.log
        ],
    }


def _run(group: Row, over: Comparison) -> Json:
    keys = (*METRIC_KEYS, *(key for key in describe() if key not in METRIC_KEYS))
    spreads = {key: group.spread(key) for key in keys}
    change = {"change": over.changes[group.estimator]} if group.estimator in over.changes else {}
    return {
        "estimator": group.estimator,
        "output": group.output,
        **change,
        "status": [outcome.status for outcome in group.outcomes],
        "counts": dict(group.counts),
        "metrics": {key: {**_spread(spread), "values": group.values(key)} for key, spread in spreads.items()},
        "notes": {key: group.reason(key) for key, spread in spreads.items() if spread is None},
        "over_seeds": _over_seeds(group),
    }


def _spread(spread: Spread | None) -> Json:
    if spread is None:
        return {name: 0 if name == "n" else None for name in _SPREAD_FIELDS}
    return {name: getattr(spread, name) for name in _SPREAD_FIELDS}


def _over_seeds(group: Row) -> Json:
    """Return the RMSE over frames and seeds, not aligned, and the NEES averaged over the seeds at each frame.

    The band is that of the largest number of runs any frame has.
    """
    nees, errors_m = group.mean_nees, group.position_m
    position = {"position_rmse_m": None if errors_m is None else float(np.sqrt(np.nanmean(errors_m**2)))}
    if nees is None:
        nothing = dict.fromkeys(("nees_pose_band", "nees_pose_in_band_percent", "nees_pose_above_percent"))
        return {**position, "runs": 0, **nothing}
    most = int(nees.runs.argmax())
    return {
        **position,
        "runs": int(nees.runs[most]),
        "nees_pose_band": [float(nees.low[most]), float(nees.high[most])],
        "nees_pose_in_band_percent": nees.in_band_percent,
        "nees_pose_above_percent": nees.too_sure_percent,
    }


def violations(document: object) -> list[str]:
    """Return everything in which a parsed document breaks the contract; empty for a valid one."""
    if not isinstance(document, dict):
        return ["the document is not an object"]
    found = list(schema_violations(document, SCHEMA))
    found += object_violations(document, "the document", _FIELDS)
    seeds, runs = document.get("seeds"), document.get("runs")
    if not isinstance(seeds, list) or not isinstance(runs, list):
        return found
    for i, run in enumerate(runs):
        found += _run_violations(run, f"runs[{i}]", len(seeds))
    return found


def _run_violations(run: object, where: str, seeds: int) -> Iterator[str]:
    broken = list(object_violations(run, where, _RUN_FIELDS))
    yield from broken
    if broken or not isinstance(run, dict):
        return
    if len(run["status"]) != seeds or not set(run["status"]) <= set(STATUSES):
        yield f"{where}.status is not one of {STATUSES} for each seed"
    if run["counts"] != {status: run["status"].count(status) for status in STATUSES}:
        yield f"{where}.counts does not count status"
    for key in METRIC_KEYS:
        if key not in run["metrics"]:
            yield f"{where}.metrics.{key} is missing"
    for key, metric in run["metrics"].items():
        yield from _metric_violations(metric, f"{where}.metrics.{key}", seeds)
        if isinstance(metric, dict) and metric.get("mean") is None and not run["notes"].get(key):
            yield f"{where}.metrics.{key} has no value and no note"


def _metric_violations(metric: object, where: str, seeds: int) -> Iterator[str]:
    if not isinstance(metric, dict) or not {*_SPREAD_FIELDS, "values"} <= metric.keys():
        yield f"{where} lacks one of {', '.join(_SPREAD_FIELDS)}, values"
        return
    values = metric["values"]
    if not isinstance(values, list) or len(values) != seeds:
        yield f"{where}.values does not have an entry a seed"
        return
    for value in (*values, *(metric[name] for name in _SPREAD_FIELDS)):
        if value is not None and (type(value) not in (int, float) or not math.isfinite(value)):
            yield f"{where} holds {value!r}, which is neither a finite number nor null"
