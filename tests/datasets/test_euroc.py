"""EuRoC recordings: both layouts, the choice among truths, the simulated tracks, and malformed folders."""

import functools
import itertools
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from tests.frontend.conftest import IMU_NOISE, camera_yaml, write_asl
from toolkit.datasets import euroc, load_sequence
from toolkit.datasets.io.euroc_calibration import ACCEL_FACTOR, GYRO_FACTOR
from toolkit.datasets.io.fields import read_fields
from toolkit.errors import DataError
from toolkit.frontend import Camera
from toolkit.geometry import Array, quaternion_from_rotation, se3, se3_inverse, so3_exp, so3_log, transform
from toolkit.measurements import ImuMotion, ImuNoise
from toolkit.models.stereo import project, triangulate
from toolkit.sequence import Sequence

# As large as today's stamps, and no multiple of what a double can tell apart.
START_NS = 1_403_715_273_262_142_977
AXIS = np.array([0.6, 0.0, 0.8])
CAMERA, TRUTH = (
    Camera((458.0, 457.0, 367.0, 248.0), "none", np.zeros(4), (752, 480)),
    "mav0/state_groundtruth_estimate0/data.csv",
)
IMU_HEADER = (
    "#timestamp [ns],w_RS_S_x [rad s^-1],w_RS_S_y [rad s^-1],w_RS_S_z [rad s^-1],a_RS_S_x [m s^-2],a_RS_S_y,a_RS_S_z"
)
POSE = "p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m],q_RS_w [],q_RS_x [],q_RS_y [],q_RS_z []"
MOTION = ",".join(f"{n}_{a}" for n in ("v_RS_R", "b_w_RS_S", "b_a_RS_S") for a in "xyz")
# The camera looks along the IMU's x, and the right one stands on the side of its -y.
T_IMU_CAM0 = se3(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]), np.array([-0.02, 0.05, 0.01]))
T_IMU_CAM1 = se3(T_IMU_CAM0[:3, :3], np.array([-0.02, -0.06, 0.01]))
TURNED = so3_exp(np.array([0.0, 0.2, 0.0]))


def angle(t_s: Array) -> Array:
    return 0.5 * np.sin(2.0 * t_s)


def orientations(t_s: Array) -> Array:
    """Return R_world_imu (N, 3, 3) of a body that swings about an axis fixed in it."""
    return so3_exp(angle(t_s)[:, None] * AXIS)


def rows_of(t_s: Array, *columns: Array) -> str:
    stamps = START_NS + np.rint(t_s * 1e9).astype(np.int64)
    table = np.column_stack(columns)
    return "".join(f"{t},{','.join(f'{x:.12g}' for x in row)}\n" for t, row in zip(stamps.tolist(), table, strict=True))


def truth_text(t_s: Array, R_world_imu: Array) -> str:
    position = np.stack([0.5 * t_s, np.zeros_like(t_s), np.ones_like(t_s)], axis=1)
    w_first = np.roll(quaternion_from_rotation(R_world_imu), 1, axis=1)
    rest = np.tile([0.5, 0.0, 0.0, 0.01, 0.02, 0.03, 0.1, 0.2, 0.3], (t_s.size, 1))
    return f"#timestamp,{POSE},{MOTION}\n" + rows_of(t_s, position, w_first, rest)


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    """Return an ASL folder of 3 s; the truth covers the time from 0.5 to 2.5 s."""
    root = tmp_path / "swing"
    t_s = np.arange(0.0, 3.0, 0.005)
    gyro = np.cos(2.0 * t_s)[:, None] * AXIS + [0.01, 0.02, 0.03]
    write_asl(root, CAMERA, [T_IMU_CAM0, T_IMU_CAM1], [START_NS + 1_250_000 + 50_000_000 * k for k in range(60)])
    motion = rows_of(t_s, gyro, np.tile([1.0, 2.0, 9.81], (t_s.size, 1)))
    (root / "mav0/imu0/data.csv").write_text(f"{IMU_HEADER}\n{motion}")
    truth_s = np.arange(0.5, 2.5, 0.005)
    (root / TRUTH).parent.mkdir()
    (root / TRUTH).write_text(truth_text(truth_s, orientations(truth_s)))
    return root


def lean(recording: Path) -> Path:
    """Return the same recording in the lean layout, without any sensor.yaml."""
    folder = recording.parent / "lean"
    mav0 = recording / "mav0"
    folder.mkdir()
    shutil.copy(mav0 / "imu0/data.csv", folder / "imu.csv")
    shutil.copy(mav0 / "state_groundtruth_estimate0/data.csv", folder / "any_name.csv")
    stamps = [line.partition(",")[0] for line in (mav0 / "cam0/data.csv").read_text().splitlines()[1:]]
    (folder / "cam_timestamps_ns.txt").write_text("\n".join(stamps) + "\n")
    return folder


