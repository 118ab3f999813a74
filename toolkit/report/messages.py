"""What the numbers mean, in plain words: statuses, findings, metrics that are missing and why."""

from collections import Counter
from collections.abc import Callable, Iterator

from toolkit.audit import Finding
from toolkit.report.comparison import Comparison, Row
from toolkit.report.scores_json import path_length_m
from toolkit.report.table import COLUMNS
from toolkit.sequence import Sequence

# An estimator that repairs something in every frame must not bury the rest; metrics.json has its whole log.
_LOG_ENTRIES = 4

# Remarks on these are told beside the table, the others at the end of the report only.
_AGAINST_TRUTH = "ate_"
_BLIND = "the recording has no image features: every estimator can only integrate the measured motion"
_STATUS = {
    "diverged": (
        "diverged: it ran to the end, but its answers left what is physically plausible. That is a result, not a "
        "crash: its scores are those of the whole trajectory, and its figure shows where it went."
    ),
    "failed": "failed: it could not go on. What it had said until then, if anything, is kept and scored.",
}


def sequence_line(sequence: Sequence) -> str:
    """Return the recording in one line: size, duration, true path, motion."""
    path_m = path_length_m(sequence)
    sightings = (
        f"{len(sequence.observations)} stereo observations" if len(sequence.observations) else "no image features"
    )
    path = "no ground truth" if path_m is None else f"true path {path_m:.0f} m"
    motion = {"twist": "body twists", "imu": "raw IMU"}[sequence.motion_kind]
    return f"{sequence.name}: {sequence.frame_count} frames, {sequence.duration_s:.1f} s, {sightings}, {motion}, {path}"


def finding_lines(comparison: Comparison) -> Iterator[str]:
    """Yield a line a finding of the audit, or the good news that there is none."""
    if not comparison.findings:
        yield "no fault found in the recording"
    for finding in comparison.findings:
        yield f"{finding.fault} ({outcome(finding)}): {finding.detail}"


def outcome(finding: Finding) -> str:
    """Say in one or two words what became of a finding."""
    if finding.repaired:
        return "repaired"
    return "not repaired" if finding.blocking else "for information"


def status_lines(comparison: Comparison) -> Iterator[str]:
    """Yield a calm explanation of every run that did not end well, and what each run had to say on the way."""
    if not len(comparison.sequence.observations):
        yield _BLIND
    for run in comparison.runs:
        if run.status in _STATUS:
            yield f"{run.estimator} {_STATUS[run.status]}"
        for entry in run.log[:_LOG_ENTRIES]:
            yield f"{run.estimator}: {' '.join(entry.split())}"
        if len(run.log) > _LOG_ENTRIES:
            yield f"{run.estimator}: {len(run.log) - _LOG_ENTRIES} more entries are in the log in metrics.json"


def truth_lines(comparison: Comparison) -> Iterator[str]:
    """Yield what must be known before an error against the truth is believed."""
    return _remarks(comparison, lambda key: key.startswith(_AGAINST_TRUTH))


def missing_lines(comparison: Comparison) -> Iterator[str]:
    """Yield, for each reason, the columns of the table that are empty for it, and whose where not everybody's.

    A run without any answer is explained by its status already and left out here.
    """
    rows = [row for row in comparison.lines if row.run.trajectory(row.output) is not None]
    empty: dict[tuple[str, str], list[str]] = {}
    for column in COLUMNS:
        by_reason: dict[str, list[Row]] = {}
        for row in rows:
            if row.scores.values.get(column.key) is None:
                by_reason.setdefault(row.scores.notes.get(column.key, "not computed"), []).append(row)
        for reason, affected in by_reason.items():
            empty.setdefault((_whose(affected, rows), reason), []).append(column.name)
    for (whose, reason), names in empty.items():
        yield f"no {', '.join(names)}{whose}: {reason}"


def _whose(affected: list[Row], rows: list[Row]) -> str:
    """Name the rows affected: nobody where it is all, the estimator alone where it is all of its outputs."""
    if len(affected) == len(rows):
        return ""
    of_all, of_affected = Counter(row.estimator for row in rows), Counter(row.estimator for row in affected)
    names = (
        row.estimator if of_affected[row.estimator] == of_all[row.estimator] else f"{row.estimator} {row.output}"
        for row in affected
    )
    return f" for {', '.join(dict.fromkeys(names))}"


def remark_lines(comparison: Comparison) -> Iterator[str]:
    """Yield what the metrics remark on the values they did compute, without what :func:`truth_lines` says."""
    return _remarks(comparison, lambda key: not key.startswith(_AGAINST_TRUTH))


def _remarks(comparison: Comparison, wanted: Callable[[str], bool]) -> Iterator[str]:
    """Yield each remark once, behind the metrics and the rows it is about."""
    rows = [row for row in comparison.lines if row.run.trajectory(row.output) is not None]
    noted: dict[str, dict[str, list[Row]]] = {}
    for row in rows:
        for key, note in row.scores.notes.items():
            if wanted(key) and row.scores.values.get(key) is not None:
                noted.setdefault(note, {}).setdefault(key, []).append(row)
    for note, rows_of in noted.items():
        keys_of: dict[str, list[str]] = {}
        for key, affected in rows_of.items():
            keys_of.setdefault(_whose(affected, rows), []).append(key)
        about = "; ".join(f"{', '.join(keys)}{whose}" for whose, keys in keys_of.items())
        yield f"{about}: {note}"
