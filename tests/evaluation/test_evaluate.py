"""``vislam evaluate``: which files are found, what is said of bad ones, and that nothing which failed is dropped."""

import csv
import io
import json
import re
import subprocess
import sys
from itertools import product
from pathlib import Path

import jsonschema
import numpy as np
import pytest

from tests.evaluation.conftest import run_of
from toolkit.evaluation.standings import EvaluationRecord, signed_rank_p
from toolkit.files.documents import schema
from toolkit.geometry import quaternion_from_rotation, se3, so3_exp

S = 10**9


def document(folder: str = "out") -> dict:
    return json.loads(Path(folder, "evaluation.json").read_text())


def standing(found: dict, system: str) -> dict:
    return next(one for one in found["leaderboard"] if one["estimator"] == system)


def test_one_file_is_scored_without_gtsam_or_a_recording(scene, vislam, tmp_path):
    scene.write("other.tum", scene.stamps(10.0), scene.estimated(scene.stamps(10.0), 0.1))
    program = (
        "import sys; from toolkit.cli import main\n"
        "status = main(['evaluate', 'truth.tum', 'mine=other.tum', '--out', 'out'])\n"
        "print(sorted(sys.modules.keys() & {'gtsam', 'cv2', 'filters', 'toolkit.runner'}), status)"
    )
    messages = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True, cwd=tmp_path)
    assert messages.stdout.splitlines()[-1] == "[] 0"
    (run,) = document()["runs"]
    # 600 poses with independent errors of 0.1 m an axis.
    assert run["metrics"]["ate_se3_m"] == pytest.approx(0.1 * np.sqrt(3.0), rel=0.05)
    assert run["metrics"]["time_coverage_percent"] == pytest.approx(100.0, abs=0.2)


def test_failures_are_counted_and_never_dropped(tree, capsys):
    Path("results/good/S0/0.tum").write_text("")
    Path("results/good/S0/1.tum").write_text("1 2 3\n")
    for run in range(3):
        Path(f"results/good/S1/{run}.tum").unlink()
    Path("results/good/S1").rmdir()
    assert tree("evaluate", "truths", "results", "--out", "out") == 1
    found = document()
    good = standing(found, "good")
    assert (good["runs"], good["ok"], good["solved"], good["wins"]) == (21, 16, 5, 5)
    over = {(one["estimator"], one["sequence"]): one for one in found["over_runs"]}
    assert over["good", "S0"]["metrics"]["ate_se3_m"]["median"] is None
    (paired,) = found["paired"]
    assert (paired["better"], paired["worse"]) == (5, 2)
    messages = capsys.readouterr().out
    assert "2 of 3 failed" in messages
    assert "good, S0, 1: results/good/S0/1.tum: 3 columns" in messages
    assert "there is no trajectory" in messages


def test_the_better_system_is_ahead_and_seven_sequences_tell(tree):
    assert tree("evaluate", "truths", "poor=results/poor", "good=results/good", "--out", "out", "--quiet") == 0
    found = document()
    assert [one["estimator"] for one in found["leaderboard"]] == ["good", "poor"]
    assert standing(found, "good")["mean_rank"] == 1.0
    (paired,) = found["paired"]
    # All seven signs agree: two of 2^7 ways.
    assert paired["p"] == pytest.approx(2.0 / 128.0)
    assert paired["median_ratio"] == pytest.approx(0.5, rel=0.05)


def test_a_run_over_a_tenth_of_the_path_does_not_win(scene, vislam, capsys):
    scene.write("short.tum", scene.stamps(20.0, 0.0, 6.0), scene.estimated(scene.stamps(20.0, 0.0, 6.0), 0.001))
    scene.write("whole.tum", scene.stamps(20.0), scene.estimated(scene.stamps(20.0), 0.1))
    assert vislam("evaluate", "truth.tum", "short.tum", "whole.tum", "--out", "out") == 1
    found = document()
    assert [one["estimator"] for one in found["leaderboard"]] == ["whole", "short"]
    short = next(run for run in found["runs"] if run["estimator"] == "short")
    assert short["status"] == "failed"
    assert short["metrics"]["ate_se3_m"] < 0.01
    assert "covers 9.9 % of the truth's time, and 50 % is required" in capsys.readouterr().out
    assert vislam("evaluate", "truth.tum", "short.tum", "--least-coverage", "5", "--quiet") == 0


