"""``report.json`` of a comparison over seeds: what a report draws and says beyond seeds.json."""

import numpy as np

from toolkit.experiment.comparison import Comparison, Row
from toolkit.geometry import Array
from toolkit.report.contract import field_violations, schema_violations
from toolkit.report.messages import consistency_lines, header_lines, note_lines
from toolkit.report.metrics_json import Json
from toolkit.report.report_json import SCHEMA, numbers

_FIELDS: dict[str, tuple[type, ...]] = {"t_s": (list,), "runs": (list,), "words": (dict,)}


def build(over: Comparison) -> Json:
    """Return the document; its ``runs`` are those of seeds.json, each with series over the frames' ``t_s``."""
    return {
        "schema": SCHEMA,
        "t_s": numbers(over.frames_s),
        "runs": [_run(group) for group in over.rows],
        "words": {
            "sequence": "; ".join(header_lines(over)),
            "notes": list(note_lines(over)),
            "verdicts": list(consistency_lines(over)),
            "start": over.prior.source,
        },
    }


def _run(group: Row) -> Json:
    """Return the NEES averaged over the seeds with its band, and the position error over the seeds, or None each."""
    nees, errors_m = group.mean_nees, group.position_m
    return {
        "estimator": group.estimator,
        "output": group.output,
        "nees": None
        if nees is None
        else {"pose": numbers(nees.mean), "low": numbers(nees.low), "high": numbers(nees.high)},
        "position_rms_m": None if errors_m is None else numbers(_rms_over_runs(errors_m)),
    }


def _rms_over_runs(errors: Array) -> Array:
    """Return the root mean square (K,) over runs of errors (runs, K), NaN where no run has one."""
    known = np.isfinite(errors)
    total, count = np.where(known, errors, 0.0) ** 2, known.sum(axis=0)
    return np.where(count > 0, np.sqrt(total.sum(axis=0) / np.maximum(count, 1)), np.nan)


def violations(document: object) -> list[str]:
    """Return everything in which a parsed document breaks the contract; empty for a valid one."""
    if not isinstance(document, dict):
        return ["the document is not an object"]
    return [*schema_violations(document, SCHEMA), *field_violations(document, _FIELDS)]
