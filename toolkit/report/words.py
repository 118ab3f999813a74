"""What the numbers mean, in plain words: statuses, findings, metrics that are missing and why."""

from collections import Counter
from collections.abc import Iterator

from toolkit.audit import Finding
from toolkit.report.comparison import Comparison, Row
from toolkit.report.metrics_json import path_length_m
from toolkit.report.table import COLUMNS
from toolkit.sequence import Sequence

# An estimator that repairs something in every frame must not bury the rest; metrics.json has its whole log.
_LOG_ENTRIES = 4

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
    path = "no ground truth" if path_m is None else f"true path {path_m:.0f} m"
    motion = {"twist": "body twists", "imu": "raw IMU"}[sequence.motion_kind]
    return (
        f"{sequence.name}: {sequence.frame_count} frames, {sequence.duration_s:.1f} s, "
        f"{len(sequence.observations)} stereo observations, {motion}, {path}"
    )


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
    for run in comparison.runs:
        if run.status in _STATUS:
            yield f"{run.estimator} {_STATUS[run.status]}"
        for entry in run.log[:_LOG_ENTRIES]:
            yield f"{run.estimator}: {' '.join(entry.split())}"
        if len(run.log) > _LOG_ENTRIES:
            yield f"{run.estimator}: {len(run.log) - _LOG_ENTRIES} more entries are in the log in metrics.json"


def missing_lines(comparison: Comparison) -> Iterator[str]:
    """Yield, for each reason, the columns of the table that are empty for it, and whose where not everybody's.

    A run without any answer is explained by its status already and left out here.
    """
    rows = [row for row in comparison.rows if row.run.trajectory(row.output) is not None]
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
    """Yield what the metrics remark on values they did compute, each remark once for all it is about."""
    about: dict[str, list[str]] = {}
    for row in comparison.rows:
        for key, note in row.scores.notes.items():
            if row.scores.values.get(key) is not None:
                about.setdefault(note, []).append(f"{key} of {row.estimator} {row.output}")
    for note, keys in about.items():
        yield f"{', '.join(keys)}: {note}"