def test_runs_that_ought_to_be_there_are_missed(tree):
    """A run that crashed may have left no file, and nothing else shows it."""
    Path("results/good/S2/1.tum").unlink()
    assert tree("evaluate", "truths", "results", "--out", "out", "--quiet") == 0
    notes = document()["notes"]
    assert "good has 2 of S2 and 3 runs elsewhere; --runs 3 counts those missing as failed" in notes
    assert tree("evaluate", "truths", "results", "--runs", "4", "--out", "out", "--quiet") == 1
    good = standing(document(), "good")
    assert (good["runs"], good["ok"]) == (28, 20)


def test_repeated_runs_of_one_sequence_have_median_and_quartiles(tree, capsys):
    words = ("evaluate", "truths/S0.tum", "a=results/good/S0", "b=results/poor/S0/0.tum", "b=results/poor/S0/1.tum")
    assert tree(*words, "--out", "out") == 0
    found = document()
    values = [run["metrics"]["ate_se3_m"] for run in found["runs"] if run["estimator"] == "a"]
    over = found["over_runs"][0]
    assert over["runs"] == 3
    quartiles = [over["metrics"]["ate_se3_m"][key] for key in ("lower_quartile", "median", "upper_quartile")]
    np.testing.assert_allclose(quartiles, np.percentile(values, [25, 50, 75]))
    assert found["paired"] == []
    assert "2 of 2" in capsys.readouterr().out


# What else may be wrong with a file, and whether following the advice helps, is in test_public_cases.
@pytest.mark.parametrize(("text", "expected"), [("", "the file holds no poses"), ("1 2 3 0 0 0 1\n", "columns")])
def test_a_bad_file_is_reported_in_one_line_and_beside_a_good_one_counted(scene, vislam, capsys, text, expected):
    Path("bad.tum").write_text(text)
    assert vislam("evaluate", "truth.tum", "bad.tum", "--out", "out") == 3
    printed = capsys.readouterr().err
    assert printed.count("\n") == 1
    assert expected in printed
    assert not Path("out").exists()
    scene.write("fine.tum", scene.stamps(10.0), scene.estimated(scene.stamps(10.0), 0.1))
    assert vislam("evaluate", "truth.tum", "bad.tum", "fine.tum", "--out", "out") == 1
    assert [run["status"] for run in document()["runs"]] == ["failed", "ok"]
    assert expected in document()["runs"][0]["log"][0]


# What names nothing, or the wrong thing, is in tests/cli/test_advice.py.
@pytest.mark.parametrize(
    ("words", "status", "expected"),
    [
        (("truths", "results/good/S0"), 3, "it has no folders; expected SYSTEM/SEQUENCE.tum or"),
        (("truth.tum", "a=results"), 3, "results: it holds no trajectory"),
        (("truth.tum", "a=truth.tum", "a=truth.tum"), 3, "truth.tum: it is given twice"),
        (("truth.tum", "truth.tum", "--metric", "ate_se_m"), 2, "did you mean ate_se3_m?"),
        (("truth.tum", "truth.tum", "--least-coverage", "101"), 2, "expected percent from 0 to 100"),
        (("truth.tum", "truth.tum", "--out", "results"), 4, "results"),
    ],
)
def test_trouble_is_reported_in_one_line(tree, capsys, words, status, expected):
    try:
        assert tree("evaluate", *words) == status
    except SystemExit as left:
        assert left.code == status
    printed = capsys.readouterr().err
    assert printed.count("\n") == 1
    assert expected in printed


def test_formats_say_the_same(tree, capsys):
    Path("results/poor/S3/1.tum").write_text("")
    assert tree("evaluate", "truths", "results", "--json") == 1
    found = json.loads(capsys.readouterr().out)
    jsonschema.validate(found, schema(EvaluationRecord))
    tree("evaluate", "truths", "results", "--format", "csv")
    rows = list(csv.DictReader(io.StringIO(capsys.readouterr().out)))
    assert [row["ate_se3_m"] for row in rows] == [
        "" if run["metrics"]["ate_se3_m"] is None else repr(run["metrics"]["ate_se3_m"]) for run in found["runs"]
    ]
    assert sum(row["status"] == "failed" for row in rows) == 1
    tree("evaluate", "truths", "results", "--format", "latex")
    latex = capsys.readouterr().out
    assert latex.count(r"\begin{tabular}") == latex.count(r"\end{tabular}") == 2
    assert r"\textbf{0.174}" in latex
    assert r"[\%]" in latex
    tree("evaluate", "truths", "results", "--format", "markdown")
    assert "**0.174**" in capsys.readouterr().out
    tree("evaluate", "truths", "results", "--quiet")
    assert capsys.readouterr().out == ""


