"""The calibration that tracks and samples fit: exact where they are, honest where they err, told beyond its limits."""

import re
from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from tests.audit.conftest import unrepaired
from toolkit.audit import audit
from toolkit.audit.alignment import velocity_fit
from toolkit.audit.calibration import JUDGED, doubtful, hidden, lever_arm, wrong
from toolkit.audit.fault import Evidence, Symptom, Undecided
from toolkit.audit.self_calibration import (
    CHANGE,
    COMMON,
    GRAVITY,
    LEVER,
    PRIOR,
    RIGHT_ROLL,
    RIGHT_SHIFT,
    STATE,
    Calibration,
    KeyFrameWindow,
    SelfCalibration,
    _windows,
    imu_strides,
    predicted,
    self_calibration,
    stride_equations,
    twist_strides,
)
from toolkit.geometry import Array, se3, se3_inverse, so3_exp
from toolkit.measurements import ImuMotion, ImuNoise, MotionKind
from toolkit.models.imu import predict, preintegrate, preintegration_params
from toolkit.sequence import Sequence
from toolkit.simulation import DRIVE, DRIVE_IMU, FLIGHT, FLIGHT_REALISTIC, Scenario, faults, noise_free, simulate

# Shares of fx and fy, px of cx and cy, a share of the baseline, rad, m, s: by what the rig is off below.
OFF = np.array([0.03, -0.02, 8.0, -5.0, 0.04, 0.02, -0.01, 0.03, 0.05, -0.04, 0.03, 0.004, 0.0])


@cache
def recorded(scenario: Scenario, seed: int, duration_s: float = 4.0, varied: bool = False) -> Sequence:
    return simulate(replace(scenario, duration_s=duration_s, varied=varied), seed)


def fitted(sequence: Sequence) -> SelfCalibration:
    evidence = Evidence(sequence)
    assert evidence.intervals is not None
    found = self_calibration(sequence, evidence.camera_motion, evidence.intervals)
    assert found is not None
    return found


@pytest.mark.parametrize("scenario", [FLIGHT, DRIVE_IMU])
def test_a_stride_is_the_estimators_preintegration(scenario: Scenario) -> None:
    sequence, given = recorded(scenario, 0), np.array([0.0, 0.0, 0.0, 0.01, -0.02, 0.03])
    strides = imu_strides(sequence, sequence.frames_t_ns, given[3:])
    assert isinstance(sequence.noise, ImuNoise)
    params = preintegration_params(sequence.noise, np.zeros(3))
    motions = [packet.motion for packet in sequence.packets() if isinstance(packet.motion, ImuMotion)]
    ends = [predict(preintegrate(motion, given, params), np.eye(4), np.zeros(3), given) for motion in motions]
    T_a_b = np.array([end.T_world_imu for end in ends])
    np.testing.assert_allclose(strides.R_a_b, T_a_b[:, :3, :3], atol=1e-12)
    np.testing.assert_allclose(strides.faster, [end.v_world for end in ends], atol=1e-12)
    np.testing.assert_allclose(strides.moved, T_a_b[:, :3, 3], atol=1e-12)


@cache
def window_and_calibration(scenario: Scenario = FLIGHT) -> tuple[KeyFrameWindow, Calibration]:
    """A window of noisy measurements, and a calibration that is off: no residual is zero."""
    sequence = recorded(scenario, 0)
    (window,) = _windows(sequence, Evidence(sequence).camera_motion, np.zeros(3))
    step = np.concatenate([OFF[:12], [0.007, 0.01, -0.02, 0.03, 0.1, -0.2, 0.3], np.zeros(2)])
    return window._replace(later=0.5), Calibration(sequence.rig, 0.0, np.zeros(6)).moved(step)


def difference(residual: Callable[[float], Array], step: float = 1e-6) -> Array:
    """The derivative of a residual by a number, at zero."""
    return (residual(step) - residual(-step)) / (2.0 * step)


