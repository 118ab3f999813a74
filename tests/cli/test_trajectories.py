"""``--trajectory`` and ``vislam export``: out of a run directory, back into a comparison, and nothing is lost."""

import json
import re
import shutil
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path

import numpy as np
import pytest

from tests.report.test_html_report import embedded
from toolkit.cli import main
from toolkit.datasets.trajectories import FORMATS, read_poses
from toolkit.report.records import read_metrics, read_report

WithoutPixels = Callable[[], AbstractContextManager[None]]
QUICK = ("compare", "drive", "--estimators", "dead-reckoning,ekf", "--max-frames", "20", "--workers", "1")
COVARIANCES = {"tum": "pos-rot/fixed", "euroc": "rot-pos/left", "openvins": "rot-pos/mixed"}


pytestmark = pytest.mark.usefixtures("unrendered")


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory, without_pixels: WithoutPixels) -> Path:
    """The run directory of two estimators on the first frames of a drive, and its exports beside it; not to change."""
    directory = tmp_path_factory.mktemp("exports") / "run"
    files = directory.parent
    with without_pixels():
        assert main([*QUICK, "--out", str(directory)]) == 0
    for name in FORMATS:
        words = ("--estimator", "ekf", "--format", name, "--out", str(directory.parent / f"ekf.{name}"))
        assert main(["export", str(directory), *words]) == 0
    for name, convention in COVARIANCES.items():
        words = ("--estimator", "ekf", "--format", name, "--out", str(files / f"cov.{name}"))
        assert main(["export", str(directory), *words, "--cov-convention", convention]) == 0
    said = (files / "cov.tum").read_text()
    (files / "unsaid.tum").write_text("".join(line for line in said.splitlines(True) if not line.startswith("#")))
    return directory


@pytest.fixture(scope="module")
def again(run: Path, without_pixels: WithoutPixels) -> Path:
    """The run directory of the same comparison with every export as another system, and one that flew off."""
    rows = [line.split() for line in (run.parent / "ekf.tum").read_text().splitlines() if not line.startswith("#")]
    astray = "".join(" ".join([t, str(i * i), *rest]) + "\n" for i, (t, _, *rest) in enumerate(rows))
    (run.parent / "astray.tum").write_text(astray)
    files = {**{f"by {name}": f"ekf.{name}" for name in FORMATS}, "astray": "astray.tum"}
    files |= {f"cov {name}": f"cov.{name}:causal" for name in COVARIANCES} | {"unsaid": "unsaid.tum"}
    words = [word for name, file in files.items() for word in ("--trajectory", f"{name}={run.parent / file}")]
    words += ["--cov-convention", COVARIANCES["tum"]]
    # What another system made of it is not checked as a run of ours is: the exit status is that of ours alone.
    with without_pixels():
        assert main([*QUICK, *words, "--out", str(run.parent / "again")]) == 0
    return run.parent / "again"


@pytest.mark.parametrize("name", FORMATS)
def test_an_export_scores_as_what_it_is_an_export_of(again, name):
    by_row = {(run.estimator, run.output): run for run in read_metrics(again / "metrics.json").runs}
    ours, theirs = by_row["ekf", "final"].metrics, by_row[f"by {name}", "final"]
    for key in ("ate_se3_m", "ate_yaw_m", "ate_se3_deg", "rpe_1s_m", "pairs"):
        assert theirs.metrics[key] == pytest.approx(ours[key], abs=1e-9)
    # its triangulation is iterated until a step no longer matters, not to the last digit
    assert theirs.metrics["heldout_reproj_rmse_px"] == pytest.approx(ours["heldout_reproj_rmse_px"], abs=1e-6)
    assert theirs.metrics["coverage_percent"] == 100.0
    assert theirs.metrics["nees_pose_mean"] is None
    assert theirs.notes["nees_pose_mean"] == "the estimator states no covariance"


@pytest.mark.parametrize("name", [*(f"cov {name}" for name in COVARIANCES), "unsaid"])
def test_an_export_with_covariances_has_the_nees_of_the_run(again, name):
    by_row = {(run.estimator, run.output): run for run in read_metrics(again / "metrics.json").runs}
    ours, theirs = by_row["ekf", "causal"].metrics, by_row[name, "final" if name == "unsaid" else "causal"].metrics
    keys = ["nees_pose_mean", "nees_ori_mean", "nees_pos_mean", "log_score_pose", "energy_pos_m"]
    for key in [*keys, *(["nees_gyro_bias_mean"] if name == "cov openvins" else [])]:
        assert theirs[key] == pytest.approx(ours[key], rel=1e-9)


def test_the_truth_and_the_state_of_either_output_are_exported_whole(run, tmp_path):
    target = tmp_path / "state.txt"
    end = ("--format", "openvins", "--out", str(target))
    for words in (("truth",), ("ekf", "--output", "causal"), ("ekf", "--output", "final")):
        assert main(["export", str(run), "--estimator", *words, *end]) == 0
        assert len(read_poses(target)) == 20
    values = np.loadtxt(target)
    assert values.shape == (20, 17)
    assert np.isfinite(values[:, 11:14]).all()  # the gyro bias is estimated beside twists
    assert main(["export", str(run), "--estimator", "truth", *end, "--cov-convention", "rot-pos/right"]) == 3


def test_another_system_is_in_everything_a_comparison_leaves(again):
    report = (again / "report.md").read_text()
    assert "| by euroc | final | ok |" in re.sub(" +", " ", report)
    assert "scored: coverage 100 %, pairs 20." in report
    assert "ekf.euroc (EuRoC, 20 poses), not run here" in report
    for file in ("trajectories/by_euroc_final.tum", "figures/top_all.png"):
        assert (again / file).is_file()
    manifest = json.loads((again / "manifest.json").read_text())
    assert manifest["references"] == [
        *(f"by {name}" for name in FORMATS),
        "astray",
        *(f"cov {name}" for name in COVARIANCES),
        "unsaid",
    ]
    assert "by euroc" in {run.estimator for run in read_report(again / "report.json").runs}
    assert main(["report", str(again)]) == 0
    (case,) = embedded((again / "report.html").read_text())["cases"]
    (row,) = [row for row in case["rows"] if row["estimator"] == "by euroc"]
    assert row["metrics"]["total_s"] is None


@pytest.mark.parametrize(
    ("of", "words", "why"),
    [
        ("run", (), "holds several trajectories; choose one with --estimator: dead-reckoning, ekf, truth"),
        ("run", ("--estimator", "batch"), "has no trajectory of batch; there are dead-reckoning, ekf, truth"),
        ("gaps", ("--estimator", "ekf"), "ekf final has 19 poses for 20 frames, and KITTI's rows are the frames"),
        ("again", ("--estimator", "by tum", "--output", "causal"), "no causal trajectory of by tum, only a final one"),
        ("seeds", (), "over seeds and holds no trajectories"),
    ],
)
def test_what_cannot_be_exported_is_reported_with_what_can(vislam, one_line, run, again, of, words, why):
    if of == "gaps":
        path = Path(shutil.copytree(run, "gaps"), "trajectories/ekf_final.tum")
        path.write_text("\n".join(path.read_text().splitlines()[:-1]) + "\n")
    if of == "seeds":
        assert vislam(*QUICK, "--max-frames", "5", "--seeds", "2", "--out", "seeds") == 0
    directory = {"run": run, "again": again}.get(of, Path(of))
    assert vislam("export", str(directory), *words, "--format", "kitti", "--out", "out") == 3
    assert why in one_line()
    assert not Path("out").exists()
