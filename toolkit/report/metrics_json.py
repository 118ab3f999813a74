"""The JSON contract ``vislam.metrics/1``: how it is built, and a validator for it (see docs/metrics-json.md)."""

import json
import math
from collections.abc import Iterator

import numpy as np

from toolkit.experiment.comparison import Comparison, Row
from toolkit.metrics import contract_keys, known_metrics
from toolkit.report.contract import object_violations, schema_violations
from toolkit.sequence import Sequence

SCHEMA = "vislam.metrics/1"

# Every run of a valid document has these keys, in this order; more may follow in later versions of the toolkit.
METRIC_KEYS = contract_keys()

Json = dict[str, object]
_NUMBER = (int, float)
_SEQUENCE_FIELDS: dict[str, tuple[type, ...]] = {
    "name": (str,),
    "hash": (str,),
    "frames": (int,),
    "tracks": (int,),
    "observations": (int,),
    "duration_s": _NUMBER,
    "path_m": (*_NUMBER, type(None)),
    "motion": (str,),
}
_FINDING_FIELDS: dict[str, tuple[type, ...]] = {"fault": (str,), "count": (int,), "repaired": (bool,), "detail": (str,)}
_RUN_FIELDS: dict[str, tuple[type, ...]] = {
    "estimator": (str,),
    "output": (str,),
    "status": (str,),
    "metrics": (dict,),
    "notes": (dict,),
    "log": (list,),
}
_CHOICES = {"motion": ("twist", "imu"), "output": ("causal", "final"), "status": ("ok", "diverged", "failed")}


def build(comparison: Comparison) -> Json:
    """Return the document of a comparison; a value that is not finite becomes null with a note."""
    return {
        "schema": SCHEMA,
        "sequence": _sequence(comparison.sequence),
        "audit": [
            {"fault": f.fault, "count": f.count, "repaired": f.repaired, "detail": f.detail}
            for f in comparison.findings
        ],
        "runs": [_run(row) for row in comparison.rows],
    }


def to_text(document: Json) -> str:
    """Return the document as indented JSON; refuses NaN and infinity, which are not JSON."""
    return json.dumps(document, indent=2, allow_nan=False) + "\n"


def path_length_m(sequence: Sequence) -> float | None:
    """Return the length of the true path while the camera ran, or None without truth."""
    if sequence.truth is None:
        return None
    t_ns = sequence.truth.t_ns
    during = (t_ns >= sequence.frames_t_ns[0]) & (t_ns <= sequence.frames_t_ns[-1])
    positions = sequence.truth.T_world_imu[during, :3, 3]
    return float(np.linalg.norm(np.diff(positions, axis=0), axis=1).sum())


def _sequence(sequence: Sequence) -> Json:
    return {
        "name": sequence.name,
        "hash": sequence.content_hash(),
        "frames": sequence.frame_count,
        "tracks": int(np.unique(sequence.observations.track_id).size),
        "observations": len(sequence.observations),
        "duration_s": sequence.duration_s,
        "path_m": path_length_m(sequence),
        "motion": sequence.motion_kind,
    }


def _run(row: Row) -> Json:
    given, notes = row.scores.values, dict(row.scores.notes)
    counts = {metric.key for metric in known_metrics() if metric.count}
    metrics: dict[str, float | None] = {}
    for key in (*METRIC_KEYS, *(key for key in given if key not in METRIC_KEYS)):
        value = given.get(key)
        if value is None:
            metrics[key] = None
            notes.setdefault(key, "not computed")
        elif not math.isfinite(value):
            metrics[key] = None
            notes[key] = f"the value is {value}, which JSON cannot hold"
        else:
            metrics[key] = int(value) if key in counts else float(value)
    return {
        "estimator": row.estimator,
        "output": row.output,
        "status": row.status,
        "metrics": metrics,
        "notes": {key: notes[key] for key in sorted(notes)},
        "log": list(row.run.log),
    }


def violations(document: object) -> list[str]:
    """Return everything in which a parsed document breaks the contract; empty for a valid one."""
    if not isinstance(document, dict):
        return ["the document is not an object"]
    found = list(schema_violations(document, SCHEMA))
    found += object_violations(document.get("sequence"), "sequence", _SEQUENCE_FIELDS, _CHOICES)
    for name, item_fields in (("audit", _FINDING_FIELDS), ("runs", _RUN_FIELDS)):
        items = document.get(name)
        if not isinstance(items, list):
            found.append(f"{name} is not a list")
            continue
        for i, item in enumerate(items):
            found += object_violations(item, f"{name}[{i}]", item_fields, _CHOICES)
            if name == "runs" and isinstance(item, dict):
                found += _metric_violations(item, f"runs[{i}]")
    return found


def _metric_violations(run: Json, where: str) -> Iterator[str]:
    metrics, notes = run.get("metrics"), run.get("notes")
    if not isinstance(metrics, dict) or not isinstance(notes, dict):
        return
    for key in METRIC_KEYS:
        if key not in metrics:
            yield f"{where}.metrics.{key} is missing"
    for key, value in metrics.items():
        if value is None and not notes.get(key):
            yield f"{where}.metrics.{key} is null without a note"
        elif value is not None and (type(value) not in _NUMBER or not math.isfinite(value)):
            yield f"{where}.metrics.{key} is neither a finite number nor null"
