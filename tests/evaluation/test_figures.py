"""Figures of trajectory files: drawn of what is scored, kept with the evaluation, and replaced with it."""

from pathlib import Path

import numpy as np
import pytest

from toolkit.evaluation.gathering import gather
from toolkit.evaluation.scoring import Terms
from toolkit.evaluation.standings import EvaluatedSystems, evaluate, read_evaluation
from toolkit.report.figures.trajectories import draw

NAMES = ["boxes", "map_truth", "errors_truth"]


@pytest.fixture
def evaluation(scene, vislam) -> EvaluatedSystems:
    """Three runs of one system, of errors that differ, and one of another."""
    t_ns = scene.stamps(5.0)
    for run, error in enumerate((0.3, 0.1, 0.2)):
        scene.write(f"a/{run}.tum", t_ns, scene.estimated(t_ns, error, run))
    scene.write("b.tum", t_ns, scene.estimated(t_ns, 2.0, 5))
    return evaluate(gather(Path("truth.tum"), ["a=a", "b.tum"]), Terms())


def test_lines_are_the_pairs_of_the_run_of_the_middle_error(evaluation):
    figures = {one.name: one.figure for one in draw(evaluation)}
    assert list(figures) == NAMES
    by_run = {run.run: run.metrics for run in evaluation.runs if run.estimator == "a"}
    colour = figures["map_truth"].axes[0].lines[1].get_color()
    for axes, key in zip(figures["errors_truth"].axes, ("ate_se3_m", "ate_se3_deg"), strict=True):
        (line,) = [line for line in axes.lines if line.get_color() == colour]
        assert np.sqrt(np.mean(line.get_ydata() ** 2)) == pytest.approx(by_run["2"][key], rel=1e-9)
    (legend,) = figures["errors_truth"].legends
    assert legend.get_texts()[0].get_text().startswith("a: RMSE 0.3")
    dots = [line for line in figures["boxes"].axes[0].lines if line.get_marker() == "."]
    assert sorted(dots[0].get_ydata()) == sorted(metrics["ate_se3_m"] for metrics in by_run.values())


def test_they_are_kept_with_the_evaluation_and_shown_in_the_page(evaluation, vislam):
    words = ("evaluate", "truth.tum", "b.tum", "--out", "out", "--quiet")
    assert vislam(*words, "--figures", "few") == 0
    files = [f"{name}.png" for name in NAMES]
    assert list(read_evaluation(Path("out/evaluation.json")).figures) == files
    assert sorted(path.name for path in Path("out/figures").iterdir()) == sorted(files)
    assert Path("out/leaderboard.html").read_text().count('src="data:image/png;base64,') == len(files)
    assert vislam(*words) == 0
    assert not Path("out/figures").exists()
    Path("out/figures").mkdir()
    Path("out/figures/mine.png").write_text("")
    assert vislam(*words) == 4
