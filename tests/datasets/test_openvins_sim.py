"""Exports of the OpenVINS simulator: conventions, cuts, and malformed ones."""

import gzip
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from toolkit.datasets import load_sequence
from toolkit.measurements import NS_PER_S, ImuNoise
from toolkit.motion_samples import ImuSamples


def test_gravity_and_specific_force_agree_with_the_velocities_of_the_truth(real: Callable[[str], Path]) -> None:
    sequence = load_sequence(str(real("openvins_sim/euroc_V1_01_easy_rect_s0")))
    truth, motion = sequence.truth, sequence.motion
    assert isinstance(motion, ImuSamples)
    dt_s = (truth.t_ns[2:] - truth.t_ns[:-2]) / NS_PER_S
    accel_world = (truth.v_world[2:] - truth.v_world[:-2]) / dt_s[:, None] - sequence.gravity_world
    accel_imu = np.einsum("nji,nj->ni", truth.T_world_imu[1:-1, :3, :3], accel_world)
    nearest = np.searchsorted(motion.t_ns, truth.t_ns[1:-1])
    # differences over 0.2 s: gravity with the wrong sign would be off by 20 m/s^2
    assert np.abs(np.median(accel_imu - motion.accel_mps2[nearest], axis=0)).max() < 0.1


def test_frames_outside_the_imu_and_sightings_in_one_camera_are_dropped(openvins: Path) -> None:
    sequence = load_sequence(str(openvins))
    np.testing.assert_array_equal(sequence.frames_t_ns, [200_000_000, 300_000_000])
    np.testing.assert_array_equal(sequence.observations.frame, [0, 1])
    np.testing.assert_array_equal(sequence.observations.track_id, [6, 6])
    assert sum(1 for _ in sequence.packets()) == 2


def test_calibration_noise_and_truth_land_in_their_fields(openvins: Path) -> None:
    sequence = load_sequence(str(openvins))
    assert sequence.name == "export"
    assert sequence.rig.baseline_m == pytest.approx(0.11)
    np.testing.assert_array_equal(sequence.rig.cov_uv_px2, np.diag([4.0, 4.0, 2.0]))
    np.testing.assert_array_equal(sequence.observations.uv_px[0], [300.0, 290.0, 202.0])
    np.testing.assert_array_equal(sequence.motion.values[0], [1.0, 2.0, 9.8, 0.1, 0.2, 0.3])
    assert sequence.noise == ImuNoise(0.001, 0.001, 0.001, 0.001)
    assert sequence.gravity_world[2] == -9.8
    assert sequence.prior is None
    np.testing.assert_array_equal(sequence.truth.bias[0], [0.4, 0.5, 0.6, 0.1, 0.2, 0.3])
    np.testing.assert_array_equal(sequence.truth.T_world_imu[0, :3], [[1, 0, 0, 1], [0, 1, 0, 2], [0, 0, 1, 3]])


def test_gzipped_tables_are_the_same_recording(openvins: Path) -> None:
    plain = load_sequence(str(openvins)).content_hash()
    for table in list(openvins.glob("*.csv")):
        table.with_suffix(".csv.gz").write_bytes(gzip.compress(table.read_bytes()))
        table.unlink()
    assert load_sequence(str(openvins)).content_hash() == plain


def test_an_offset_of_the_clocks_that_is_stated_is_told(openvins: Path) -> None:
    calibration = openvins / "calib.json"
    stated = json.loads(calibration.read_text())
    for offset_s, told in ((0.0, False), (0.0052, True)):
        calibration.write_text(json.dumps({**stated, "t_cam_to_imu_offset": offset_s}))
        facts = load_sequence(str(openvins)).provenance.facts
        assert any("t_cam_to_imu_offset, +5.200 ms" in fact for fact in facts) == told
