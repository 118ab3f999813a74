"""What no estimator, start, metric or audit may depend on: the world's origin and heading, track ids, the clock's zero,
and which side is left. Answers to the same recording in other coordinates are the same answers in those.
"""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from toolkit import runner
from toolkit.answers import Run
from toolkit.audit import audit
from toolkit.errors import EstimatorError
from toolkit.estimate import Trajectory
from toolkit.geometry import Array, about_z, se3, se3_inverse, se3_log
from toolkit.initialization import start_from_measurements
from toolkit.measurements import Prior
from toolkit.metrics import score_run
from toolkit.registry import discover, find
from toolkit.sequence import Observations, Sequence, is_held_out
from toolkit.simulation import DRIVE, DRIVE_IMU, FLIGHT, faults, simulate
from toolkit.verify import short

SCENARIOS = {"drive": short(DRIVE, 1.5), "drive-imu": short(DRIVE_IMU, 1.5), "flight": short(FLIGHT, 1.0)}
SEED = 4
QUARTER, SHIFT_M, LATER_NS = 0.5 * np.pi, np.array([30.0, -20.0, 5.0]), 1_600_000_000_000_000_000
# Rounding of positions of tens of metres, 1e-14, which the worst conditioned of the windows with an IMU's biases take
# 1e5 times as large; of covariances, over the deviations they belong to.
ROUNDING, COV_ROUNDING = 1e-8, 1e-6
# In incremental smoothers a point stays linearised where it is until it moves by a centimetre along one of the world's
# axes, and the iterations of a triangulation are damped along these: this far that makes answers differ.
AXES_COUNT_FOR = 2e-4
# Of metrics, relative to their value or to one.
METRIC_ROUNDING = 1e-5
COSTS = {"frame_ms_mean", "frame_ms_p95", "frame_ms_max", "total_s", "cpu_s", "peak_rss_mb", "frame_cpu_ms_mean"}

# Reflections of the y-axis of body and world, and of the x-axis of the camera; a rotation vector keeps
# its component along the reflected axis, and the other two change sign.
_Y, _ROTATION = np.diag([1.0, -1.0, 1.0]), np.diag([-1.0, 1.0, -1.0])
_POSE_Y, _CAMERA_X = np.diag([1.0, -1.0, 1.0, 1.0]), np.diag([-1.0, 1.0, 1.0, 1.0])
# Of rotation, position, velocity and the biases [accel, gyro], in the body frame.
STATE_MIRROR = np.concatenate([np.diag(axis) for axis in (_ROTATION, _Y, _Y, _Y, _ROTATION)])
STATE_MIRROR.flags.writeable = False

both_kinds = pytest.mark.parametrize("scenario", ["drive", "flight"])


def turned(sequence: Sequence, yaw_rad: float, shift_m: Array) -> Sequence:
    """Return a recording in another world frame: rotated about the vertical, and then shifted by (3,) m.

    Truth and prior are expressed in it; the measurements stay.
    """
    T_new_old, truth, prior = se3(about_z(yaw_rad), shift_m), sequence.truth, sequence.prior
    R_new_old = T_new_old[:3, :3]
    truth = replace(truth, T_world_imu=T_new_old @ truth.T_world_imu, v_world=truth.v_world @ R_new_old.T)
    prior = replace(prior, T_world_imu=T_new_old @ prior.T_world_imu, v_world=R_new_old @ prior.v_world)
    return replace(sequence, truth=truth, prior=prior)


def delayed(sequence: Sequence, by_ns: int) -> Sequence:
    """Return a recording with all stamps ``by_ns`` nanoseconds later."""
    motion, truth = sequence.motion, sequence.truth
    return replace(
        sequence,
        frames_t_ns=sequence.frames_t_ns + by_ns,
        motion=motion.of(motion.t_ns + by_ns, motion.values),
        truth=replace(truth, t_ns=truth.t_ns + by_ns),
    )


