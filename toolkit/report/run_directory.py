"""The run directory: everything one comparison leaves behind, written at once or not at all."""

import json
from pathlib import Path

from toolkit.estimate import Trajectory
from toolkit.files import check_replaceable, replaced_directory
from toolkit.report import manifest, metrics_json, report_json
from toolkit.report.comparison import Comparison
from toolkit.report.figures import write_figures
from toolkit.report.figures.alignment import truth_during
from toolkit.report.report_md import report_text
from toolkit.report.trajectory_files import write_landmarks, write_tum

MANIFEST = "manifest.json"
REPORT = "report.json"


def check_run_directory(target: Path) -> None:
    """Raise OutputError unless a run directory can be written at ``target``."""
    check_replaceable(target, is_run_directory)


def is_run_directory(directory: Path) -> bool:
    """Say whether a directory holds a manifest of ours; many programs write a file of that name."""
    try:
        told = json.loads((directory / MANIFEST).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return False
    return isinstance(told, dict) and told.get("schema") == manifest.SCHEMA


def write_run(comparison: Comparison, target: Path, *, command: str, seed: int) -> None:
    """Write the run directory of a comparison, in the place of an earlier one if there is one.

    Raises OutputError where ``target`` cannot be written or holds something else; nothing is left behind then.
    """
    with replaced_directory(target, is_run_directory) as directory:
        _write_text(directory / "metrics.json", metrics_json.to_text(metrics_json.build(comparison)))
        _write_text(directory / REPORT, json.dumps(report_json.build(comparison), allow_nan=False) + "\n")
        _write_trajectories(comparison, directory)
        figures = directory / "figures"
        figures.mkdir()
        captions = write_figures(comparison, figures)
        _write_text(directory / "report.md", report_text(comparison, captions))
        told = manifest.build(comparison, command, seed)
        _write_text(directory / MANIFEST, json.dumps(told, indent=2) + "\n")


def _write_trajectories(comparison: Comparison, directory: Path) -> None:
    for folder in ("trajectories", "landmarks"):
        (directory / folder).mkdir()
    truth = truth_during(comparison.sequence)
    if truth is not None:
        write_tum(Trajectory(truth.t_ns, truth.T_world_imu), directory / report_json.TRUTH_FILE)
    for row in comparison.rows:
        trajectory = row.run.trajectory(row.output)
        if trajectory is not None:
            write_tum(trajectory, directory / report_json.trajectory_file(row.estimator, row.output))
    for run in comparison.runs:
        write_landmarks(run.landmarks, directory / report_json.landmarks_file(run.estimator))


def _write_text(path: Path, text: str) -> None:
    path.write_text(text, encoding="utf-8")