@pytest.mark.parametrize("column, unknown", list(enumerate([*range(13), RIGHT_SHIFT, RIGHT_ROLL])))
def test_sightings_change_with_the_calibration_as_their_jacobian_says(column: int, unknown: int) -> None:
    window, calibration = window_and_calibration()
    one = np.eye(COMMON)[unknown]
    measured = difference(lambda step: predicted(window, calibration.moved(step * one)).uv_px)
    np.testing.assert_allclose(predicted(window, calibration).d_seen[:, :, 6 + column], measured, rtol=1e-5, atol=1e-4)


@pytest.mark.parametrize("unknown", range(6))
def test_sightings_change_with_the_pose_and_the_point_as_their_jacobians_say(unknown: int) -> None:
    window, calibration = window_and_calibration()
    calibration = calibration._replace(late_s=0.0, change_s=0.0)  # the Jacobians leave out what its milliseconds change
    here, none = predicted(window, calibration), np.zeros_like(window.points)

    def posed(step: float) -> Array:
        own = np.zeros(window.unknowns)
        own[unknown:-GRAVITY:STATE] = step
        return predicted(window.moved(own, none), calibration).uv_px

    np.testing.assert_allclose(here.d_seen[:, :, unknown], difference(posed), rtol=1e-5, atol=1e-4)
    if unknown < 3:
        along = difference(
            lambda step: predicted(window._replace(points=window.points + step * np.eye(3)[unknown]), calibration).uv_px
        )
        np.testing.assert_allclose(here.d_point[:, :, unknown], along, rtol=1e-5, atol=1e-4)


# Of the states at both ends, 9 numbers each, of gravity, and of the biases.
@pytest.mark.parametrize("unknown", range(27))
@pytest.mark.parametrize("scenario", [FLIGHT, DRIVE], ids=lambda scenario: scenario.name)
def test_what_strides_lack_changes_as_their_jacobian_says(unknown: int, scenario: Scenario) -> None:
    window, calibration = window_and_calibration(scenario)
    key = 3

    def lacking(step: float) -> Array:
        own, common = np.zeros(window.unknowns), np.zeros(COMMON)
        if unknown < 2 * STATE:
            own[STATE * key + unknown] = step
        elif unknown < 2 * STATE + GRAVITY:
            own[unknown - 2 * STATE - GRAVITY] = step
        else:
            common[13 + unknown - 2 * STATE - GRAVITY] = step
        after = window.moved(own, np.zeros_like(window.points))
        return -stride_equations(after, calibration.moved(common))[0][key]

    jacobian = stride_equations(window, calibration)[1][key, :, unknown]
    # A turn's Jacobian is that of a residual of zero; it is 0.02 rad here, and half of it is left out.
    np.testing.assert_allclose(jacobian, difference(lacking), atol=0.02)


def test_the_calibration_of_exact_measurements_is_found() -> None:
    sound = recorded(noise_free(FLIGHT), 0)
    rig = Calibration(sound.rig, 0.0, np.zeros(6)).moved(np.concatenate([OFF, np.zeros(COMMON - OFF.size)])).rig
    found = fitted(replace(faults.camera_clock(sound, -OFF[11]), rig=rig))
    expected = -OFF.copy()
    expected[5:8] = so3_exp(OFF[5:8]) @ expected[5:8]  # about the axes of the camera that is turned
    expected[11] = OFF[11]
    # Within a third of what noise of a pixel leaves; late by milliseconds counts to first order alone.
    np.testing.assert_array_less(np.abs(found.value[:13] - expected), 0.34 * found.error[:13] + 1e-4)