def test_the_layout_decides_and_not_the_name(recording: Path) -> None:
    assert euroc.recognises(recording)
    assert euroc.recognises(recording / "mav0")
    assert euroc.recognises(lean(recording))
    assert not euroc.recognises(recording / "mav0" / "cam0")
    assert not euroc.recognises(recording / "mav0" / "imu0" / "data.csv")


def test_motion_calibration_and_noise_land_in_their_fields(recording: Path) -> None:
    sequence = load_sequence(str(recording))
    rig, motion = sequence.rig, sequence.motion
    assert motion.t_ns[0] == START_NS
    np.testing.assert_allclose(motion.values[0], [1.0, 2.0, 9.81, *np.add(AXIS, [0.01, 0.02, 0.03])], rtol=1e-11)
    assert (rig.fx_px, rig.fy_px, rig.cx_px, rig.cy_px) == (458.0, 457.0, 367.0, 248.0)
    assert rig.baseline_m == pytest.approx(0.11)
    np.testing.assert_allclose(rig.T_imu_cam, T_IMU_CAM0, atol=1e-12)
    np.testing.assert_array_equal(rig.cov_uv_px2, np.diag([0.25, 0.25, 0.125]))
    assert isinstance(sequence.noise, ImuNoise)
    assert sequence.noise.accel_random_walk == 3e-3
    assert sequence.noise.gyro_random_walk == 1.9393e-5
    # in flight, against the stated 1.6968e-4 and 2e-3 at rest
    assert sequence.noise.gyro_noise_density == pytest.approx(GYRO_FACTOR * 1.6968e-4)
    assert sequence.noise.accel_noise_density == pytest.approx(ACCEL_FACTOR * 2e-3)


def test_extrinsics_are_made_relative_to_an_imu_that_is_not_the_body(recording: Path) -> None:
    T_body_imu = se3(so3_exp(np.array([0.3, -0.2, 0.1])), np.array([0.1, 0.2, 0.3]))
    (recording / "mav0/imu0/sensor.yaml").write_text(camera_yaml(CAMERA, T_body_imu) + IMU_NOISE)
    rig = load_sequence(str(recording)).rig
    np.testing.assert_allclose(rig.T_imu_cam, se3_inverse(T_body_imu) @ T_IMU_CAM0, atol=1e-10)


def test_a_wrong_row_of_a_truth_is_named_as_an_editor_counts_it(recording: Path) -> None:
    file = recording / TRUTH
    heading, *rows = file.read_text().splitlines()
    rows[1] = rows[0]  # the same stamp
    file.write_text("\n".join(["# Of a program.", "", heading, "", *rows]))
    with pytest.raises(DataError, match=r"data\.csv: line 6 "):
        euroc.load(recording)


def test_a_truth_of_another_body_is_moved_to_the_imu(recording: Path) -> None:
    before = load_sequence(str(recording)).truth
    T_body_sensor = se3(so3_exp(np.array([0.0, 0.0, 0.4])), np.array([0.1, 0.0, -0.2]))
    (recording / "mav0/state_groundtruth_estimate0/sensor.yaml").write_text(camera_yaml(CAMERA, T_body_sensor))
    after = load_sequence(str(recording)).truth
    np.testing.assert_allclose(after.T_world_imu[::10] @ T_body_sensor, before.T_world_imu[::10], atol=1e-9)
    assert after.v_world is None
    assert after.bias is None


def test_frames_lie_inside_the_truth_which_is_interpolated_there(recording: Path) -> None:
    sequence = load_sequence(str(recording))
    truth = sequence.truth
    np.testing.assert_array_equal(truth.t_ns, sequence.frames_t_ns)
    t_s = (sequence.frames_t_ns - START_NS) / 1e9
    assert t_s[0] == pytest.approx(0.50125)
    assert t_s[-1] == pytest.approx(2.45125)
    # the swing's angular acceleration of 2 rad/s^2 leaves a chord over 5 ms by 6e-6 rad
    np.testing.assert_allclose(truth.T_world_imu[:, :3, :3], orientations(t_s), atol=1e-5)
    np.testing.assert_allclose(truth.T_world_imu[:, 0, 3], 0.5 * t_s, atol=1e-5)
    np.testing.assert_allclose(truth.bias[3], [0.1, 0.2, 0.3, 0.01, 0.02, 0.03])


def test_no_frame_lies_in_a_gap_of_the_truth(recording: Path) -> None:
    truth_s = np.concatenate([np.arange(0.5, 1.0, 0.005), np.arange(1.5, 2.5, 0.005)])
    (recording / TRUTH).write_text(truth_text(truth_s, orientations(truth_s)))
    t_s = (load_sequence(str(recording)).frames_t_ns - START_NS) / 1e9
    assert not ((t_s > 0.995) & (t_s < 1.5)).any()
    assert ((t_s < 0.99).sum(), (t_s > 1.5).sum()) == (10, 20)