def mirrored(sequence: Sequence) -> Sequence:
    """Return a recording as a mirror shows it: left is right, of body, world and images alike.

    The y-axes of body and world are reflected. The two cameras exchange their places, and columns are counted from the
    other side, so that the rig is an ordinary one again.
    """
    seen, rig, motion = sequence.observations, sequence.rig, sequence.motion
    prior, truth = sequence.prior, sequence.truth
    uv_px = seen.uv_px[:, [1, 0, 2]]
    uv_px[:, :2] = 2.0 * rig.cx_px - uv_px[:, :2]
    T_left_right = se3(np.eye(3), np.array([rig.baseline_m, 0.0, 0.0]))
    exchange = np.array([[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    return replace(
        sequence,
        rig=replace(
            rig,
            T_imu_cam=_POSE_Y @ rig.T_imu_cam @ T_left_right @ _CAMERA_X,
            cov_uv_px2=exchange @ rig.cov_uv_px2 @ exchange.T,
        ),
        observations=replace(seen, uv_px=uv_px),
        motion=motion.of(motion.t_ns, motion.values * np.concatenate([np.diag(_Y), np.diag(_ROTATION)])),
        gravity_world=_Y @ sequence.gravity_world,
        prior=replace(
            prior,
            T_world_imu=mirrored_poses(prior.T_world_imu),
            v_world=_Y @ prior.v_world,
            bias=STATE_MIRROR[9:] * prior.bias,
            cov=STATE_MIRROR[:, None] * prior.cov * STATE_MIRROR,
        ),
        truth=replace(
            truth,
            T_world_imu=mirrored_poses(truth.T_world_imu),
            v_world=truth.v_world @ _Y,
            bias=truth.bias * STATE_MIRROR[9:],
        ),
    )


def mirrored_poses(T_world_imu: Array) -> Array:
    """Return poses (..., 4, 4) as a mirror shows them, and those of a mirrored recording as they are."""
    return np.asarray(_POSE_Y @ T_world_imu @ _POSE_Y)


@cache
def recording(scenario: str) -> Sequence:
    return simulate(SCENARIOS[scenario], SEED)


def with_other_names(sequence: Sequence) -> Sequence:
    """Return a recording with large names of tracks in the opposite order; the same tracks are withheld."""
    seen = sequence.observations
    names, track = np.unique(seen.track_id, return_inverse=True)
    others = 10**9 + np.arange(40 * names.size)[::-1]
    withheld, new = is_held_out(names), np.empty_like(names)
    new[withheld], new[~withheld] = (others[is_held_out(others) == kind][: (withheld == kind).sum()] for kind in (1, 0))
    return replace(sequence, observations=Observations.sorted(seen.frame, new[track], seen.uv_px))


def as_it_is(sequence: Sequence) -> Sequence:
    return sequence


def retold(sequence: Sequence) -> Sequence:
    """Return a recording in another world, seen in a mirror, by other names and at another time."""
    return delayed(with_other_names(mirrored(turned(sequence, QUARTER, SHIFT_M))), LATER_NS)


def back(T_world_imu: Array, yaw_rad: float, in_mirror: bool) -> Array:
    """Return poses (..., 4, 4) in the world of the recording as it was."""
    poses = mirrored_poses(T_world_imu) if in_mirror else T_world_imu
    return np.asarray(se3_inverse(se3(about_z(yaw_rad), SHIFT_M)) @ poses)


def signs(size: int) -> Array:
    """Return what a mirror makes of a state (size,): pose and gyro bias, these with the velocity, or all."""
    whole = {9: np.r_[0:6, 12:15], 12: np.r_[0:9, 12:15]}.get(size, np.arange(size))
    return np.asarray(STATE_MIRROR[whole])


@cache
def run_on(name: str, scenario: str, how: str) -> Run:
    try:
        build = find(name).load()
    except EstimatorError as unavailable:
        pytest.skip(str(unavailable))
    told = {"as it is": as_it_is, "retold": retold, "turned": lambda s: turned(s, 2.0, SHIFT_M)}
    sequence = told[how](recording(scenario))
    return runner.run(name, build, sequence, sequence.prior)


def outputs(run: Run) -> list[Trajectory]:
    return [trajectory for trajectory in (run.causal, run.final) if trajectory is not None]


def apart(one: Trajectory, poses: Array) -> float:
    """Return how far poses are from those of a trajectory at most, in metres or radians."""
    return float(np.abs(se3_log(se3_inverse(one.T_world_imu) @ poses)).max())


@both_kinds
@pytest.mark.parametrize("name", sorted(discover()))
def test_an_estimator_answers_the_same_to_a_recording_in_other_coordinates(name: str, scenario: str) -> None:
    usual, other = run_on(name, scenario, "as it is"), run_on(name, scenario, "retold")
    assert usual.status == other.status == "ok"
    for one, two in zip(outputs(usual), outputs(other), strict=True):
        assert apart(one, back(two.T_world_imu, QUARTER, in_mirror=True)) < ROUNDING
        if one.cov is not None and two.cov is not None:
            sign, deviation = signs(one.cov.shape[1]), np.sqrt(np.einsum("nii->ni", one.cov))
            off = np.abs(one.cov - sign[:, None] * two.cov * sign)
            assert (off / (deviation[:, :, None] * deviation[:, None, :])).max() < COV_ROUNDING


@both_kinds
@pytest.mark.parametrize("name", sorted(discover()))
def test_no_axis_of_the_world_counts_for_more_than_others(name: str, scenario: str) -> None:
    usual, other = run_on(name, scenario, "as it is"), run_on(name, scenario, "turned")
    for one, two in zip(outputs(usual), outputs(other), strict=True):
        assert apart(one, back(two.T_world_imu, 2.0, in_mirror=False)) < AXES_COUNT_FOR


@both_kinds
def test_metrics_are_the_same_of_a_recording_in_other_coordinates(scenario: str) -> None:
    usual = score_run(run_on("ekf", scenario, "as it is"), "final", recording(scenario)).values
    other = score_run(run_on("ekf", scenario, "retold"), "final", retold(recording(scenario))).values
    measured = {key for key, value in usual.items() if value is not None} - COSTS
    assert {"ate_none_m", "ate_yaw_m", "rpe_1s_m", "heldout_reproj_median_px", "nees_pose_mean"} <= measured
    for key in measured:
        assert other[key] == pytest.approx(usual[key], rel=METRIC_ROUNDING, abs=METRIC_ROUNDING), key


def started(sequence: Sequence) -> Prior:
    return start_from_measurements(replace(sequence, prior=None))


@pytest.mark.parametrize("scenario", SCENARIOS)
def test_the_start_is_the_same_of_a_recording_in_other_coordinates(scenario: str) -> None:
    usual, other = started(recording(scenario)), started(retold(recording(scenario)))
    assert usual.source == other.source
    mirror = np.diag([1.0, -1.0, 1.0])
    np.testing.assert_allclose(mirrored_poses(other.T_world_imu), usual.T_world_imu, rtol=0, atol=ROUNDING)
    np.testing.assert_allclose(mirror @ other.v_world, usual.v_world, rtol=0, atol=ROUNDING)
    np.testing.assert_allclose(signs(15)[9:] * other.bias, usual.bias, rtol=0, atol=ROUNDING)
    np.testing.assert_allclose(signs(15)[:, None] * other.cov * signs(15), usual.cov, rtol=COV_ROUNDING, atol=ROUNDING)


@pytest.mark.parametrize(
    ("scenario", "plant"),
    [
        ("drive", as_it_is),
        ("flight", as_it_is),
        ("drive", faults.gyro_bias),
        ("drive", faults.camera_clock_step),
        ("drive", faults.moving_objects),
        ("drive-imu", faults.camera_clock),
        ("flight", faults.displaced_camera),
    ],
)
def test_the_audit_finds_the_same_in_a_recording_in_other_coordinates(scenario, plant) -> None:
    """Counts and verdicts; what was measured beside them has its signs.

    A wrong extrinsic told in a mirror is another fault, where it is that of other axes or of the inverse.
    """
    length_s = 6.0 if scenario == "flight" else 10.0
    planted = plant(simulate(replace(SCENARIOS[scenario], duration_s=length_s), SEED))
    usual, other = audit(planted), audit(retold(planted))
    assert [replace(found, detail="", spans_ns=()) for found in other.findings] == [
        replace(found, detail="", spans_ns=()) for found in usual.findings
    ]
    assert other.undecided.keys() == usual.undecided.keys()
