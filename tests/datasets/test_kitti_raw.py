"""KITTI raw drives: what the packets are read as, axes and truth, raw and rectified images, and broken folders."""

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from toolkit.datasets import load_sequence
from toolkit.geometry import se3
from toolkit.motion_samples import ImuSamples, TwistSamples

FRAMES, SPEED_MPS = 8, 0.5
DRIVE = "2011_09_26/2011_09_26_drive_0001_sync"
# The camera looks along the IMU's x and stands 0.3 m before and 0.1 m above it.
R_CAM_IMU = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
T_CAM_IMU = R_CAM_IMU @ -np.array([0.3, 0.0, 0.1])


def numbers(values: Any) -> str:
    return " ".join(f"{x:.9e}" for x in np.ravel(values))


def stamp(seconds: float) -> str:
    return f"2011-09-26 13:02:{25.0 + seconds:012.9f}\n"


def packet(t_s: float, yaw: float = 0.0, turning_radps: float = 0.0) -> str:
    """Return a packet of a drive to the east at constant speed; a metre is so many degrees on the equator."""
    east_deg = np.rad2deg(SPEED_MPS * t_s / 6378137.0)
    values = np.zeros(30)
    values[[1, 2, 5]] = east_deg, 110.0, yaw
    values[[7, 8]] = SPEED_MPS
    values[13], values[19] = 9.81, turning_radps
    return numbers(values)


def write_packets(drive: Path, rate_hz: float) -> None:
    shutil.rmtree(drive / "oxts", ignore_errors=True)
    (drive / "oxts/data").mkdir(parents=True)
    count = round(0.8 * rate_hz) + 1
    for k in range(count):
        (drive / f"oxts/data/{k:010d}.txt").write_text(packet(k / rate_hz))
    (drive / "oxts/timestamps.txt").write_text("".join(stamp(k / rate_hz) for k in range(count)))


@pytest.fixture
def drive(kitti_drive: Path, tmp_path: Path) -> Path:
    """Return the rendered drive as a synced one of 10 Hz."""
    root = tmp_path / DRIVE
    for side in (0, 1):
        shutil.copytree(kitti_drive / f"image_{side}", root / f"image_0{side}/data")
        (root / f"image_0{side}/timestamps.txt").write_text("".join(stamp(0.1 * k) for k in range(FRAMES)))
    write_packets(root, 10.0)
    lines = ["calib_time: 09-Jan-2012 13:57:47", "corner_dist: 9.95e-02"]
    K = np.array([[250.0, 0.0, 160.0], [0.0, 250.0, 100.0], [0.0, 0.0, 1.0]])
    for side in (0, 1):
        shift = np.array([-0.4 * side, 0.0, 0.0])
        P = np.hstack([K, (K @ shift)[:, None]])
        texts = {"S": [400, 260], "K": K, "D": np.zeros(5), "R": np.eye(3), "T": shift, "S_rect": [320, 200]}
        texts |= {"R_rect": np.eye(3), "P_rect": P}
        lines += [f"{key}_0{side}: {numbers(value)}" for key, value in texts.items()]
    day = root.parent
    (day / "calib_cam_to_cam.txt").write_text("\n".join(lines) + "\n")
    (day / "calib_velo_to_cam.txt").write_text(f"R: {numbers(R_CAM_IMU)}\nT: {numbers(T_CAM_IMU)}\n")
    (day / "calib_imu_to_velo.txt").write_text(f"R: {numbers(np.eye(3))}\nT: 0 0 0\n")
    return root


def test_slow_packets_are_twists_and_fast_ones_an_imu(drive: Path) -> None:
    slow = load_sequence(str(drive))
    assert isinstance(slow.motion, TwistSamples)
    np.testing.assert_allclose(slow.motion.v_mps, np.tile([SPEED_MPS, 0.0, 0.0], (9, 1)), atol=1e-9)
    write_packets(drive, 100.0)
    fast = load_sequence(str(drive))
    assert isinstance(fast.motion, ImuSamples)
    np.testing.assert_allclose(fast.motion.values[0], [0.0, 0.0, 9.81, 0.0, 0.0, 0.0])
    shutil.rmtree(drive / "oxts")
    assert load_sequence(str(drive)).motion_kind == "none"


