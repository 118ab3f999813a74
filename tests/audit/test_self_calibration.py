"""The calibration that tracks and an IMU fit: exact where they are, honest where they err, told beyond its limits."""

import re
from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from toolkit.audit import audit
from toolkit.audit.bundle import (
    CHANGE,
    COMMON,
    RIGHT_ROLL,
    RIGHT_SHIFT,
    Calibration,
    KeyFrameWindow,
    imu_strides,
    predicted,
    stride_equations,
)
from toolkit.audit.calibration import doubtful, hidden, wrong
from toolkit.audit.fault import Evidence
from toolkit.audit.self_calibration import OFF_BY, SelfCalibration, _windows, self_calibration
from toolkit.geometry import Array, so3_exp, so3_log
from toolkit.measurements import ImuMotion, ImuNoise, StereoRig
from toolkit.models.imu import preintegrate, preintegration_params
from toolkit.sequence import Sequence
from toolkit.simulation import DRIVE, DRIVE_IMU, FLIGHT, FLIGHT_REALISTIC, Scenario, faults, noise_free, simulate

# Shares of fx and fy, px of cx and cy, a share of the baseline, rad, m, s: by what the rig is off below.
OFF = np.array([0.03, -0.02, 8.0, -5.0, 0.04, 0.02, -0.01, 0.03, 0.05, -0.04, 0.03, 0.004, 0.0])


@cache
def recorded(scenario: Scenario, seed: int, duration_s: float = 4.0) -> Sequence:
    return simulate(replace(scenario, duration_s=duration_s), seed)


def fitted(sequence: Sequence) -> SelfCalibration:
    evidence = Evidence(sequence)
    assert evidence.intervals is not None
    found = self_calibration(sequence, evidence.camera_motion, evidence.intervals)
    assert found is not None
    return found


@pytest.mark.parametrize("scenario", [FLIGHT, DRIVE_IMU])
def test_a_stride_is_what_gtsam_preintegrates_and_changes_with_the_biases_alike(scenario: Scenario) -> None:
    """Of the same samples, cut otherwise: steps of 20 ms differ by some thousandths of the largest."""
    sequence, w_bias = recorded(scenario, 0), np.array([0.01, -0.02, 0.03])
    strides = imu_strides(sequence, sequence.frames_t_ns, w_bias)
    assert isinstance(sequence.noise, ImuNoise)
    params = preintegration_params(sequence.noise, sequence.gravity_world)
    motions = [packet.motion for packet in sequence.packets() if isinstance(packet.motion, ImuMotion)]

    def gtsam_says(bias: Array) -> tuple[Array, Array, Array]:
        found = [preintegrate(motion, bias, params) for motion in motions]
        turns = np.array([one.deltaRij().matrix() for one in found])
        turned = so3_log(strides.R_a_b.swapaxes(1, 2) @ turns)
        return turned, np.array([one.deltaVij() for one in found]), np.array([one.deltaPij() for one in found])

    def close(mine: Array, oracle: Array, share: float, of: Array) -> None:
        np.testing.assert_allclose(mine, oracle, rtol=0.0, atol=share * float(np.abs(of).max()))

    given = np.append(np.zeros(3), w_bias)
    turned, faster, moved = gtsam_says(given)
    close(turned, np.zeros_like(turned), 5e-3, so3_log(strides.R_a_b))
    close(strides.faster, faster, 1e-3, faster)
    close(strides.moved, moved, 1e-3, moved)
    derivatives = strides.d_turn, strides.d_faster, strides.d_moved
    for k, column in enumerate(np.roll(np.eye(6), 3, axis=1).argmax(axis=1).tolist()):
        off = gtsam_says(given + 1e-4 * np.eye(6)[k])
        for mine, there, here in zip(derivatives, off, (turned, faster, moved), strict=True):
            close(mine[..., column], (there - here) / 1e-4, 1e-2, mine)


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
        own[unknown : -window.strides.gravity_size : window.strides.state_size] = step
        return predicted(window.moved(own, none), calibration).uv_px

    np.testing.assert_allclose(here.d_seen[:, :, unknown], difference(posed), rtol=1e-5, atol=1e-4)
    if unknown < 3:
        along = difference(
            lambda step: predicted(window._replace(points=window.points + step * np.eye(3)[unknown]), calibration).uv_px
        )
        np.testing.assert_allclose(here.d_point[:, :, unknown], along, rtol=1e-5, atol=1e-4)


# Of the states at both ends, 9 numbers each and 6 beside odometry, of gravity, which odometry lacks, and of the biases.
STRIDE_UNKNOWNS = [(FLIGHT, k) for k in range(27)] + [(DRIVE, k) for k in range(18)]