def test_beside_odometry_strides_of_exact_twists_and_the_calibration_of_exact_measurements_are_found() -> None:
    sound = recorded(noise_free(DRIVE), 0, 12.0)
    assert sound.truth is not None
    keys = np.arange(0, 60, 3)
    strides = twist_strides(sound, sound.frames_t_ns[keys], np.zeros(3))
    poses = sound.truth.T_world_imu[np.searchsorted(sound.truth.t_ns, sound.frames_t_ns[keys])]
    true = se3_inverse(poses[:-1]) @ poses[1:]
    # A twist stands for the whole of an interval, in which the car turns and slows down a little.
    np.testing.assert_allclose(strides.R_a_b, true[:, :3, :3], atol=5e-3)
    np.testing.assert_allclose(strides.moved, true[:, :3, 3], atol=0.05)
    off = np.array([0.04, -0.03, 8.0, -6.0, 0.0, 0.02, -0.01, 0.03])
    step = np.concatenate([off, np.zeros(COMMON - off.size)])
    found = fitted(replace(sound, rig=Calibration(sound.rig, 0.0, np.zeros(6)).moved(step).rig))
    expected = -off
    expected[5:] = so3_exp(off[5:]) @ expected[5:]
    # Twists between the frames are straight lines; within what the measurements' noise leaves.
    np.testing.assert_array_less(np.abs(found.value[: off.size] - expected), found.error[: off.size])


def test_what_the_right_image_is_off_by_is_found_in_exact_measurements() -> None:
    exact = recorded(noise_free(FLIGHT), 0)
    found = fitted(faults.rolled_right(faults.shifted_right(exact, 0.9), 0.01))
    right = [RIGHT_SHIFT, RIGHT_ROLL]
    # A tenth of what noise of a pixel leaves: 0.24 px and 0.0003 rad.
    np.testing.assert_array_less(np.abs(found.value[right] - [0.9, 0.01]), [0.024, 3e-5])
    assert (fitted(exact).value[right] == 0.0).all()  # held there


def test_a_right_image_that_hardly_any_parallax_shows_is_not_decidable() -> None:
    known = np.full(COMMON, 1e-6)
    for unknown, error, why in ((RIGHT_SHIFT, 0.12, "shifted by 0.5 px"), (RIGHT_ROLL, 0.0021, "rolled by 0.010 rad")):
        cov = np.diag(np.where(np.arange(COMMON) == unknown, error, known) ** 2)
        assert why in (hidden(SelfCalibration(np.zeros(COMMON), cov, 1), "imu") or "")


@pytest.mark.parametrize("scenario", [FLIGHT, FLIGHT_REALISTIC, DRIVE], ids=lambda scenario: scenario.name)
def test_standard_errors_are_honest_also_where_the_errors_of_tracks_are_correlated(scenario: Scenario) -> None:
    count, duration_s = (8, 12.0) if scenario is DRIVE else (12, 4.0)
    fits = [fitted(recorded(scenario, seed, duration_s, scenario is DRIVE and seed % 2 == 1)) for seed in range(40, 46)]
    sigmas = np.concatenate([found.value[:count] / found.error[:count] for found in fits])
    # 48 or 72 of them; the errors are no less than those of a gyro that filters, so they are a little large.
    assert 0.3 < np.mean(sigmas**2) < 1.8


def test_windows_that_want_different_calibrations_widen_the_error() -> None:
    sound = recorded(FLIGHT, 1, 16.0)
    jumped = faults.jumped_image(sound, 15.0)
    assert fitted(jumped).error[2] > 4.0 * fitted(sound).error[2]


def test_one_window_says_nothing_of_a_change_of_the_clock() -> None:
    found = fitted(recorded(FLIGHT, 0))
    assert found.windows == 1
    assert found.value[CHANGE] == pytest.approx(0.0, abs=1e-9)
    assert found.error[CHANGE] == pytest.approx(PRIOR["imu"][CHANGE], rel=1e-3)


def sure(unknown: int, value: float) -> SelfCalibration:
    """A calibration that differs from the given one in one thing, and is known well."""
    return SelfCalibration(value * np.eye(COMMON)[unknown], 1e-12 * np.eye(COMMON), 1)


