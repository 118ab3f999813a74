"""Trajectories as people have them: a table of what is given and what must come of it (2 s)."""

from pathlib import Path

import numpy as np
import pytest

from toolkit.evaluation.document import read_evaluation
from toolkit.geometry import Array, about_z, rotation_from_quaternion, se3, so3_exp

S = 10**9
POINT = np.zeros(3)


def turned_by(rotvec: tuple[float, float, float]) -> Array:
    return se3(so3_exp(np.array(rotvec)), POINT)


def metrics_of(out: str = "out") -> tuple[dict, dict]:
    (run,) = read_evaluation(Path(out, "evaluation.json")).runs
    return dict(run.metrics), dict(run.notes)


OF_ORIENTATION = ("ate_none_m", "ate_se3_deg", "rpe_1s_m", "rpe_100m_percent", "kitti_t_percent", "end_drift_percent")
FLIP = se3(np.diag([1.0, -1.0, -1.0]), POINT)


@pytest.mark.parametrize(
    ("world", "body", "words"),
    [
        (None, turned_by((0.0, 0.0, 0.5)), "turned by 29 deg"),
        (None, turned_by((0.0, 0.0, 1.5708)), "its x, y and z point along the truth's y, -x and z"),
        (None, turned_by((0.0, 0.0, 3.1415)), "its x, y and z point along the truth's -x, -y and z"),
        (None, turned_by((0.6, 1.2, 0.4)), "turned by 80 deg"),
        (FLIP, FLIP, "its x, y and z point along the truth's x, -y and -z"),
        (se3(about_z(np.pi / 2) @ np.diag([1.0, -1.0, -1.0]), POINT), FLIP, "the truth's x, -y and -z"),
    ],
)
def test_a_body_with_other_axes_is_named_and_only_its_positions_are_scored(scene, vislam, world, body, words) -> None:
    t_ns = scene.stamps(10.0)
    poses = (np.eye(4) if world is None else world) @ scene.estimated(t_ns, 0.07) @ body
    scene.write("s.tum", t_ns, poses)
    assert vislam("evaluate", "truth.tum", "s.tum", "--out", "out", "--quiet") == 0
    metrics, notes = metrics_of()
    assert metrics["ate_se3_m"] == pytest.approx(0.07 * np.sqrt(3.0), rel=0.1)
    assert all(metrics[key] is None and words in notes[key] for key in OF_ORIENTATION)
    # Followed, the advice leads to a file that is scored whole.
    numbers = notes["ate_se3_deg"].rpartition("x y z w ")[2].partition(")")[0].split()
    T_truth_body = se3(rotation_from_quaternion(np.array(numbers, dtype=float)), POINT)
    scene.write("s.tum", t_ns, poses @ np.linalg.inv(T_truth_body))
    assert vislam("evaluate", "truth.tum", "s.tum", "--out", "again", "--quiet") == 0
    assert metrics_of("again")[0]["ate_se3_deg"] < 2.0