def test_the_truth_is_east_north_up_and_of_the_same_instrument(drive: Path) -> None:
    truth = load_sequence(str(drive)).truth
    assert not truth.independent
    np.testing.assert_allclose(truth.T_world_imu[:, :3, 3], np.outer(0.05 * np.arange(9), [1.0, 0.0, 0.0]), atol=1e-6)
    # a car that heads north has its x along the world's y
    (drive / "oxts/data/0000000000.txt").write_text(packet(0.0, yaw=np.pi / 2.0, turning_radps=0.2))
    turned = load_sequence(str(drive))
    np.testing.assert_allclose(turned.truth.T_world_imu[0, :3, 0], [0.0, 1.0, 0.0], atol=1e-9)
    assert isinstance(turned.motion, TwistSamples)
    np.testing.assert_allclose(turned.motion.v_mps[0], [0.0, -SPEED_MPS, 0.0], atol=1e-9)
    np.testing.assert_allclose(turned.motion.w_radps[0], [0.0, 0.0, 0.2])


def test_the_camera_is_where_the_three_files_put_it(drive: Path) -> None:
    rig = load_sequence(str(drive)).rig
    np.testing.assert_allclose(rig.T_imu_cam, se3(R_CAM_IMU.T, np.array([0.3, 0.0, 0.1])), atol=1e-6)
    assert rig.baseline_m == pytest.approx(0.4)


def test_images_of_the_sensors_size_are_rectified_here(drive: Path) -> None:
    file = drive.parent / "calib_cam_to_cam.txt"
    as_raw = file.read_text().replace(f": {numbers([400, 260])}", ": 3.2e+02 2.0e+02")
    file.write_text(as_raw.replace(f"S_rect_00: {numbers([320, 200])}", "S_rect_00: 3.1e+02 1.9e+02"))
    sequence = load_sequence(str(drive))
    assert any("rectified with the day's calibration" in fact for fact in sequence.provenance.facts)
    np.testing.assert_allclose(sequence.rig.T_imu_cam, se3(R_CAM_IMU.T, np.array([0.3, 0.0, 0.1])), atol=1e-6)
    assert sequence.rig.baseline_m == pytest.approx(0.4)


def test_blank_and_late_stamps_are_left_out_or_sorted_and_reported(drive: Path) -> None:
    lines = [stamp(0.1 * k) for k in range(FRAMES)]
    lines[3], lines[4], lines[6] = lines[4], lines[3], "\n"
    (drive / "image_00/timestamps.txt").write_text("".join(lines))
    sequence = load_sequence(str(drive))
    assert (np.diff(sequence.frames_t_ns) > 0).all()
    assert sequence.frame_count == FRAMES - 1
    facts = " ".join(sequence.provenance.facts)
    assert "1 images have no stamp" in facts
    assert "out of order" in facts


def test_images_of_a_camera_that_dropped_one_are_paired_by_their_stamps(drive: Path) -> None:
    before = load_sequence(str(drive))
    right = drive / "image_01"
    stamps = (right / "timestamps.txt").read_text().splitlines(keepends=True)
    (right / "timestamps.txt").write_text("".join(stamps[:2] + stamps[3:]))
    names = sorted((right / "data").iterdir())
    names[2].unlink()
    for path, name in zip(names[3:], names[2:], strict=False):
        path.rename(name)
    sequence = load_sequence(str(drive))
    assert sequence.frames_t_ns.tolist() == [*before.frames_t_ns[:2].tolist(), *before.frames_t_ns[3:].tolist()]
    assert any("paired by their stamps" in fact for fact in sequence.provenance.facts)
    assert any("1 left images have no right one" in fact for fact in sequence.provenance.facts)


def test_packets_without_a_stamp_and_stamps_without_a_packet_are_counted(drive: Path) -> None:
    (drive / "oxts/data/0000000003.txt").unlink()
    (drive / "oxts/data/0000000099.txt").write_text(packet(9.9))
    sequence = load_sequence(str(drive))
    assert sequence.motion.t_ns.size == FRAMES
    assert "2 oxts packets lack their file or their stamp and are left out" in sequence.provenance.facts