@pytest.mark.parametrize("kind, sigmas", [("imu", 4.0), ("twist", 6.0)])
@pytest.mark.parametrize("name", JUDGED)
def test_a_parameter_counts_beyond_its_limit_and_its_standard_errors(
    name: str, kind: MotionKind, sigmas: float
) -> None:
    """Odometry's scale looks like the baseline and its pairing like the clock: these are not judged beside it."""
    one, rig = JUDGED[name], recorded(FLIGHT, 0).rig
    limit, row = one.limits[kind] if np.isfinite(one.limits[kind]) else 0.0, one.rows.start
    wrongs = wrong(sure(row, -1.01 * limit if limit else 1.0), rig, kind)
    assert [check for _, check in wrongs] == ([one.check] if limit else [])
    assert wrong(sure(row, 0.98 * limit), rig, kind) == []
    for beyond, wanted in ((sigmas - 0.1, False), (sigmas + 0.1, bool(limit))):
        value = (limit + beyond * (error := 0.1 * limit + 1e-9)) * np.eye(COMMON)[row]
        assert bool(wrong(SelfCalibration(value, error**2 * np.eye(COMMON), 1), rig, kind)) == wanted


def test_what_is_below_its_limit_is_doubted_and_the_error_that_is_reported_has_half_of_the_limit_in_it() -> None:
    rig = recorded(FLIGHT, 0).rig
    assert "right" in (doubtful(sure(RIGHT_SHIFT, 0.049), rig, "imu") or "")
    ((reported, _),) = wrong(sure(0, 0.2), rig, "twist")
    assert f"+- {0.03 * rig.fx_px * np.exp(0.2):.1f}" in reported


def with_position(lacking_m: Array, error_m: float, T_imu_cam: Array | None = None) -> Symptom | Undecided | None:
    """Return what is said where the self-calibration puts the camera so far from where it should be."""
    sequence, value = recorded(FLIGHT, 0), np.zeros(COMMON)
    rig = sequence.rig if T_imu_cam is None else replace(sequence.rig, T_imu_cam=T_imu_cam)
    evidence = Evidence(replace(sequence, rig=rig))
    value[LEVER] = lacking_m
    evidence.__dict__["self_calibration"] = SelfCalibration(value, error_m**2 * np.eye(COMMON), 1)
    return lever_arm(evidence)


@pytest.mark.parametrize("axis", range(3))
def test_a_position_counts_beyond_what_sound_recordings_have_and_four_standard_errors(axis: int) -> None:
    """Of the data alone: the prior of 0.3 m, which the self-calibration has, is taken off from both."""
    one = np.eye(3)[axis]
    assert with_position(0.98 * 0.015 * one, 1e-6) is None
    reported = with_position(1.01 * 0.015 * one, 1e-6)
    assert isinstance(reported, Symptom) and f"m along {'xyz'[axis]} from" in reported.detail
    assert with_position((0.015 + 3.9 * 0.02) * one, 0.02) is None
    assert isinstance(with_position((0.015 + 4.1 * 0.02) * one, 0.02), Symptom)
    unseen = with_position(0.0 * one, 0.15)
    assert isinstance(unseen, Undecided)
    assert "0.7 m along x, 0.7 m along y, 0.7 m along z would not show" in unseen.why


def test_beside_odometry_scale_and_position_are_measured_within_their_errors() -> None:
    sound = recorded(DRIVE, 5, 20.0)
    faulty = faults.displaced_camera(faults.stretched_disparity(sound, 1.1), 0.5, 1)
    found = Evidence(faulty).velocity_fit
    assert found is not None
    missing = sound.rig.T_imu_cam[:3, 3] - faulty.rig.T_imu_cam[:3, 3]
    # Four standard errors, and 1 % that the tracks' noise shortens the camera's motion by.
    assert found.scale.value == pytest.approx(1.0 / 1.1 - 1.0, abs=4.0 * found.scale.error + 0.01)
    assert (np.abs(found.position.lacking_m - missing) < 4.0 * found.position.error_m).all()
    assert found.position.error_m[0] < 0.1