def test_of_two_truths_the_one_that_turns_as_the_gyro_says_is_used(recording: Path) -> None:
    truth_s = np.arange(0.5, 2.5, 0.005)
    good, turned = orientations(truth_s), orientations(truth_s) @ TURNED
    (recording / TRUTH).write_text(truth_text(truth_s, turned))
    (recording / "again.csv").write_text(truth_text(truth_s, good))
    sequence = load_sequence(str(recording))
    assert sequence.provenance.facts[1].startswith("the truth is again.csv, the better")
    t_s = (sequence.frames_t_ns - START_NS) / 1e9
    np.testing.assert_allclose(sequence.truth.T_world_imu[:, :3, :3], orientations(t_s), atol=1e-5)


def test_the_lean_layout_has_the_published_calibration_and_says_so(recording: Path) -> None:
    sequence = load_sequence(str(lean(recording)))
    assert sequence.rig.baseline_m == pytest.approx(0.110078, abs=1e-6)  # the distance of the two published positions
    assert "as published" in sequence.provenance.facts[2]
    whole = load_sequence(str(recording))
    np.testing.assert_array_equal(sequence.frames_t_ns, whole.frames_t_ns)
    np.testing.assert_array_equal(sequence.motion.values, whole.motion.values)


def test_tracks_have_the_stated_number_noise_and_short_lives(recording: Path) -> None:
    sequence = load_sequence(str(recording))
    truth, seen, rig = sequence.truth, sequence.observations, sequence.rig
    per_frame = np.bincount(seen.frame, minlength=sequence.frame_count)
    assert per_frame.max() == 100
    here, there = seen.frame == 20, seen.frame == 21
    _, before, after = np.intersect1d(seen.track_id[here], seen.track_id[there], return_indices=True)
    assert before.size > 60
    T_world_cam = truth.T_world_imu[20:22] @ rig.T_imu_cam
    points = transform(se3_inverse(T_world_cam[1]) @ T_world_cam[0], triangulate(seen.uv_px[here][before], rig))
    off_px = seen.uv_px[there][after] - project(points, rig)
    # v is the mean of two rows; with the first frame's noise carried over each coordinate is off by sqrt(2) sigma
    assert off_px[:, 0].std() == pytest.approx(0.5 * np.sqrt(2.0), rel=0.35)
    assert off_px[:, 2].std() == pytest.approx(0.5, rel=0.35)
    # one in fifty ends by chance at each frame
    lives = np.bincount(seen.track_id)
    assert np.median(lives) < sequence.frame_count


def test_the_seed_draws_the_noise_and_nothing_else(recording: Path) -> None:
    same, again, other = (euroc.load_with_seed(recording, seed) for seed in (0, 0, 1))
    assert euroc.load(recording).content_hash() == same.content_hash() == again.content_hash()
    assert other.content_hash() != same.content_hash()
    assert other.provenance.source.endswith("seed 1")
    np.testing.assert_array_equal(other.motion.values, same.motion.values)
    np.testing.assert_array_equal(other.truth.T_world_imu, same.truth.T_world_imu)


@functools.cache
def loaded(path: Path) -> Sequence:
    """Return a real recording, read once for all the tests: that takes seconds."""
    return load_sequence(str(path))


@pytest.mark.parametrize("name", ["V1_01_easy", "V2_01_easy"])
def test_the_noise_covers_what_the_real_imu_and_the_truth_differ_by_between_frames(
    real: Callable[[str], Path], name: str
) -> None:
    sequence = loaded(real(f"euroc/{name}"))
    truth, noise = sequence.truth, sequence.noise
    assert isinstance(noise, ImuNoise)
    R_world_imu, turned = truth.T_world_imu[:, :3, :3], np.zeros((sequence.frame_count - 1, 3))
    for packet in itertools.islice(sequence.packets(), 1, None):
        motion, k = packet.motion, packet.index
        assert isinstance(motion, ImuMotion)
        steps = so3_exp(motion.dt_s[:, None] * (motion.gyro_radps - truth.bias[k, 3:]))
        measured = functools.reduce(np.matmul, steps)
        turned[k - 1] = so3_log(measured.T @ R_world_imu[k - 1].T @ R_world_imu[k])
    density = turned.std(axis=0) / np.sqrt(0.05)
    stated = noise.gyro_noise_density / GYRO_FACTOR
    assert density.max() > 1.5 * stated
    assert density.max() < noise.gyro_noise_density


def test_the_recomputed_truth_of_v1_01_is_chosen_over_the_original(real: Callable[[str], Path]) -> None:
    sequence = loaded(real("euroc/V1_01_easy"))
    assert sequence.provenance.facts[1].startswith("the truth is ground_truth_recomputed_20hz.csv, the better")


def test_a_rig_of_many_cameras_may_share_what_they_have(tmp_path: Path) -> None:
    shared = "".join(f"cam{i}:\n  T: *T\n  resolution: *size\n" for i in range(1, 9))
    (tmp_path / "rig.yaml").write_text(f"cam0:\n  T: &T [[1, 0], [0, 1]]\n  resolution: &size [3, 2]\n{shared}")
    np.testing.assert_array_equal(read_fields(tmp_path / "rig.yaml").arrays["cam8.T"], np.eye(2))
