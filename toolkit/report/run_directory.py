"""The run directory: everything one comparison leaves behind, written at once or not at all."""

from pathlib import Path

from toolkit.documents import schema_name, to_line, to_text, told_schema
from toolkit.estimate import Trajectory
from toolkit.experiment.monte_carlo import OverSeeds
from toolkit.files import check_replaceable, replaced_directory
from toolkit.report import report_json
from toolkit.report.comparison import Comparison
from toolkit.report.figures import over_seeds as seeds_figures
from toolkit.report.figures import save, write_figures
from toolkit.report.figures.alignment import truth_during
from toolkit.report.manifest import manifest_document, seeds_manifest_document
from toolkit.report.records import Manifest
from toolkit.report.report_md import report_text
from toolkit.report.scores_json import metrics_document, seeds_document
from toolkit.report.seeds_md import seeds_report
from toolkit.report.trajectory_files import write_landmarks, write_tum
from toolkit.sequence import Sequence

METRICS, SEEDS = "metrics.json", "seeds.json"
REPORT, MANIFEST = "report.json", "manifest.json"


def check_run_directory(target: Path) -> None:
    """Raise OutputError unless a run directory can be written at ``target``."""
    check_replaceable(target, is_run_directory)


def is_run_directory(directory: Path) -> bool:
    """Say whether a directory holds a manifest of ours; many programs write a file of that name."""
    return told_schema(directory / MANIFEST) == schema_name(Manifest)


def write_run(comparison: Comparison, target: Path, *, command: str, seed: int) -> None:
    """Write the run directory of a comparison, in the place of an earlier one if there is one.

    Raises OutputError where ``target`` cannot be written or holds something else; nothing is left behind then.
    """
    with replaced_directory(target, is_run_directory) as directory:
        _write_text(directory / METRICS, to_text(metrics_document(comparison)))
        _write_text(directory / REPORT, to_line(report_json.report_document(comparison)))
        _write_trajectories(comparison, directory)
        figures = directory / "figures"
        figures.mkdir()
        captions = write_figures(comparison, figures)
        _write_text(directory / "report.md", report_text(comparison, captions))
        _write_text(directory / MANIFEST, to_text(manifest_document(comparison, command, seed)))


def write_over_seeds(over: OverSeeds, first: Sequence, target: Path, *, command: str) -> None:
    """Write the run directory of a comparison over seeds; ``first`` is the recording of the first seed.

    Raises as :func:`write_run` does.
    """
    with replaced_directory(target, is_run_directory) as directory:
        _write_text(directory / SEEDS, to_text(seeds_document(over)))
        _write_text(directory / REPORT, to_line(report_json.seeds_report_document(over)))
        figures = directory / "figures"
        figures.mkdir()
        captions = save(seeds_figures.draw(over), figures)
        _write_text(directory / "report.md", seeds_report(over, captions))
        _write_text(directory / MANIFEST, to_text(seeds_manifest_document(over, first, command)))


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
