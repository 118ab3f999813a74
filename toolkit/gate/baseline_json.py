"""A baseline as JSON that people can read and review: the values of all seeds of a metric on one line."""

import json
from collections.abc import Mapping
from typing import Any

from toolkit.gate.baseline import Baseline, Bounds, Case, Criterion, Measured, Series

SCHEMA = "vislam.baseline/1"
Json = dict[str, Any]


def to_text(baseline: Baseline) -> str:
    """Return the document; refuses NaN and infinity, which are not JSON."""
    return _text(document(baseline), "") + "\n"


def document(baseline: Baseline) -> Json:
    """Return a baseline in terms of JSON."""
    return {
        "schema": SCHEMA,
        "made_by": dict(baseline.made_by),
        "releases": dict(baseline.releases),
        "false_alarm_rate": baseline.false_alarm_rate,
        "bounds": _bounds(baseline.bounds),
        "sequences": [_case(case, measured) for case, measured in baseline.cases],
    }


def _bounds(bounds: Bounds) -> Json:
    return {
        "simulated": {key: _criterion(criterion, "margin_percent") for key, criterion in bounds.simulated.items()},
        "recorded": {key: _criterion(criterion, "bound_percent") for key, criterion in bounds.recorded.items()},
        "coverage_points": bounds.coverage_points,
        "speed_ratio": bounds.speed_ratio,
    }


def _criterion(criterion: Criterion, name: str) -> Json:
    return {"worse": criterion.worse, name: criterion.percent}


def _case(case: Case, measured: Measured) -> Json:
    return {
        "source": case.source,
        "kind": "simulated" if case.simulated else "recorded",
        "duration_s": case.duration_s,
        "truth": case.truth,
        "seeds": list(case.seeds),
        "hashes": list(measured.hashes),
        "fingerprints": list(measured.fingerprints),
        "runs": {name: _series(series) for name, series in measured.runs.items()},
    }


def _series(series: Series) -> Json:
    outputs: Json = {output: {key: list(v) for key, v in by_key.items()} for output, by_key in series.outputs.items()}
    return {"status": list(series.status), "speed": list(series.speed), **outputs}


def _text(value: object, indent: str) -> str:
    """Return JSON in which a list of numbers or short words is one line, and of hashes a line each."""
    inner = indent + "  "
    if isinstance(value, Mapping):
        entries = [f"{json.dumps(key)}: {_text(entry, inner)}" for key, entry in value.items()]
        brackets = "{}"
    elif isinstance(value, list) and any(isinstance(entry, Mapping) or len(str(entry)) > 40 for entry in value):
        entries = [_text(entry, inner) for entry in value]
        brackets = "[]"
    else:
        return json.dumps(value, allow_nan=False)
    if not entries:
        return brackets
    return brackets[0] + "\n" + ",\n".join(inner + entry for entry in entries) + f"\n{indent}" + brackets[1]