def test_the_page_is_whole_and_no_name_is_markup(tree):
    Path("results/poor").rename("results/<b>poor&")
    assert tree("evaluate", "truths", "results", "--out", "out", "--quiet") == 0
    page = Path("out/leaderboard.html").read_text()
    assert "<b>poor" not in page
    assert "&lt;b&gt;poor&amp;" in page
    assert "http" not in page.replace("http-equiv", "")
    assert page.count("<section") == page.count("</section>") >= 4


@pytest.mark.parametrize(("error", "status"), [(0.1, 0), (0.13, 1)])
def test_the_gate_takes_an_evaluation_in_the_place_of_a_folder(tree, scene, error, status):
    good = ("evaluate", "truths", "good=results/good")
    assert tree(*good, "--out", "before", "--quiet") == 0
    assert tree("baseline", "--trajectories", "before/evaluation.json", "--out", "base.json") == 0
    assert tree("check", "--trajectories", "results/good", "--baseline", "base.json") == 0
    t_ns = scene.stamps(10.0, end_s=10.0)
    for sequence in range(7):
        for run in range(3):
            path = f"results/good/S{sequence}/{run}.tum"
            scene.write(path, t_ns, scene.estimated(t_ns, error, 1000 + 100 * sequence + run))
    assert tree(*good, "--out", "after", "--quiet") == 0
    assert tree("check", "--trajectories", "after/evaluation.json", "--baseline", "base.json") == status


def test_an_evaluation_of_two_systems_has_the_sequences_of_each_in_a_baseline(tree):
    one = ("evaluate", "truths/S0.tum", "good=results/good/S0/0.tum", "poor=results/poor/S0/0.tum", "--quiet")
    assert tree(*one, "--out", "before") == 0
    assert tree("baseline", "--trajectories", "before/evaluation.json", "--out", "base.json") == 0
    named = [entry["sequence"] for entry in json.loads(Path("base.json").read_text())["sequences"]]
    assert named == ["good/S0", "poor/S0"]


def openvins_text(t_ns, poses, cov_orientation, cov_position) -> str:
    upper = np.triu_indices(3)
    q = quaternion_from_rotation(poses[:, :3, :3])
    values = np.hstack([poses[:, :3, 3], q, cov_orientation[:, *upper], cov_position[:, *upper]])
    lines = [f"{t / S:.9f} {' '.join(map(repr, row))}" for t, row in zip(t_ns.tolist(), values.tolist(), strict=True)]
    return "# timestamp(s) tx ty tz qx qy qz qw Pr11 Pr12 Pr13 Pr22 Pr23 Pr33 Pt11 ...\n" + "\n".join(lines) + "\n"


@pytest.mark.parametrize("own_world", [False, True])
def test_covariances_of_openvins_give_nees(scene, vislam, own_world):
    """Errors drawn from the covariances, a turn of the body and a shift in the estimate's world, have a NEES of 1."""
    rng, t_ns = np.random.default_rng(5), scene.stamps(20.0)
    factors = rng.standard_normal((2, t_ns.size, 3, 3)) * np.array([0.01, 0.1]).reshape(2, 1, 1, 1)
    covs = factors @ np.swapaxes(factors, 2, 3) + np.array([1e-6, 1e-4]).reshape(2, 1, 1, 1) * np.eye(3)
    turn, shift = ((np.linalg.cholesky(cov) @ rng.standard_normal((t_ns.size, 3, 1)))[..., 0] for cov in covs)
    turn[0] = shift[0] = 0.0  # the first pose is placed where the world is another
    world = scene.own_world if own_world else np.eye(4)
    true = world @ scene.poses_at(t_ns)
    poses = se3(true[:, :3, :3] @ so3_exp(-turn), true[:, :3, 3] - shift)
    Path("ov.txt").write_text(openvins_text(t_ns, poses, *covs))
    run = run_of(vislam, "ov.txt", "--imu")
    # The mean of 1200 of chi-square over 3 has a standard deviation of sqrt(2 / 3600) = 0.024.
    assert run["metrics"]["nees_ori_mean"] == pytest.approx(1.0, abs=0.1)
    assert run["metrics"]["nees_pos_mean"] == pytest.approx(1.0, abs=0.1)
    assert ("nees_pos_mean" in run["notes"]) is own_world


