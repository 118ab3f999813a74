"""What the numbers mean, in plain words: statuses, findings, metrics that are missing and why."""

from collections.abc import Iterator

from toolkit.audit import Finding
from toolkit.report.comparison import Comparison
from toolkit.report.metrics_json import path_length_m
from toolkit.report.table import COLUMNS
from toolkit.sequence import Sequence

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
        for entry in run.log:
            yield f"{run.estimator}: {entry}"


def missing_lines(comparison: Comparison) -> Iterator[str]:
    """Yield, for each reason, the columns of the table that are empty for it, and whose where not everybody's.

    A run without any answer is explained by its status already and left out here.
    """
    rows = [row for row in comparison.rows if row.run.trajectory(row.output) is not None]
    empty: dict[str, dict[tuple[str, ...], list[str]]] = {}
    for column in COLUMNS:
        by_reason: dict[str, list[str]] = {}
        for row in rows:
            if row.scores.values.get(column.key) is None:
                reason = row.scores.notes.get(column.key, "not computed")
                by_reason.setdefault(reason, []).append(f"{row.estimator} {row.output}")
        for reason, whose in by_reason.items():
            empty.setdefault(reason, {}).setdefault(tuple(whose), []).append(column.name)
    for reason, groups in empty.items():
        for affected, names in groups.items():
            of_whom = "" if len(affected) == len(rows) else f" for {', '.join(affected)}"
            yield f"no {', '.join(names)}{of_whom}: {reason}"


def remark_lines(comparison: Comparison) -> Iterator[str]:
    """Yield what the metrics remark on values they did compute, each remark once for all it is about."""
    about: dict[str, list[str]] = {}
    for row in comparison.rows:
        for key, note in row.scores.notes.items():
            if row.scores.values.get(key) is not None:
                about.setdefault(note, []).append(f"{key} of {row.estimator} {row.output}")
    for note, keys in about.items():
        yield f"{', '.join(keys)}: {note}"
