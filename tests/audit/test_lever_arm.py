"""Where the camera is beside an IMU: one fault tells it, beyond its limits, and by the slip that explains it."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from toolkit.audit import audit
from toolkit.audit.bundle import COMMON, LEVER
from toolkit.audit.calibration import lever_arm
from toolkit.audit.fault import Evidence, Symptom, Undecided
from toolkit.audit.self_calibration import SelfCalibration
from toolkit.geometry import Array, se3
from toolkit.sequence import Sequence
from toolkit.simulation import FLIGHT, faults, simulate


@cache
def recorded() -> Sequence:
    return simulate(replace(FLIGHT, duration_s=4.0), 0)


def messages(sequence: Sequence, lacking_m: Array, error_m: float = 1e-6) -> Symptom | None:
    """What is said where the self-calibration puts the camera so far from where it should be."""
    evidence, value = Evidence(sequence), np.zeros(COMMON)
    value[LEVER] = lacking_m
    evidence.__dict__["self_calibration"] = SelfCalibration(value, error_m**2 * np.eye(COMMON), 1)
    reported = lever_arm(evidence)
    assert reported is None or isinstance(reported, Symptom)
    return reported


def apart() -> Sequence:
    """A camera some decimetres from the IMU, as the file has it."""
    rig = recorded().rig
    return replace(recorded(), rig=replace(rig, T_imu_cam=se3(rig.T_imu_cam[:3, :3], 5.0 * rig.T_imu_cam[:3, 3])))


@pytest.mark.parametrize("axis", range(3))
def test_a_place_counts_beyond_what_sound_recordings_have(axis: int) -> None:
    one = np.eye(3)[axis]
    assert messages(recorded(), 0.98 * 0.015 * one) is None
    reported = messages(recorded(), 1.01 * 0.015 * one)
    assert reported is not None
    assert f"m along {'xyz'[axis]} from" in reported.detail


def test_a_place_counts_beyond_four_standard_errors() -> None:
    """Of the data alone: the prior of 0.3 m, which the self-calibration has, is taken off from both."""
    one = np.eye(3)[0]
    assert messages(recorded(), (0.015 + 3.9 * 0.02) * one, 0.02) is None
    assert messages(recorded(), (0.015 + 4.1 * 0.02) * one, 0.02) is not None


def test_a_translation_is_named_by_the_mistake_that_explains_it() -> None:
    sequence = apart()
    rotation, given = sequence.rig.T_imu_cam[:3, :3], sequence.rig.T_imu_cam[:3, 3]
    for lacking_m, slip in (
        (-2.0 * given, "as if its sign were changed"),
        (-rotation.T @ given - given, "as if it were that of the inverse"),
        (-given, ""),
    ):
        reported = messages(sequence, lacking_m, 0.01)
        assert reported is not None
        assert slip in reported.detail
        assert ("as if" in reported.detail) == bool(slip)


def test_a_displaced_camera_beside_an_imu_is_reported_once() -> None:
    sound = simulate(replace(FLIGHT, duration_s=8.0), 6)
    found = [finding.fault for finding in audit(faults.displaced_camera(sound, 0.25, 6)).findings]
    assert found == ["lever-arm"]


def test_a_place_that_is_known_badly_says_what_would_not_show() -> None:
    evidence = Evidence(recorded())
    evidence.__dict__["self_calibration"] = SelfCalibration(np.zeros(COMMON), 0.15**2 * np.eye(COMMON), 1)
    reported = lever_arm(evidence)
    assert isinstance(reported, Undecided)
    assert "0.7 m along x, 0.7 m along y, 0.7 m along z would not show" in reported.why