@pytest.mark.parametrize("scenario, unknown", STRIDE_UNKNOWNS, ids=lambda one: getattr(one, "name", one))
def test_what_strides_lack_changes_as_their_jacobian_says(unknown: int, scenario: Scenario) -> None:
    window, calibration = window_and_calibration(scenario)
    key, strides = 3, window.strides
    assert stride_equations(window, calibration)[1].shape[2] == 2 * strides.state_size + strides.gravity_size + 6

    def lacking(step: float) -> Array:
        own, common = np.zeros(window.unknowns), np.zeros(COMMON)
        if unknown < 2 * strides.state_size:
            own[strides.state_size * key + unknown] = step
        elif unknown < 2 * strides.state_size + strides.gravity_size:
            own[unknown - 2 * strides.state_size - strides.gravity_size] = step
        else:
            common[13 + unknown - 2 * strides.state_size - strides.gravity_size] = step
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


def test_what_the_right_image_is_off_by_is_found_in_exact_measurements() -> None:
    exact = recorded(noise_free(FLIGHT), 0)
    found = fitted(faults.rolled_right(faults.shifted_right(exact, 0.9), 0.01))
    right = [RIGHT_SHIFT, RIGHT_ROLL]
    # A tenth of what noise of a pixel leaves: 0.24 px and 0.0003 rad.
    np.testing.assert_array_less(np.abs(found.value[right] - [0.9, 0.01]), [0.024, 3e-5])
    assert (fitted(exact).value[right] == 0.0).all()  # held there


SOUND_UNTIL = {RIGHT_SHIFT: 0.05, RIGHT_ROLL: 0.002}


@pytest.mark.parametrize("unknown", SOUND_UNTIL)
def test_the_right_image_counts_beyond_what_sound_recordings_have_and_is_doubted_before(unknown: int) -> None:
    rig, limit = recorded(FLIGHT, 0).rig, SOUND_UNTIL[unknown]
    (answer,) = wrong(sure(unknown, 1.01 * limit), rig, "imu")
    assert answer.check == "the rectification of the pair"
    assert wrong(sure(unknown, 0.98 * limit), rig, "imu") == []
    assert "right" in (doubtful(sure(unknown, 0.98 * limit), rig, "imu") or "")


def test_a_right_image_that_hardly_any_parallax_shows_is_not_decidable() -> None:
    known = np.full(COMMON, 1e-6)
    for unknown, error, why in ((RIGHT_SHIFT, 0.12, "shifted by 0.5 px"), (RIGHT_ROLL, 0.0021, "rolled by 0.010 rad")):
        cov = np.diag(np.where(np.arange(COMMON) == unknown, error, known) ** 2)
        assert why in (hidden(SelfCalibration(np.zeros(COMMON), cov, 1), "imu") or "")


REPORTED = [
    (faults.rolled_right, 0.01, FLIGHT, 8.0, "rolled about its optical axis by +0.01"),
    (faults.rolled_right, -0.01, DRIVE_IMU, 12.0, "rolled about its optical axis by -0.0"),
    (faults.rolled_right, 0.01, DRIVE, 12.0, "rolled about its optical axis by +0.0"),
    (faults.shifted_right, 0.6, DRIVE_IMU, 12.0, "the right image's columns are +0."),
    (faults.shifted_right, -1.0, FLIGHT_REALISTIC, 8.0, "the right image's columns are -0.98"),
    (faults.shifted_right, 1.0, DRIVE, 12.0, "the right image's columns are +"),
]


@pytest.mark.parametrize("plant, dose, scenario, duration_s, why", REPORTED)
def test_a_right_image_that_is_not_rectified_is_reported(
    plant: faults.Fault, dose: float, scenario: Scenario, duration_s: float, why: str
) -> None:
    for seed in (31, 32):
        sound = recorded(scenario, seed, duration_s)
        assert "miscalibration" not in {finding.fault for finding in audit(sound).findings}
        found = {finding.fault: finding.detail for finding in audit(plant(sound, dose, seed)).findings}
        assert why in found["miscalibration"]


@pytest.mark.parametrize("scenario", [FLIGHT, FLIGHT_REALISTIC, DRIVE_IMU], ids=lambda scenario: scenario.name)
def test_standard_errors_are_honest_where_the_errors_of_tracks_are_correlated(scenario: Scenario) -> None:
    sigmas = np.concatenate(
        [(f := fitted(recorded(scenario, seed))).value[:12] / f.error[:12] for seed in range(40, 46)]
    )
    # 72 of them; the errors are no less than those of a gyro that filters, so they are a little large.
    assert 0.3 < np.mean(sigmas**2) < 1.4


