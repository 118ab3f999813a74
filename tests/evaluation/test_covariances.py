"""Files with covariances: scored as their errors are, wrong conventions named, two estimates compared without truth."""

import re
from pathlib import Path

import numpy as np
import pytest

from tests.evaluation.conftest import run_of, runs_in
from tests.frontend.test_bags import Ros
from toolkit.datasets.trajectories import tum
from toolkit.datasets.trajectories.covariances import CONVENTIONS, written_as
from toolkit.estimate import Trajectory
from toolkit.geometry import quaternion_from_rotation, se3_adjoint, se3_exp

# Heading and forward position are the least certain (rad, m); and the position depends on the heading.
ROOT = np.diag([2e-3, 2e-3, 1e-2, 0.3, 0.05, 0.05])
ROOT[4, 2] = 0.1
COV = ROOT @ ROOT.T


def estimate(scene, seed: int = 0, times: float = 1.0) -> Trajectory:
    """A consistent estimate in the truth's world; its covariance is stated so many times as large."""
    t_ns = scene.stamps(20.0)
    errors = np.random.default_rng(seed).standard_normal((t_ns.size, 6)) @ ROOT.T
    cov = np.tile(times * COV, (t_ns.size, 1, 1))
    return Trajectory(t_ns, scene.poses_at(t_ns) @ se3_exp(errors), cov=cov)


def written(trajectory: Trajectory, said: str = "rot-pos/right", meant: str = "") -> None:
    """Write est.tum, whose header says one convention, while its covariances are in the one that is meant."""
    text = tum.text_with_covariances(trajectory, CONVENTIONS[meant or said])
    Path("est.tum").write_text(
        text.replace(f"cov-convention {meant or said}", f"cov-convention {said}" if said else "")
    )


def test_a_consistent_estimate_is_found_so_in_every_score(scene, vislam):
    written(estimate(scene))
    run = run_of(vislam, "est.tum")
    # 1200 independent poses: three standard deviations of a mean NEES over 6, and of a share.
    assert run["metrics"]["nees_pose_mean"] == pytest.approx(1.0, abs=3.0 * np.sqrt(2.0 / 6.0 / 1200.0))
    assert run["metrics"]["inside_90_pose_percent"] == pytest.approx(90.0, abs=2.7)
    assert run["metrics"]["energy_pos_m"] < run["metrics"]["ate_none_m"]
    assert "nees_pose_mean" not in run["notes"]


def test_over_runs_the_scores_have_intervals_and_the_nees_its_band(scene, vislam, capsys):
    for seed in range(4):
        Path(f"run{seed}.tum").write_text(tum.text_with_covariances(estimate(scene, seed)))
    assert vislam("evaluate", "truth.tum", *(f"est=run{seed}.tum" for seed in range(4)), "--out", "out") == 0
    text = capsys.readouterr().out
    rows = [" ".join(line.split()) for line in text.splitlines() if line.startswith("est ")]
    pose = next(row for row in rows if row.startswith("est pose 4 "))
    mean, low, high, band = re.match(r"est pose 4 (\S+) \((\S+) \.\. (\S+)\) (\S+ \.\. \S+)", pose).groups()
    values = [run["metrics"]["nees_pose_mean"] for run in runs_in()]
    assert float(mean) == pytest.approx(np.mean(values), rel=0.01)
    assert float(low) < 1.0 < float(high)
    # Chi-square with 24 degrees of freedom over 24: 12.40 and 39.36 at 2.5 and 97.5 %.
    assert band == "0.52 .. 1.64"


@pytest.mark.parametrize(
    ("said", "meant"),
    [
        *((said, "rot-pos/right") for said in CONVENTIONS if said != "rot-pos/right"),
        ("rot-pos/right", "rot-pos/left"),
        ("rot-pos/right", "pos-rot/fixed"),
        ("pos-rot/fixed", "rot-pos/mixed"),
    ],
)
def test_a_wrong_convention_is_named_with_the_right_one(scene, vislam, said, meant):
    written(estimate(scene), said, meant)
    note = run_of(vislam, "est.tum")["notes"]["nees_pose_mean"]
    assert note.startswith(f"the covariances are said to be {said} and fit the errors only as ")
    assert meant in note.partition(": ")[0]


def test_errors_that_are_those_of_the_start_show_the_convention_as_well(scene, vislam):
    """Placed by its first pose such an estimate would have no errors, which fit any covariance."""
    t_ns = scene.stamps(20.0)
    error = se3_exp(ROOT @ np.array([1.0, -1.0, 0.8, 1.2, -0.9, 1.0]))
    given = Trajectory(t_ns, scene.poses_at(t_ns) @ error, cov=np.tile(COV, (t_ns.size, 1, 1)))
    written(given, "pos-rot/right", "rot-pos/right")
    note = run_of(vislam, "est.tum")["notes"]["nees_pose_mean"]
    assert note.startswith("the covariances are said to be pos-rot/right and fit the errors only as rot-pos/right")
    written(given)
    assert "nees_pose_mean" not in run_of(vislam, "est.tum")["notes"]


