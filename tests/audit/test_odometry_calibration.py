"""The calibration that tracks and odometry fit: exact where they are, honest where they err, told beyond its limits."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from toolkit.audit import audit
from toolkit.audit.bundle import COMMON, Calibration, twist_strides
from toolkit.audit.calibration import hidden, wrong
from toolkit.audit.fault import Evidence
from toolkit.audit.self_calibration import SelfCalibration, self_calibration
from toolkit.geometry import se3_inverse, so3_exp
from toolkit.sequence import Sequence
from toolkit.simulation import DRIVE, Scenario, faults, noise_free, simulate

# Shares of fx and fy, px of cx and cy, and, after a share of the baseline, rad: by what the rig is off below.
OFF = np.array([0.04, -0.03, 8.0, -6.0, 0.0, 0.02, -0.01, 0.03])


@cache
def recorded(scenario: Scenario, seed: int, duration_s: float = 12.0) -> Sequence:
    return simulate(replace(scenario, duration_s=duration_s, varied=seed % 2 == 1), seed)


def fitted(sequence: Sequence) -> SelfCalibration:
    evidence = Evidence(sequence)
    assert evidence.intervals is not None
    found = self_calibration(sequence, evidence.camera_motion, evidence.intervals)
    assert found is not None
    return found


def test_strides_of_exact_twists_are_those_of_the_truth() -> None:
    sequence = recorded(noise_free(DRIVE), 0)
    assert sequence.truth is not None
    keys = np.arange(0, 60, 3)
    strides = twist_strides(sequence, sequence.frames_t_ns[keys], np.zeros(3))
    poses = sequence.truth.T_world_imu[np.searchsorted(sequence.truth.t_ns, sequence.frames_t_ns[keys])]
    true = se3_inverse(poses[:-1]) @ poses[1:]
    # A twist stands for the whole of an interval, in which the car turns and slows down a little.
    np.testing.assert_allclose(strides.R_a_b, true[:, :3, :3], atol=5e-3)
    np.testing.assert_allclose(strides.moved, true[:, :3, 3], atol=0.05)


def test_the_calibration_of_exact_measurements_is_found() -> None:
    sound = recorded(noise_free(DRIVE), 0)
    step = np.concatenate([OFF, np.zeros(COMMON - OFF.size)])
    rig = Calibration(sound.rig, 0.0, np.zeros(6)).moved(step).rig
    found = fitted(replace(sound, rig=rig))
    expected = -OFF
    expected[5:] = so3_exp(OFF[5:]) @ expected[5:]  # about the axes of the camera that is turned
    # Twists between the frames are straight lines; within what the measurements' noise leaves.
    np.testing.assert_array_less(np.abs(found.value[: OFF.size] - expected), found.error[: OFF.size])


def test_standard_errors_are_honest() -> None:
    sigmas = np.concatenate([(f := fitted(recorded(DRIVE, seed))).value[:8] / f.error[:8] for seed in range(40, 46)])
    # 48 of them; the six of one unknown share their world's part of it.
    assert 0.4 < np.mean(sigmas**2) < 1.8


LIMITS = [(0, 0.06), (1, 0.06), (2, 8.0), (3, 12.0), (5, 0.06), (6, 0.06), (7, 0.06), (19, 0.3), (20, 0.003)]


@pytest.mark.parametrize("unknown, limit", LIMITS)
def test_what_is_found_counts_beyond_what_sound_recordings_have(unknown: int, limit: float) -> None:
    rig, cov = recorded(DRIVE, 0).rig, np.diag(np.full(COMMON, (0.01 * limit) ** 2))
    for value, wanted in ((1.05 * limit, 0), (1.07 * limit, 1)):  # six standard errors are 0.06 of it
        assert len(wrong(SelfCalibration(value * np.eye(COMMON)[unknown], cov, 1), rig, "twist")) == wanted


@pytest.mark.parametrize("unknown", [4, 8, 9, 10, 11, 12, 13])
def test_what_odometry_cannot_tell_is_not_checked(unknown: int) -> None:
    """The scale of odometry looks like the baseline, its point like the camera's place, its pairing like the clock."""
    found = SelfCalibration(np.eye(COMMON)[unknown], 1e-12 * np.eye(COMMON), 1)
    assert wrong(found, recorded(DRIVE, 0).rig, "twist") == []


def test_the_error_that_is_reported_has_what_sound_recordings_err_by_in_it() -> None:
    rig = recorded(DRIVE, 0).rig
    (reported,) = wrong(SelfCalibration(0.2 * np.eye(COMMON)[0], 1e-12 * np.eye(COMMON), 1), rig, "twist")
    assert f"+- {0.03 * rig.fx_px * np.exp(0.2):.1f}" in reported.summary


def test_of_a_long_drive_the_windows_that_turn_are_taken() -> None:
    """The scenario goes straight ahead for most of a minute: windows that are spread know fx to one percent."""
    assert fitted(recorded(DRIVE, 0, 60.0)).error[0] < 0.003


@pytest.mark.parametrize("seed", range(60, 64))
def test_a_sound_drive_is_not_accused_and_one_with_a_wrong_focal_length_is(seed: int) -> None:
    sound = recorded(DRIVE, seed)
    assert audit(sound).findings == ()
    for dose in (0.9, 1.1):
        summary = {finding.fault: finding.detail for finding in audit(faults.wrong_focal_length(sound, dose)).findings}
        assert f"tracks and odometry fit fx_px = {sound.rig.fx_px / 100.0:.0f}" in summary["miscalibration"]


def test_a_drive_that_hardly_turns_says_what_would_not_show() -> None:
    short = recorded(DRIVE, 0, 5.0)
    assert "fx off by" in audit(short).undecided["miscalibration"]
    assert hidden(SelfCalibration(np.zeros(COMMON), 1e-12 * np.eye(COMMON), 1), "twist") is None
