"""A run directory is complete or not there, and never takes the place of somebody else's files."""

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from toolkit.errors import OutputError
from toolkit.experiment.comparison import Comparison
from toolkit.files.writing import check_replaceable
from toolkit.report import figures, run_directory
from toolkit.report.records import read_manifest, read_metrics
from toolkit.report.run_directory import MadeBy, write_run, written_by_us
from toolkit.report.scores import metrics_document

# Where it does not matter what is in the files of figures.
unrendered = pytest.mark.usefixtures("unrendered")


def write(comparison: Comparison, target: Path) -> None:
    write_run(comparison, target, MadeBy("vislam compare"))


def test_everything_is_there(comparison: Comparison, tmp_path: Path) -> None:
    target = tmp_path / "runs" / "one"
    write(comparison, target)
    files = {str(path.relative_to(target)) for path in target.rglob("*") if path.is_file()}
    assert {"metrics.json", "report.md", "manifest.json"} <= files
    assert {f"trajectories/{name}.tum" for name in ("steady_causal", "steady_final", "late_final")} <= files
    assert "trajectories/late_causal.tum" not in files
    given = [(row, trajectory) for row in comparison.rows if (trajectory := row.run.trajectory(row.output)) is not None]
    stated = [row for row, trajectory in given if trajectory.cov is not None and not row.repeats_causal]
    assert {name for name in files if "states/" in name} == {f"states/{r.estimator}_{r.output}.txt" for r in stated}
    assert {f"landmarks/{run.estimator}.csv" for run in comparison.runs} <= files
    drawn = ("top_all", "errors_over_time")
    assert {f"figures/{name}.png" for name in drawn} == {name for name in files if name.startswith("figures/")}
    assert read_metrics(target / "metrics.json") == metrics_document(comparison)
    for run in comparison.runs[:3]:
        landmarks = np.loadtxt(target / f"landmarks/{run.estimator}.csv", delimiter=",", skiprows=1)
        np.testing.assert_array_equal(landmarks[:, 0], run.landmarks.track_ids)
        np.testing.assert_allclose(landmarks[:, 1:], run.landmarks.points_world, rtol=1e-14)
    manifest = read_manifest(target / "manifest.json")
    assert (manifest.command, manifest.sequence.hash) == ("vislam compare", comparison.sequence.content_hash())
    assert all(manifest.versions[name] for name in ("toolkit", "python", "numpy", "gtsam", "opencv", "scipy"))
    assert manifest.compare.estimators == ("steady", "astray", "late", "broken")
    report = (target / "report.md").read_text()
    assert all(f"(figures/{name}.png)" in report for name in drawn)


@pytest.mark.parametrize("error", [KeyboardInterrupt(), OSError(28, "No space left on device")])
def test_a_failure_while_writing_leaves_nothing(
    comparison: Comparison, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: BaseException
) -> None:
    def fail(*_: object) -> None:
        raise error

    monkeypatch.setattr(figures, "drawn", fail)
    with pytest.raises((KeyboardInterrupt, OutputError)):
        write(comparison, tmp_path / "run")
    assert list(tmp_path.iterdir()) == []


@unrendered
def test_an_earlier_run_is_replaced_with_all_its_files(comparison: Comparison, tmp_path: Path) -> None:
    target = tmp_path / "run"
    write(comparison, target)
    first = {path.relative_to(target) for path in target.rglob("*")}
    # Another page than that of this run stands for one of it, and it has files that the next run has not.
    (target / "report.html").write_text("<title>drive - vislam report</title>")
    (target / "trajectories" / "truth.tum").rename(target / "trajectories" / "gone_final.tum")
    manifest = json.loads((target / "manifest.json").read_text())
    manifest["files"].append("trajectories/gone_final.tum")
    (target / "manifest.json").write_text(json.dumps(manifest))
    write(comparison, target)
    assert {path.relative_to(target) for path in target.rglob("*")} == first
    assert [path.name for path in tmp_path.iterdir()] == ["run"]


@pytest.mark.parametrize(
    "name", ["notes.txt", "figures/top_view.png", "raw/imu.csv", "trajectories/other.tum", "report.html", "report.md"]
)
@unrendered
def test_a_file_of_the_users_own_in_a_run_directory_is_never_lost(
    comparison: Comparison, tmp_path: Path, name: str
) -> None:
    target = tmp_path / "run"
    write(comparison, target)
    check_replaceable(target, written_by_us)
    (target / name).parent.mkdir(exist_ok=True)
    if name == "report.md":  # a link in the place of a file of ours
        (target / name).replace(tmp_path.parent / "mine.md")
        (target / name).symlink_to(tmp_path.parent / "mine.md")
    (target / name).write_text("years of work")
    first = name.partition("/")[0] if name.startswith("raw") else name
    with pytest.raises(OutputError, match=f"holds other files, as {re.escape(first)},"):
        check_replaceable(target, written_by_us)
    with pytest.raises(OutputError, match="would be lost"):
        write(comparison, target)
    assert (target / name).read_text() == "years of work"
    assert [path.name for path in tmp_path.iterdir()] == ["run"]


@pytest.mark.parametrize("name", ["thesis.tex", "manifest.json"])
def test_what_is_not_ours_is_refused(tmp_path: Path, name: str) -> None:
    file = tmp_path / "mine" / name
    file.parent.mkdir()
    file.write_text("{}")
    for target in (file.parent, file, file / "run"):
        with pytest.raises(OutputError):
            check_replaceable(target, written_by_us)
    assert file.read_text() == "{}"


@unrendered
@pytest.mark.parametrize("meanwhile", ["an interrupt between the renames", "a file of the user's own"])
def test_an_earlier_run_stays_where_the_next_cannot_take_its_place(
    comparison: Comparison, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, meanwhile: str
) -> None:
    target = tmp_path / "run"
    write(comparison, target)
    rename, report_text = Path.rename, run_directory.report_text

    def interrupted(self: Path, other: Path) -> Path:
        if ".partial-" in self.name:
            raise KeyboardInterrupt
        return rename(self, other)

    def writes_another(*given: Any) -> str:
        (target / "notes.txt").write_text("just now")
        return report_text(*given)

    if meanwhile == "a file of the user's own":
        monkeypatch.setattr(run_directory, "report_text", writes_another)
    else:
        monkeypatch.setattr(Path, "rename", interrupted)
    with pytest.raises((KeyboardInterrupt, OutputError), match=r"^$|notes\.txt"):
        write(comparison, target)
    assert (target / "notes.txt").is_file() == (meanwhile == "a file of the user's own")
    assert (target / "metrics.json").is_file()
    assert [path.name for path in tmp_path.iterdir()] == ["run"]
