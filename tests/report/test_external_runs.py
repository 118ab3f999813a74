"""A trajectory file becomes a run at the frames, or one line says why it is not of this recording."""

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from toolkit.answers import Run
from toolkit.datasets.trajectories import FORMATS, read_poses
from toolkit.errors import DataError
from toolkit.estimate import Trajectory
from toolkit.experiment.references import external_runs
from toolkit.geometry import Array, interpolate_poses, quaternion_from_rotation, rotation_from_quaternion, se3, se3_exp
from toolkit.metrics import score_run
from toolkit.motion_samples import TwistSamples
from toolkit.sequence import Sequence
from toolkit.simulation import DRIVE, FLIGHT, simulate

FREQUENT_NS = 10_000_000


@pytest.fixture(scope="module", params=["drive", "flight"])
def recording(request: pytest.FixtureRequest) -> Sequence:
    scenario = DRIVE if request.param == "drive" else FLIGHT
    return simulate(replace(scenario, duration_s=10.0), seed=2)


def truth_of(recording: Sequence) -> Trajectory:
    assert recording.truth is not None
    return Trajectory(recording.truth.t_ns, recording.truth.T_world_imu)


def read_as_run(
    folder: Path, trajectory: Trajectory, recording: Sequence, name: str = "tum", frames: int | None = None
) -> Run:
    path = folder / f"other.{name}"
    path.write_text(FORMATS[name].text(trajectory))
    sequence = recording if frames is None else recording.truncated(frames)
    (run,) = external_runs({"other": read_poses(path)}, recording, sequence)
    return run


def refusal(folder: Path, trajectory: Trajectory, recording: Sequence, name: str = "tum") -> str:
    with pytest.raises(DataError) as raised:
        read_as_run(folder, trajectory, recording, name)
    message = str(raised.value)
    assert f"other.{name}" in message
    assert "\n" not in message
    return message


@pytest.mark.parametrize("name", FORMATS)
def test_the_truth_in_any_format_is_without_error_and_says_what_it_cannot_tell(
    tmp_path: Path, recording: Sequence, name: str
) -> None:
    run = read_as_run(tmp_path, truth_of(recording), recording, name)
    assert (run.causal, run.timings, run.status) == (None, None, "ok")
    scores = score_run(run, "final", recording)
    assert scores.values["ate_none_m"] == pytest.approx(0.0, abs=1e-9)
    assert scores.values["coverage_percent"] == 100.0
    assert scores.values["pairs"] == recording.frame_count
    assert scores.notes["nees_pose_mean"] == "the estimator states no covariance"
    assert scores.notes["total_s"] == "not run here"
    assert "not run here" in run.log[0]
    assert "listed as final" in run.log[1]


def test_poses_at_other_stamps_are_taken_to_the_frames(tmp_path: Path, recording: Sequence) -> None:
    truth, frames_t_ns = truth_of(recording), recording.frames_t_ns
    often_ns = np.arange(frames_t_ns[0] + 3_000_000, frames_t_ns[-1], FREQUENT_NS)
    often = Trajectory(often_ns, interpolate_poses(truth.t_ns, truth.T_world_imu, often_ns))
    run = read_as_run(tmp_path, often, recording)
    assert run.final is not None
    np.testing.assert_array_equal(run.final.t_ns, frames_t_ns[1:-1])  # no pose lies before the first or after the last
    # what the straight line over a hundredth of a second leaves of the path
    np.testing.assert_allclose(run.final.positions, truth.positions[1:-1], atol=1e-3)
    scores = score_run(run, "final", recording).values
    assert scores["pairs"] == recording.frame_count - 2


@pytest.mark.parametrize("seed", range(3))
def test_a_poor_estimate_is_no_wrong_file(tmp_path: Path, recording: Sequence, seed: int) -> None:
    truth, rng = truth_of(recording), np.random.default_rng(seed)
    jitter = se3_exp(rng.normal(0.0, [0.02] * 3 + [0.2] * 3, (len(truth), 6)))
    drift = se3_exp(np.linspace(0.0, 1.0, len(truth))[:, None] * rng.normal(0.0, [0.3] * 3 + [20.0] * 3))
    run = read_as_run(tmp_path, Trajectory(truth.t_ns, drift @ truth.T_world_imu @ jitter), recording)
    assert run.final is not None
    assert len(run.final) == recording.frame_count


def test_a_straight_drive_w_first_is_named_though_no_gyro_decides(tmp_path: Path) -> None:
    recording = simulate(replace(DRIVE, duration_s=10.0), seed=2)
    assert isinstance(recording.motion, TwistSamples)
    still = replace(recording.motion, w_radps=np.zeros_like(recording.motion.w_radps))
    straight = replace(recording, motion=still)
    forward = np.zeros((recording.frame_count, 3))
    forward[:, 0] = np.arange(recording.frame_count)
    upside_down = np.broadcast_to(np.diag([1.0, -1.0, -1.0]), (recording.frame_count, 3, 3))
    mistaken = Trajectory(recording.frames_t_ns, se3(upside_down, forward))
    assert "the quaternions look w first" in refusal(tmp_path, mistaken, straight)


