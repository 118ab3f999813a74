"""The run directory: everything one comparison leaves behind, written at once or not at all."""

from dataclasses import dataclass
from pathlib import Path

from toolkit.documents import schema_name, to_line, to_text, told_schema
from toolkit.estimate import Trajectory
from toolkit.experiment.comparison import Comparison
from toolkit.experiment.configuration import Configuration
from toolkit.files import check_replaceable, replaced_directory
from toolkit.report import report_json
from toolkit.report.figures import drawn, save
from toolkit.report.figures.alignment import truth_during
from toolkit.report.manifest import manifest_document
from toolkit.report.records import Manifest
from toolkit.report.report_md import report_text
from toolkit.report.scores_json import metrics_document, seeds_document
from toolkit.report.trajectory_files import write_landmarks, write_tum

METRICS, SEEDS = "metrics.json", "seeds.json"
REPORT, MANIFEST = "report.json", "manifest.json"


def check_run_directory(target: Path) -> None:
    """Raise OutputError unless a run directory can be written at ``target``."""
    check_replaceable(target, is_run_directory)


def is_run_directory(directory: Path) -> bool:
    """Say whether a directory holds a manifest of ours; many programs write a file of that name."""
    return told_schema(directory / MANIFEST) == schema_name(Manifest)


@dataclass(frozen=True)
class MadeBy:
    """The command line that made a comparison, and what it came to: what to compare, with which settings."""

    command: str
    asked: Configuration


def write_run(comparison: Comparison, target: Path, made_by: MadeBy) -> None:
    """Write the run directory of a comparison, in the place of an earlier one if there is one.

    Raises OutputError where ``target`` cannot be written or holds something else; nothing is left behind then.
    """
    with replaced_directory(target, is_run_directory) as directory:
        if comparison.over_seeds:
            _write_text(directory / SEEDS, to_text(seeds_document(comparison)))
            _write_text(directory / REPORT, to_line(report_json.seeds_report_document(comparison)))
        else:
            _write_text(directory / METRICS, to_text(metrics_document(comparison)))
            _write_text(directory / REPORT, to_line(report_json.report_document(comparison)))
            _write_trajectories(comparison, directory)
        (directory / "figures").mkdir()
        captions = save(drawn(comparison), directory / "figures")
        _write_text(directory / "report.md", report_text(comparison, captions))
        _write_text(directory / MANIFEST, to_text(manifest_document(comparison, made_by.command, made_by.asked)))


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