def test_time_coverage_of_keyframes_counts_gaps(scene, vislam):
    t_ns = np.concatenate([scene.stamps(0.5, 4.0, 20.0), scene.stamps(0.5, 30.0, 50.1)])
    scene.write("keyframes.tum", t_ns, scene.estimated(t_ns, 0.1))
    for words, covered_s in (((), 34.0), (("--gap", "12"), 46.0)):
        metrics = run_of(vislam, "keyframes.tum", *words)["metrics"]
        assert metrics["time_coverage_percent"] == pytest.approx(100.0 * covered_s / 59.95)


def test_an_estimate_that_stays_looks_one_way_or_leaps_is_remarked_and_a_sound_one_not(scene, vislam):
    t_ns = scene.stamps(10.0)
    sound = scene.estimated(t_ns, 0.05)
    stays, one_way, leaps = sound.copy(), sound.copy(), sound.copy()
    stays[:, :3, 3], one_way[:, :3, :3] = stays[0, :3, 3], np.eye(3)
    leaps[200:300, :3, 3] += [30.0, 0.0, 0.0]
    for name, poses in (("sound", sound), ("stays", stays), ("one_way", one_way), ("leaps", leaps)):
        scene.write(f"{name}.tum", t_ns, poses)
    assert vislam("evaluate", "truth.tum", "sound.tum", "stays.tum", "one_way.tum", "leaps.tum", "--out", "out") == 0
    notes = {run["estimator"]: run["notes"] for run in document()["runs"]}
    assert "ate_se3_m" not in notes["sound"]
    assert "stands still" in notes["stays"]["ate_se3_m"]
    assert "orientations are all one" in notes["one_way"]["ate_se3_deg"]
    assert "jumps, 2 time(s), the farthest by 30" in notes["leaps"]["ate_se3_m"]
    assert re.search(r" (19|29)\.9 s after its first pose", notes["leaps"]["ate_se3_m"])


def test_a_truth_that_stands_still_is_remarked_beside_what_moves(scene, vislam):
    scene.write("still.tum", scene.stamps(10.0), np.tile(np.eye(4), (600, 1, 1)))
    assert vislam("evaluate", "still.tum", "truth.tum", "still.tum", "--out", "out", "--quiet") == 0
    moving, still = (run["notes"].get("ate_se3_m", "") for run in document()["runs"])
    assert "the truth stands still, all its positions are one" in moving
    assert "stands still" not in still


def by_enumeration(differences: np.ndarray) -> float:
    """Count all signs, one by one."""
    given = differences[differences != 0.0]
    sizes = np.abs(given)
    ranks = np.array([np.mean(np.flatnonzero(np.sort(sizes) == size) + 1.0) for size in sizes])
    sums = [float(ranks @ np.array(signs)) for signs in product((0.0, 1.0), repeat=given.size)]
    here = float(ranks[given > 0.0].sum())
    return min(1.0, 2.0 * min(np.mean([s <= here for s in sums]), np.mean([s >= here for s in sums])))


@pytest.mark.parametrize("seed", range(5))
def test_it_counts_every_sign_whatever_ties_and_failures_there_are(seed):
    rng = np.random.default_rng(seed)
    differences = rng.integers(-3, 4, 9).astype(float)
    differences[rng.integers(0, 9, 3)] = [np.inf, np.inf, -np.inf]
    assert signed_rank_p(differences) == pytest.approx(by_enumeration(differences))
    from scipy.stats import wilcoxon  # its import takes a sixth of what all tests take to be found

    apart = rng.normal(0.3, 1.0, 15)
    assert signed_rank_p(apart) == pytest.approx(wilcoxon(apart, method="exact").pvalue)


def test_no_difference_is_no_evidence():
    assert signed_rank_p(np.zeros(5)) == 1.0
    assert signed_rank_p(np.array([1.0])) == 1.0
    assert signed_rank_p(np.full(10, np.inf)) == pytest.approx(2.0 / 1024.0)