def reckoned(scene, times: float) -> Trajectory:
    """Dead reckoning of the truth's motion with stated noise, of which so much is told: it errs as the rest of it."""
    t_ns = scene.stamps(10.0)
    true = scene.poses_at(t_ns)
    root = 0.05 * ROOT
    noise = se3_exp(np.random.default_rng(3).standard_normal((t_ns.size - 1, 6)) @ root.T)
    poses, covs = [true[0]], [root @ root.T]
    for step, error in zip(np.linalg.inv(true[:-1]) @ true[1:], noise, strict=True):
        back = se3_adjoint(np.linalg.inv(step @ error))
        poses.append(poses[-1] @ step @ error)
        covs.append(back @ covs[-1] @ back.T + root @ root.T)
    return Trajectory(t_ns, np.array(poses), cov=times * np.array(covs))


@pytest.mark.parametrize("times", [1.0, 0.001])
@pytest.mark.parametrize("said", CONVENTIONS)
def test_covariances_show_by_how_they_follow_the_motion_what_they_mean(scene, vislam, said: str, times: float) -> None:
    """Of an overconfident estimate as well, whose errors are not those that it states."""
    written(reckoned(scene, times), said, "rot-pos/right")
    note = run_of(vislam, "est.tum")["notes"].get("nees_pose_mean", "")
    if said == "rot-pos/right":
        assert "said to be" not in note
    else:
        assert re.match(rf"the covariances are said to be {said} and (fit the errors|follow the motion) only as ", note)
        assert note.partition(" only as ")[2].startswith("rot-pos/right: ")


def test_where_no_convention_is_said_the_truth_tells_which_fits(scene, vislam, capsys):
    written(estimate(scene), "", "pos-rot/fixed")
    run = run_of(vislam, "est.tum")
    assert run["metrics"]["nees_pose_mean"] is None
    best = "name it with --cov-convention; the truth fits them best as pos-rot/left or pos-rot/fixed"
    assert best in run["notes"]["nees_pose_mean"]
    assert run["metrics"]["ate_se3_m"] < 0.5
    capsys.readouterr()
    assert vislam("evaluate", "truth.tum", "est.tum") == 0
    assert "no value: the file does not say what its covariances mean" in capsys.readouterr().out
    said = run_of(vislam, "est.tum", "--cov-convention", "pos-rot/fixed")
    assert said["metrics"]["nees_pose_mean"] == pytest.approx(1.0, abs=0.06)


def write_bag(path: Path, given: Trajectory, topics: tuple[str, ...], convention: str) -> None:
    """Write the poses as odometry, each topic the same, with covariances in a convention."""
    covs = np.ascontiguousarray(written_as(CONVENTIONS[convention], given.T_world_imu, given.cov, 6)).reshape(-1, 36)
    turns, ros = quaternion_from_rotation(given.T_world_imu[:, :3, :3]), Ros.of("ros1")
    ros.write(path, [
        ros.item(t_ns, topic, "nav_msgs/Odometry", "odom", child_frame_id="imu", pose={
            "pose": {"position": at, "orientation": turn}, "covariance": cov,
        })
        for topic in topics
        for t_ns, at, turn, cov in zip(given.t_ns.tolist(), given.positions, turns, covs, strict=True)
    ])  # fmt: skip


def test_odometry_of_a_bag_is_scored_with_the_covariances_of_ros_or_as_is_said(scene, vislam, capsys):
    given = estimate(scene)
    written(given)
    by_file = run_of(vislam, "est.tum")["metrics"]
    for name, convention in (("other", "rot-pos/mixed"), ("est", "pos-rot/fixed")):
        write_bag(Path(f"{name}.bag"), given, ("/odom", "/other"), convention)
        words = ("--cov-convention", convention) if name == "other" else ()
        run = run_of(vislam, f"est={name}.bag:/odom", *words)
        for key in ("nees_pose_mean", "ate_se3_m", "log_score_pose", "inside_50_ori_percent"):
            assert run["metrics"][key] == pytest.approx(by_file[key], rel=1e-9)
    assert vislam("evaluate", "truth.tum", "est.bag", "--quiet") == 3
    assert "name the topic of the poses, as in est.bag:/odom; there are /odom (nav_msgs/Odom" in capsys.readouterr().err
    assert vislam("evaluate", "truth.tum", "est.bag:/odm", "--quiet") == 3
    assert "no topic of poses is called /odm (did you mean /odom?)" in capsys.readouterr().err


@pytest.mark.parametrize(("times", "low", "high"), [(1.0, 0.9, 1.1), (0.25, 1.4, 1.8)])
def test_two_estimates_of_one_run_are_compared_without_a_truth(scene, vislam, times, low, high):
    """With a quarter of its covariance stated, (1 + 1) / (1 + 1/4) = 1.6 of one is left."""
    Path("truth.tum").write_text(tum.text_with_covariances(estimate(scene, 1)))
    written(estimate(scene, 2, times))
    run = run_of(vislam, "est.tum")
    assert low < run["metrics"]["nees_pose_mean"] < high
    assert "differences are compared with the sum of both" in run["notes"]["nees_pose_mean"]
