"""The JSON contract ``vislam.report/1``: what a report draws and says beyond metrics.json (see docs/report.md)."""

import math
from collections.abc import Callable, Iterator

import numpy as np

from toolkit.estimate import Output, Run
from toolkit.experiment.comparison import Comparison, Row, plain_name
from toolkit.geometry import Array, IntArray
from toolkit.metrics import Evaluation
from toolkit.metrics._shared.consistency import POSE_DOF, nees_band, nees_over_time
from toolkit.metrics._shared.scores import Unavailable
from toolkit.report.contract import object_violations, schema_violations
from toolkit.report.figures.alignment import Errors, alignment_words, onto_truth, truth_during
from toolkit.report.figures.errors_over_time import ErrorCurves, error_curves
from toolkit.report.figures.top_view import last_word
from toolkit.report.messages import note_lines, outcome, remark_lines, sequence_line
from toolkit.report.metrics_json import Json
from toolkit.resampling import NS_PER_S

SCHEMA = "vislam.report/1"
TRUTH_FILE = "trajectories/truth.tum"

_SIGNIFICANT_DIGITS = 6
_MICROSECONDS = 6
_FIELDS: dict[str, tuple[type, ...]] = {
    "start_ns": (int,),
    "truth": (str, type(None)),
    "alignment": (str,),
    "error": (dict, type(None)),
    "runs": (list,),
    "steps": (list,),
    "maps": (list,),
    "words": (dict,),
}
_RUN_FIELDS: dict[str, tuple[type, ...]] = {
    "estimator": (str,),
    "output": (str,),
    "repeats_causal": (bool,),
    "trajectory": (str, type(None)),
    "rotation": (list,),
    "translation_m": (list,),
    "errors": (dict, type(None)),
    "nees": (dict, str),
    "nis": (dict, str),
}


def trajectory_file(estimator: str, output: Output) -> str:
    """Return where in a run directory the trajectory of an estimator's output is."""
    return f"trajectories/{plain_name(estimator)}_{output}.tum"


def landmarks_file(estimator: str) -> str:
    """Return where in a run directory the landmarks of an estimator are."""
    return f"landmarks/{plain_name(estimator)}.csv"


def build(comparison: Comparison) -> Json:
    """Return the document of a comparison; times count from the first frame, what is not finite becomes null."""
    curves = error_curves(comparison)
    start_ns = int(comparison.sequence.frames_t_ns[0])
    return {
        "schema": SCHEMA,
        "start_ns": start_ns,
        "truth": None if truth_during(comparison.sequence) is None else TRUTH_FILE,
        "alignment": alignment_words(comparison.sequence),
        "error": None if curves is None else {"what": curves.what, "caption": _error_caption(comparison, curves)},
        "runs": [_row(row, comparison, _curve_of(row, curves)) for row in comparison.rows],
        "steps": list(_steps(comparison)),
        "maps": [_map(run, comparison) for run in comparison.runs if len(run.landmarks)],
        "words": _words(comparison),
    }


def _error_caption(comparison: Comparison, curves: ErrorCurves) -> str:
    """Say how the errors are measured; with a truth the reader may choose what they are drawn over."""
    if comparison.sequence.truth is None:
        return curves.caption
    return f"{alignment_words(comparison.sequence)} Dashed: causal, what was known at the time. Solid: final."


def _curve_of(row: Row, curves: ErrorCurves | None) -> Errors | None:
    """Return a row's errors; where causal and final agree they were computed once and stand with the causal row."""
    output = "causal" if row.run.final_is_causal else row.output
    if curves is None or output != row.output:
        return None
    return next((errors for other, errors in curves.of_rows if _same_line(row, other)), None)


def _same_line(row: Row, other: Row) -> bool:
    return row.run is other.run and (row.run.final_is_causal or row.output == other.output)


def _words(comparison: Comparison) -> Json:
    return {
        "sequence": sequence_line(comparison.sequence),
        "notes": list(note_lines(comparison)),
        "remarks": list(remark_lines(comparison)),
        "start": comparison.prior.source,
        "audit": [
            {"fault": f.fault, "count": f.count, "outcome": outcome(f), "detail": f.detail} for f in comparison.findings
        ],
        "facts": list(comparison.sequence.provenance.facts),
        "changes": dict(comparison.changes),
    }