def test_milliseconds_at_a_high_rate_are_named_beside_the_recording(tmp_path: Path, recording: Sequence) -> None:
    """Steps of five milliseconds read as five seconds could be a trajectory; beside the frames they cannot."""
    frames_t_ns = recording.frames_t_ns
    from_zero = replace(recording, frames_t_ns=frames_t_ns - frames_t_ns[0], truth=None)
    t_ns = np.arange(0, int(frames_t_ns[-1] - frames_t_ns[0]), 5_000_000)
    poses = np.broadcast_to(np.eye(4), (t_ns.size, 4, 4))
    message = refusal(tmp_path, Trajectory(1000 * t_ns, poses), from_zero)
    assert "they fit only in another unit of time; multiply the stamps by 0.001" in message


def test_kitti_rows_are_the_frames_all_of_them_or_those_compared(tmp_path: Path, recording: Sequence) -> None:
    truth = truth_of(recording)
    for rows in (recording.frame_count, 20):
        run = read_as_run(tmp_path, Trajectory(truth.t_ns[:rows], truth.T_world_imu[:rows]), recording, "kitti", 20)
        assert run.final is not None
        np.testing.assert_array_equal(run.final.t_ns, recording.frames_t_ns[:20])
        np.testing.assert_allclose(run.final.T_world_imu, truth.T_world_imu[:20], atol=1e-9)
    few = Trajectory(truth.t_ns[:21], truth.T_world_imu[:21])
    message = refusal(tmp_path, few, recording, "kitti")
    assert f"21 rows, but a KITTI file has one for every frame, and there are {recording.frame_count};" in message


@pytest.mark.parametrize("scale", [0.3, 1.0, 1.3])
def test_another_scale_is_remarked_on_without_a_truth(tmp_path: Path, recording: Sequence, scale: float) -> None:
    """By the camera's own steps, which an estimate of any other scale does not make."""
    truth = truth_of(recording)
    scaled = Trajectory(truth.t_ns, se3(truth.T_world_imu[:, :3, :3], scale * truth.positions))
    run = read_as_run(tmp_path, scaled, replace(recording, truth=None))
    reported = [re.search(r"its steps are (\S+) \+- (\S+) times as long", entry) for entry in run.log]
    (found,) = [match for match in reported if match] or [None]
    assert (found is None) == (scale == 1.0)
    if found is not None:
        assert float(found[1]) == pytest.approx(scale, rel=0.02)  # the noise of the tracks lengthens vision's steps


def _turned(trajectory: Trajectory, rotations: Array) -> Trajectory:
    return Trajectory(trajectory.t_ns, se3(rotations, trajectory.positions))


def _rolled(given: Trajectory, places: int) -> Trajectory:
    quaternions = np.roll(quaternion_from_rotation(given.T_world_imu[:, :3, :3]), places, axis=1)
    return _turned(given, rotation_from_quaternion(quaternions))


def _later(given: Trajectory, shift_s: float) -> Trajectory:
    return Trajectory(given.t_ns + round(shift_s * 1e9), given.T_world_imu)


MISTAKES: dict[str, tuple[Callable[[Trajectory, Sequence], Trajectory], str, str]] = {
    "w first": (lambda given, _: _rolled(given, 1), "tum", "the quaternions look w first"),
    "w last": (lambda given, _: _rolled(given, -1), "euroc", "the quaternions look w last"),
    "world to IMU": (
        lambda given, _: _turned(given, np.swapaxes(given.T_world_imu[:, :3, :3], 1, 2)),
        "openvins",
        "those of the world to the IMU, as JPL and Hamilton mixed up: conjugate them",
    ),
    "camera": (
        lambda given, recording: Trajectory(given.t_ns, given.T_world_imu @ recording.rig.T_imu_cam),
        "kitti",
        "the poses look like the left camera's",
    ),
    "millimetres": (
        lambda given, _: Trajectory(given.t_ns, se3(given.T_world_imu[:, :3, :3], 1000.0 * given.positions)),
        "tum",
        "it is in millimetres: divide its positions by 1000",
    ),
    "own clock": (lambda given, _: _later(given, -1.6e9), "tum", "counts from its own start: add"),
    "time zone": (lambda given, _: _later(given, 7200.0), "tum", "as time zones are"),
    "another drive": (lambda given, _: _later(given, 5000.0), "tum", "another drive or clock"),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_is_named_with_its_remedy(tmp_path: Path, recording: Sequence, mistake: str) -> None:
    make, name, expected = MISTAKES[mistake]
    assert expected in refusal(tmp_path, make(truth_of(recording), recording), recording, name)


def test_poses_in_exchanged_axes_are_named_where_a_truth_shows_them(tmp_path: Path) -> None:
    recording = simulate(replace(FLIGHT, duration_s=10.0), seed=2)
    truth = truth_of(recording)
    exchanged = Trajectory(truth.t_ns, se3(truth.T_world_imu[:, :3, :3], truth.positions[:, [0, 2, 1]]))
    assert "with y and z exchanged (positions alone)" in refusal(tmp_path, exchanged, recording)