def test_windows_that_want_different_calibrations_widen_the_error() -> None:
    sound = recorded(FLIGHT, 1, 16.0)
    jumped = faults.jumped_image(sound, 15.0)
    assert fitted(jumped).error[2] > 4.0 * fitted(sound).error[2]


def test_one_window_says_nothing_of_a_change_of_the_clock() -> None:
    found = fitted(recorded(FLIGHT, 0))
    assert found.windows == 1
    assert found.value[CHANGE] == pytest.approx(0.0, abs=1e-9)
    assert found.error[CHANGE] == pytest.approx(OFF_BY[CHANGE], rel=1e-3)


def sure(unknown: int, value: float) -> SelfCalibration:
    """A calibration that differs from the given one in one thing, and is known well."""
    return SelfCalibration(value * np.eye(COMMON)[unknown], 1e-12 * np.eye(COMMON), 1)


@pytest.mark.parametrize(
    "unknown, limit, check",
    [
        (0, 0.012, "K"),
        (1, 0.012, "K"),
        (2, 2.0, "K"),
        (3, 5.0, "K"),
        (4, 0.015, "the baseline, the rectification of the pair"),
        (6, 0.006, "the rotation of T_imu_cam"),
        (11, 0.0008, "the clocks of the camera and the IMU"),
    ],
)
def test_what_is_found_counts_beyond_what_sound_recordings_have(unknown: int, limit: float, check: str) -> None:
    rig: StereoRig = recorded(FLIGHT, 0).rig
    assert [one.check for one in wrong(sure(unknown, -1.01 * limit), rig, "imu")] == [check]
    assert wrong(sure(unknown, 0.98 * limit), rig, "imu") == []


def test_what_is_found_counts_beyond_four_standard_errors() -> None:
    rig = recorded(FLIGHT, 0).rig
    for sigmas, wanted in ((3.9, 0), (4.1, 1)):
        found = SelfCalibration((2.0 + sigmas) * np.eye(COMMON)[2], np.eye(COMMON), 1)
        assert len(wrong(found, rig, "imu")) == wanted


def test_a_clock_is_checked_by_all_that_tracks_and_imu_tell() -> None:
    """From rotations alone these five sound seconds have an offset of 7 ms, beyond five standard errors."""
    sound = simulate(replace(FLIGHT_REALISTIC, duration_s=5.0, varied=True), 501)
    assert "time-offset" not in {finding.fault for finding in audit(sound).findings}


def test_a_turned_camera_is_no_late_one() -> None:
    """Rotations alone have it 57 +- 5 ms late."""
    outcome = audit(faults.turned_camera(recorded(FLIGHT, 7, 6.0), 0.1, 7))
    found = {finding.fault for finding in outcome.findings}
    assert "miscalibration" in found
    assert "time-offset" not in found


def test_intrinsics_that_hardly_any_rotation_shows_are_not_decidable() -> None:
    outcome = audit(recorded(DRIVE_IMU, 0, 5.0))
    assert "would not show" in outcome.undecided["miscalibration"]
    assert hidden(sure(0, 0.0), "imu") is None


def test_an_offset_between_chance_and_certainty_is_not_decidable() -> None:
    """A car that hardly turns knows it to 5 ms: what is 3.7 standard errors is neither told nor ruled out."""
    late = faults.camera_clock(simulate(replace(DRIVE_IMU, duration_s=14.0, varied=True), 7301), 0.02)
    outcome = audit(late)
    assert "time-offset" not in {finding.fault for finding in outcome.findings}
    assert "frames look as if stamped late by 17 +- 5 ms" in outcome.undecided["time-offset"]


def test_a_focal_length_beyond_chance_and_below_what_counts_is_reported() -> None:
    """Two percent on 6 s of a flight are eight standard errors, and double the error of what is estimated."""
    sound = simulate(replace(FLIGHT, duration_s=6.0, varied=True), 7301)
    assert "more than chance" not in audit(sound).undecided.get("miscalibration", "")
    reported = audit(faults.wrong_focal_length(sound, 1.02))
    match = re.search(r"fit fx_px = (\S+) \+- (\S+), not", reported.undecided["miscalibration"])
    assert match is not None
    assert float(match[1]) == pytest.approx(sound.rig.fx_px, abs=4.0 * float(match[2]))
    assert "more than chance" in reported.undecided["miscalibration"]