def _row(row: Row, comparison: Comparison, errors: Errors | None) -> Json:
    answered = row.run.trajectory(row.output) is not None
    alignment = onto_truth(row.run, row.output, comparison.sequence) if answered else None
    start_ns = int(comparison.sequence.frames_t_ns[0])
    return {
        "estimator": row.estimator,
        "output": row.output,
        "repeats_causal": row.output == "final" and row.run.final_is_causal,
        "trajectory": trajectory_file(row.estimator, row.output) if answered else None,
        "rotation": (np.eye(3) if alignment is None else alignment.rotation).tolist(),
        "translation_m": (np.zeros(3) if alignment is None else alignment.translation).tolist(),
        "errors": None if errors is None else _errors(errors, start_ns),
        "nees": _told_or_why(_nees, row, comparison),
        "nis": _told_or_why(_nis, row, comparison),
    }


def _errors(errors: Errors, start_ns: int) -> Json:
    return {
        "t_s": _seconds(errors.t_ns, start_ns),
        "path_m": numbers(errors.path_m),
        "position_m": numbers(errors.position_m),
        "heading_deg": numbers(errors.heading_deg),
    }


def _told_or_why(series: Callable[[Row, Comparison], Json], row: Row, comparison: Comparison) -> Json | str:
    """Return a series, or in words why there is none."""
    if row.run.trajectory(row.output) is None:
        return "the run gave no trajectory"
    try:
        with np.errstate(all="ignore"):  # a diverged run overflows; that becomes null
            return series(row, comparison)
    except Unavailable as reason:
        return str(reason)


def _nees(row: Row, comparison: Comparison) -> Json:
    nees = nees_over_time(Evaluation(row.run, row.output, comparison.sequence))
    return {
        "t_s": _seconds(nees.t_ns, int(comparison.sequence.frames_t_ns[0])),
        "pose": numbers(nees.pose),
        "orientation": numbers(nees.orientation),
        "position": numbers(nees.position),
        "band": list(nees_band(POSE_DOF)),
    }


def _nis(row: Row, comparison: Comparison) -> Json:
    """Return each step's NIS over its degrees of freedom with the two-sided 95 % band for as many."""
    causal, info = row.run.causal, row.run.info
    if row.output != "causal" or causal is None:
        raise Unavailable("innovations belong to the causal output")
    if not {"nis", "nis_dof"} <= info.keys():
        raise Unavailable("the estimator reports no innovations")
    nis, dof = info["nis"], info["nis_dof"]
    given = np.isfinite(nis) & np.isfinite(dof) & (dof > 0.0)
    if not given.any():
        raise Unavailable("no step reports an innovation")
    bands = {int(d): nees_band(int(d)) for d in np.unique(dof[given])}
    low, high = np.array([bands[int(d)] for d in dof[given]]).T
    return {
        "t_s": _seconds(causal.t_ns[given], int(comparison.sequence.frames_t_ns[0])),
        "per_dof": numbers(nis[given] / dof[given]),
        "low": numbers(low),
        "high": numbers(high),
    }


def _steps(comparison: Comparison) -> Iterator[Json]:
    frames_t_ns = comparison.sequence.frames_t_ns
    for run in comparison.runs:
        if run.timings is not None and run.timings.step_s.size:
            t_ns = frames_t_ns[: run.timings.step_s.size]
            yield {
                "estimator": run.estimator,
                "t_s": _seconds(t_ns, int(frames_t_ns[0])),
                "step_ms": numbers(1e3 * run.timings.step_s),
                "finish_s": number(run.timings.finish_s),
            }


def _map(run: Run, comparison: Comparison) -> Json:
    """Return where a run's landmarks are; they move with the run's last word onto the truth."""
    return {"estimator": run.estimator, "landmarks": landmarks_file(run.estimator), "output": last_word(run)}


def _seconds(t_ns: IntArray, start_ns: int) -> list[float]:
    return [round(t / NS_PER_S, _MICROSECONDS) for t in (t_ns - start_ns).tolist()]


def numbers(values: Array) -> list[float | None]:
    """Return values (N,) with six digits, None for what is not finite."""
    return [number(value) for value in values.tolist()]


def number(value: float) -> float | None:
    """Return a value with six digits, or None where it is not finite."""
    return float(f"{value:.{_SIGNIFICANT_DIGITS}g}") if math.isfinite(value) else None


def violations(document: object) -> list[str]:
    """Return everything in which a parsed document breaks the contract; empty for a valid one."""
    if not isinstance(document, dict):
        return ["the document is not an object"]
    found = list(schema_violations(document, SCHEMA))
    found += object_violations(document, "the document", _FIELDS)
    runs = document.get("runs")
    for i, run in enumerate(runs if isinstance(runs, list) else []):
        found += object_violations(run, f"runs[{i}]", _RUN_FIELDS)
    return found
