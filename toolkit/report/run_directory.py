"""The run directory: everything one comparison leaves behind, written at once or not at all."""

import json
from dataclasses import dataclass
from pathlib import Path

import msgspec

from toolkit.estimate import Trajectory
from toolkit.experiment.comparison import Comparison
from toolkit.experiment.configuration import Configuration, as_manifest
from toolkit.experiment.units import Outcome
from toolkit.files import check_replaceable, replaced_directory
from toolkit.report import manifest, metrics_json, report_json, seeds_json, seeds_report_json
from toolkit.report.figures import drawn, over_seeds, save
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
            _write_over_seeds(comparison, directory)
        else:
            _write_single(comparison, directory)
        told = manifest.build(comparison, made_by.command) | as_manifest(_of_one(made_by.asked, comparison))
        _write_text(directory / MANIFEST, json.dumps(told, indent=2) + "\n")


def _of_one(asked: Configuration, comparison: Comparison) -> Configuration:
    """Return what was asked for, of the one sequence and its estimators by name."""
    made_here = [outcome.estimator for outcome in comparison.outcomes if not _is_reference(outcome)]
    request = msgspec.structs.replace(
        asked.request, sequences=(comparison.source,), estimators=tuple(dict.fromkeys(made_here))
    )
    return Configuration(request, asked.settings)


def _is_reference(outcome: Outcome) -> bool:
    return outcome.run is not None and outcome.run.timings is None


def _write_single(comparison: Comparison, directory: Path) -> None:
    _write_text(directory / "metrics.json", metrics_json.to_text(metrics_json.build(comparison)))
    _write_text(directory / REPORT, json.dumps(report_json.build(comparison), allow_nan=False) + "\n")
    _write_trajectories(comparison, directory)
    (directory / "figures").mkdir()
    captions = save(drawn(comparison), directory / "figures")
    _write_text(directory / "report.md", report_text(comparison, captions))


def _write_over_seeds(comparison: Comparison, directory: Path) -> None:
    _write_text(directory / "seeds.json", metrics_json.to_text(seeds_json.build(comparison)))
    _write_text(directory / REPORT, json.dumps(seeds_report_json.build(comparison), allow_nan=False) + "\n")
    (directory / "figures").mkdir()
    captions = save(over_seeds.draw(comparison), directory / "figures")
    _write_text(directory / "report.md", report_text(comparison, captions))


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
