"""``vislam evaluate`` says what evo (GPL, a test dependency only) says of the same files, to 1e-9."""

import copy
from pathlib import Path

import numpy as np
import pytest
from evo.core import sync
from evo.core.metrics import APE, RPE, PoseRelation, Unit
from evo.core.trajectory import PosePath3D
from evo.tools import file_interface

from tests.evaluation.conftest import START_NS, S, poses_at
from toolkit.datasets.trajectories import euroc, kitti, tum
from toolkit.estimate import Trajectory
from toolkit.evaluation.scoring import Terms, read_truth, score_file
from toolkit.geometry import Array, IntArray, se3_exp

# Files print 15 digits; what is left is the order of sums over a few hundred poses.
TOLERANCE = 1e-9
POSITION, ANGLE_DEG = PoseRelation.translation_part, PoseRelation.rotation_angle_deg


def drifted(t_ns: IntArray) -> Array:
    """An estimate with drift, a scale error and a world of its own (N, 4, 4)."""
    steps = 3e-3 * np.random.default_rng(2).standard_normal((t_ns.size, 6))
    poses = poses_at(t_ns) @ se3_exp(np.cumsum(steps, axis=0))
    poses[:, :3, 3] *= 1.02
    return se3_exp(np.array([0.4, -0.3, 2.0, 30.0, -50.0, 7.0])) @ poses


def evo_rmse(metric, reference: PosePath3D, estimate: PosePath3D) -> float:
    metric.process_data((reference, estimate))
    return float(np.sqrt(np.mean(metric.error**2)))


def evo_scores(reference: PosePath3D, estimate: PosePath3D, ten_frames_are_a_second: bool) -> dict[str, float]:
    scores = {}
    for key, scale in (("ate_se3_m", False), ("ate_sim3_m", True)):
        aligned = copy.deepcopy(estimate)
        aligned.align(reference, correct_scale=scale)
        scores[key] = evo_rmse(APE(POSITION), reference, aligned)
        if not scale:
            scores["ate_se3_deg"] = evo_rmse(APE(ANGLE_DEG), reference, aligned)
    placed = copy.deepcopy(estimate)
    placed.align_origin(reference)
    scores["ate_none_m"] = evo_rmse(APE(POSITION), reference, placed)
    path_m, poses = reference.distances, estimate.poses_se3
    # evo takes the pair nearest to 100 m, we the first beyond it: hand its formula our pairs.
    last = np.searchsorted(path_m, path_m + 100.0)
    pairs = [(i, j) for i, j in enumerate(last) if j < path_m.size and path_m[j] - path_m[i] < 110.0]
    errors = [RPE.rpe_base(reference.poses_se3[i], reference.poses_se3[j], poses[i], poses[j]) for i, j in pairs]
    scores["rpe_100m_percent"] = np.sqrt(np.mean([error[:3, 3] @ error[:3, 3] for error in errors]))
    if ten_frames_are_a_second:
        for key, relation in (("rpe_1s_m", POSITION), ("rpe_1s_deg", ANGLE_DEG)):
            metric = RPE(relation, delta=10, delta_unit=Unit.frames, all_pairs=True)
            scores[key] = evo_rmse(metric, reference, estimate)
    return scores


def assert_equal(ours: dict[str, float | None], theirs: dict[str, float]) -> None:
    for key, value in theirs.items():
        assert ours[key] == pytest.approx(value, rel=TOLERANCE), key
        assert value > 0.01, key


def test_kitti_files_are_paired_line_by_line_as_in_evo(tmp_path):
    t_ns = START_NS + np.arange(600) * (S // 10)
    for name, poses in (("truth.txt", poses_at(t_ns)), ("other.txt", drifted(t_ns))):
        (tmp_path / name).write_text(kitti.text(Trajectory(t_ns, poses)))
    scores = score_file(tmp_path / "other.txt", read_truth("07", tmp_path / "truth.txt"), Terms())
    theirs = [file_interface.read_kitti_poses_file(tmp_path / name) for name in ("truth.txt", "other.txt")]
    assert_equal(scores.values, evo_scores(*theirs, ten_frames_are_a_second=False))
    assert scores.values["rpe_1s_m"] is None
    assert scores.notes["rpe_1s_m"] == "the files have no stamps"
    assert scores.values["kitti_t_percent"] is not None


AT_200_HZ = START_NS + np.arange(12_000) * (S // 200)


def euroc_files(folder: Path, t_ns: IntArray, late_ns: int = 0, truth_t_ns: IntArray = AT_200_HZ) -> tuple[Path, Path]:
    """Write a truth as EuRoC has it, and an estimate at other stamps, on a clock that is late, as TUM."""
    truth, other = folder / "data.csv", folder / "other.tum"
    truth.write_text(euroc.text(Trajectory(truth_t_ns, poses_at(truth_t_ns))))
    other.write_text(tum.text(Trajectory(t_ns - late_ns, drifted(t_ns))))
    return truth, other


def evo_pair(truth: Path, other: Path, max_dt_s: float, offset_s: float = 0.0):
    reference = file_interface.read_euroc_csv_trajectory(truth)
    estimate = file_interface.read_tum_trajectory_file(other)
    return sync.associate_trajectories(reference, estimate, max_diff=max_dt_s, offset_2=offset_s)


def test_euroc_stamps_that_coincide_up_to_rounding_are_not_interpolated(tmp_path):
    """Camera stamps of EuRoC differ from those of its truth by some hundred nanoseconds."""
    t_ns = START_NS + np.arange(20, 580) * (S // 10) + np.random.default_rng(0).integers(-400, 400, 560)
    truth, other = euroc_files(tmp_path, t_ns)
    ours = score_file(other, read_truth("MH_01", truth), Terms())
    assert "pairs" not in ours.notes
    assert_equal(ours.values, evo_scores(*evo_pair(truth, other, 0.01), ten_frames_are_a_second=True))


@pytest.mark.parametrize("keyframes", [1, 9])
def test_with_max_dt_the_nearest_poses_are_paired_as_in_evo(tmp_path, keyframes):
    """Stamps lie anywhere between those of the truth, on a clock of their own; some have none near enough."""
    t_ns = START_NS + np.arange(600) * (S // 10) + np.random.default_rng(1).integers(0, S // 200, 600)
    truth, other = euroc_files(tmp_path, t_ns[::keyframes], S // 4)
    ours = score_file(other, read_truth("MH_01", truth), Terms(max_dt_s=0.002, offset_s=0.25))
    pair = evo_pair(truth, other, 0.002, 0.25)
    assert ours.values["pairs"] == pair[0].num_poses < t_ns[::keyframes].size
    assert_equal(ours.values, evo_scores(*pair, ten_frames_are_a_second=False))
    assert "paired with the nearest pose" in ours.notes["pairs"]


def test_a_truth_sparser_than_the_trajectory_has_the_roles_exchanged(tmp_path):
    sparse, dense = START_NS + np.arange(60) * S, START_NS + np.arange(1200) * (S // 20) + 7_000_000
    truth, other = euroc_files(tmp_path, dense, truth_t_ns=sparse)
    ours = score_file(other, read_truth("x", truth), Terms(max_dt_s=0.02))
    pair = evo_pair(truth, other, 0.02)
    assert ours.values["pairs"] == pair[0].num_poses
    assert_equal(ours.values, evo_scores(*pair, ten_frames_are_a_second=False))