def test_the_turn_of_a_camera_is_measured_about_the_axes_that_the_motion_determines() -> None:
    """A car drives ahead: its velocity tells pitch and yaw, and nothing of the roll."""
    intervals = Evidence(recorded(DRIVE, 3, 12.0)).intervals
    assert intervals is not None
    turned = se3(so3_exp(np.array([0.3, 0.03, -0.04])), np.zeros(3)) @ intervals.T_imu_cam
    turned[:3, 3] = intervals.T_imu_cam[:3, 3]
    found = velocity_fit(intervals._replace(T_imu_cam=turned), np.inf).turn
    assert found.rad.size == 2
    # Five of its standard errors, about 0.001 rad, and what the roll turns the sides into each other.
    assert np.linalg.norm(found.rad) == pytest.approx(0.05, abs=0.01)
    assert (np.abs(velocity_fit(intervals, np.inf).turn.rad) < 0.006).all()


def test_a_turned_camera_is_reported_on_five_seconds_of_a_drive() -> None:
    """Three stretches as long as slip lasts tell little of their own scatter; what real odometry has helps them out."""
    sound = recorded(DRIVE, 2, 5.0)
    assert "miscalibration" not in unrepaired(sound)
    assert "as if it were turned by" in unrepaired(faults.turned_camera(sound, 0.1, 2))["miscalibration"]


def test_a_scale_that_the_recording_hardly_shows_says_how_large_a_fault_it_hides() -> None:
    """What is a little larger is told, whichever way, and two percent are not blessed."""
    sound = recorded(FLIGHT, 5, 20.0)
    unseen = re.search(r"less than (\S+) % would not show", audit(sound).undecided["vision-scale"])
    assert unseen is not None and 2.0 < float(unseen[1]) < 5.0
    for sign in (1.0, -1.0):
        beyond = float(np.exp(sign * (0.01 * float(unseen[1]) + 0.003)))  # the windows' own change of the estimate
        assert "baseline" in unrepaired(faults.baseline_unit(sound, beyond))["miscalibration"]
    assert "would not show" in audit(faults.stretched_disparity(sound, 1.02)).undecided["vision-scale"]


def test_beside_odometry_the_windows_that_turn_are_taken() -> None:
    assert "fx off by" in audit(recorded(DRIVE, 0, 5.0)).undecided["miscalibration"]
    # The scenario goes straight ahead for most of a minute: windows that are spread know fx to one percent.
    assert fitted(recorded(DRIVE, 0, 60.0)).error[0] < 0.003


def test_an_offset_between_chance_and_certainty_is_not_decidable() -> None:
    """A car that hardly turns knows it to 5 ms: what is 3.7 standard errors is neither told nor ruled out."""
    late = faults.camera_clock(simulate(replace(DRIVE_IMU, duration_s=14.0, varied=True), 7301), 0.02)
    outcome = audit(late)
    assert "time-offset" not in {finding.fault for finding in outcome.findings}
    assert "frames look as if stamped late by 18 +- 5 ms" in outcome.undecided["time-offset"]


def test_a_focal_length_beyond_chance_and_below_what_counts_is_reported() -> None:
    """Two percent on 6 s of a flight are eight standard errors, and double the error of what is estimated."""
    sound = simulate(replace(FLIGHT, duration_s=6.0, varied=True), 7301)
    assert "more than chance" not in audit(sound).undecided.get("miscalibration", "")
    reported = audit(faults.wrong_focal_length(sound, 1.02))
    match = re.search(r"fit fx_px = (\S+) \+- (\S+), not", reported.undecided["miscalibration"])
    assert match is not None
    assert float(match[1]) == pytest.approx(sound.rig.fx_px, abs=4.0 * float(match[2]))
    assert "more than chance" in reported.undecided["miscalibration"]


def test_a_turned_camera_is_no_late_one() -> None:
    """Rotations alone have it 57 +- 5 ms late."""
    found = {finding.fault for finding in audit(faults.turned_camera(recorded(FLIGHT, 7, 6.0), 0.1, 7)).findings}
    assert "miscalibration" in found and "time-offset" not in found
