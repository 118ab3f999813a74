"""KITTI odometry folders: axes, stamps and poses, what is missing or does not fit, and the real beginning of 06."""

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import toolkit
from toolkit.datasets import load_sequence
from toolkit.datasets.trajectories import tum
from toolkit.estimate import Trajectory
from toolkit.experiment.recording import Recording, prepare
from toolkit.measurements import TwistChangeNoise
from toolkit.motion_samples import NoSamples

# Of the rendered drive, as in conftest.
FRAMES, FOCAL_PX, BASELINE_M, STEP_M = 8, 250.0, 0.4, 0.05


@pytest.fixture
def drive(kitti_drive: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(kitti_drive, tmp_path / "drive"))


def test_no_motion_is_measured_and_forward_is_the_bodys_x(drive: Path) -> None:
    sequence = load_sequence(str(drive))
    assert isinstance(sequence.motion, NoSamples)
    assert isinstance(sequence.noise, TwistChangeNoise)
    assert "no motion input" in sequence.provenance.facts[0]
    np.testing.assert_array_equal(sequence.frames_t_ns, 100_000_000 * np.arange(FRAMES))
    ahead = [1.0, 0.0, 0.0]
    np.testing.assert_allclose(sequence.truth.T_world_imu[:, :3, 3], np.outer(STEP_M * np.arange(FRAMES), ahead))
    np.testing.assert_allclose(sequence.rig.T_imu_cam[:3, :3] @ [0.0, 0.0, 1.0], ahead)
    assert (sequence.rig.fx_px, sequence.rig.baseline_m) == (FOCAL_PX, pytest.approx(BASELINE_M))


def test_poses_of_the_download_are_found_beside_the_sequences(drive: Path, tmp_path: Path) -> None:
    root = tmp_path / "dataset/sequences/06"
    root.parent.mkdir(parents=True)
    drive.rename(root)
    (tmp_path / "dataset/poses").mkdir()
    (root / "poses.txt").rename(tmp_path / "dataset/poses/06.txt")
    assert load_sequence(str(root)).truth is not None


@pytest.mark.parametrize("count", [FRAMES, FRAMES - 3, FRAMES + 4])
@pytest.mark.parametrize("period_s", [0.1, -0.1])
def test_poses_follow_images_whose_stamps_are_out_of_order_too_few_or_too_many(
    drive: Path, count: int, period_s: float
) -> None:
    (drive / "times.txt").write_text("".join(f"{2.0 + period_s * k:.6e}\n" for k in range(count)))
    sequence = load_sequence(str(drive))
    used = np.arange(min(count, FRAMES))
    assert sequence.frame_count == used.size
    np.testing.assert_array_equal(sequence.truth.t_ns, sequence.frames_t_ns)
    moved_m = STEP_M * (used if period_s > 0.0 else used[::-1])
    np.testing.assert_allclose(sequence.truth.T_world_imu[:, 0, 3], moved_m, atol=1e-9)


def test_what_is_not_there_is_assumed_and_reported_or_left_out(drive: Path) -> None:
    (drive / "times.txt").unlink()
    (drive / "poses.txt").unlink()
    (drive / "image_1/000003.png").unlink()
    sequence = load_sequence(str(drive))
    assert sequence.truth is None
    assert any("an image every 0.1 s is assumed" in fact for fact in sequence.provenance.facts)
    assert any("000003.png (it is missing" in fact for fact in sequence.provenance.facts)
    assert sequence.frames_t_ns.tolist() == [100_000_000 * k for k in range(FRAMES) if k != 3]


def test_a_calibration_of_images_half_as_large_is_reported(drive: Path) -> None:
    def reported() -> bool:
        return any("far from the middle" in fact for fact in load_sequence(str(drive)).provenance.facts)

    assert not reported()
    text = (drive / "calib.txt").read_text()
    (drive / "calib.txt").write_text(text.replace(" 160", " 80").replace(" 100 ", " 50 "))
    assert reported()


def test_rows_without_names_keep_their_places(drive: Path) -> None:
    rows = [line.partition(":")[2] for line in (drive / "calib.txt").read_text().splitlines()[:2]]
    (drive / "calib.txt").write_text("\n" + "\n\n".join(rows) + "\n")
    assert load_sequence(str(drive)).rig.baseline_m == pytest.approx(BASELINE_M)


def test_of_two_pairs_the_one_with_both_cameras_is_read(drive: Path) -> None:
    before = load_sequence(str(drive))
    shutil.copytree(drive / "image_0", drive / "image_2")
    (drive / "image_1").rename(drive / "image_3")
    text = (drive / "calib.txt").read_text()
    (drive / "calib.txt").write_text(text + text.replace("P1", "P3").replace("P0", "P2"))
    (drive / "image_0").rename(drive / "image_l")
    np.testing.assert_array_equal(load_sequence(str(drive)).observations.uv_px, before.observations.uv_px)


def test_a_truth_and_a_trajectory_need_no_measured_motion(drive: Path, tmp_path: Path) -> None:
    """No gyro says whether they turn rightly; they are scored all the same."""
    poses = load_sequence(str(drive)).truth
    (drive / "poses.txt").unlink()
    file = tmp_path / "poses.tum"
    file.write_text(tum.text(Trajectory(poses.t_ns, poses.T_world_imu)))
    result = toolkit.compare(str(drive), ["dead-reckoning"], truth=file, trajectories={"theirs": file})
    assert result.metrics["theirs", "final"]["ate_se3_m"] == pytest.approx(0.0, abs=1e-9)
    assert result.metrics["dead-reckoning", "final"]["pairs"] == FRAMES


def test_the_real_beginning_of_06_is_found_from_images_alone(
    real: Callable[[str], Path], tmp_path: Path, run_estimator: Callable[..., Any]
) -> None:
    whole, root, frames = real("kitti06_images"), tmp_path / "06", 9
    for side in ("image_l", "image_r"):
        (root / side).mkdir(parents=True)
        for image in sorted((whole / side).iterdir())[:frames]:
            (root / side / image.name).symlink_to(image)
    shutil.copy(whole / "calib.txt", root)
    (root / "poses.txt").write_text("".join((whole / "poses.txt").read_text().splitlines(keepends=True)[:frames]))
    prepared = prepare(Recording(str(root)))
    assert np.bincount(prepared.sequence.observations.frame).min() >= 150
    run = run_estimator("batch", prepared.sequence, prepared.prior)
    assert run.status == "ok"
    truth = prepared.sequence.truth
    end, true = (np.linalg.norm(poses[-1, :3, 3]) for poses in (run.final.T_world_imu, truth.T_world_imu))
    # nearly all of the drift is a scale error of 1.6 %, which a stereo pair alone cannot see
    assert abs(end / true - 1.0) < 0.025


def test_images_are_numbered_by_the_end_of_their_names_where_these_are_no_numbers(drive: Path) -> None:
    before = load_sequence(str(drive)).observations.uv_px
    for path in list(drive.glob("image_?/*.png")):
        path.rename(path.with_stem(f"frame{path.stem}"))
    np.testing.assert_array_equal(load_sequence(str(drive)).observations.uv_px, before)
