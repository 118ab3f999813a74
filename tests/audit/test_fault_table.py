"""The table of faults: what the audit must say of each of them, in each kind of recording.

A verdict is ``repaired`` (named, repaired, nothing blocks), ``blocks`` (named and blocking), ``warned`` (named, not
to be repaired, nothing blocks) or ``undecided`` (not decidable, no fault found beside it but a warning).
"""

import re
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any, Literal, NamedTuple

import numpy as np
import pytest

from tests.audit.conftest import recording, with_pixels
from tests.audit.conftest import with_values as other_values
from toolkit.audit import Audit, audit
from toolkit.audit.agreement import accelerometer_change, scale_change
from toolkit.audit.calibration import gyro_scale, miscalibration, steady_difference
from toolkit.audit.fault import Evidence, Symptom, Undecided
from toolkit.audit.timing import clock_change
from toolkit.audit.truth import truth_clock, truth_mismatch
from toolkit.geometry import Array, IntArray
from toolkit.measurements import NS_PER_S
from toolkit.report.card import audit_text
from toolkit.sequence import Sequence
from toolkit.simulation import faults

TWIST, IMU, ALL = ("drive",), ("flight",), ("drive", "flight")


class Case(NamedTuple):
    plant: Callable[..., Sequence]
    dose: float
    found: str
    verdict: Literal["repaired", "blocks", "warned", "undecided"]
    in_detail: str = ""
    scenarios: tuple[str, ...] = ALL


def half_as_large(sequence: Sequence, dose: float, seed: int) -> Sequence:
    """Give the K of images of another size, by the dose."""
    rig = sequence.rig
    names = ("fx_px", "fy_px", "cx_px", "cy_px")
    return replace(sequence, rig=replace(rig, **{name: dose * getattr(rig, name) for name in names}))


def _at(t_ns: IntArray, dose: float, first_ns: int) -> IntArray:
    return (first_ns + dose * (t_ns - first_ns)).astype(np.int64)


def samples_stamped_in(sequence: Sequence, dose: float, seed: int) -> Sequence:
    """Multiply the time of the samples, and not of the frames, by the dose: another unit."""
    t_ns = _at(sequence.motion.t_ns, dose, int(sequence.frames_t_ns[0]))
    return replace(sequence, motion=sequence.motion.of(t_ns, sequence.motion.values))


def stamps_in(sequence: Sequence, dose: float, seed: int) -> Sequence:
    """Multiply all times by the dose."""
    first_ns = int(sequence.frames_t_ns[0])
    all_alike = replace(samples_stamped_in(sequence, dose, seed), frames_t_ns=_at(sequence.frames_t_ns, dose, first_ns))
    return replace(all_alike, truth=None, prior=None)


def mirrored(sequence: Sequence, dose: float, seed: int) -> Sequence:
    """Mirror the images about the principal point's column, which exchanges left and right."""
    u_left, u_right, v = sequence.observations.uv_px.T
    twice = 2.0 * sequence.rig.cx_px
    uv_px = np.stack([twice - u_right, twice - u_left, v], axis=1)
    return with_pixels(sequence, uv_px)


def with_values(change: Callable[[Array], Array]) -> Callable[..., Sequence]:
    """Return what changes the values (S, 6) of the motion samples."""
    return lambda sequence, dose, seed: other_values(sequence, change)


def normalised(sequence: Sequence, dose: float, seed: int) -> Sequence:
    rig, uv_px = sequence.rig, sequence.observations.uv_px
    return with_pixels(sequence, (uv_px - [rig.cx_px, rig.cx_px, rig.cy_px]) / rig.fx_px)


def one_camera(sequence: Sequence, dose: float, seed: int) -> Sequence:
    """Write the left image's columns for both."""
    return with_pixels(sequence, sequence.observations.uv_px[:, [0, 0, 2]])


def unlike_rows(sequence: Sequence, dose: float, seed: int) -> Sequence:
    return replace(sequence, rig=replace(sequence.rig, fy_px=dose * sequence.rig.fy_px))


def frames_of_another_clock(sequence: Sequence, dose: float, seed: int) -> Sequence:
    return replace(sequence, frames_t_ns=(sequence.frames_t_ns * dose).astype(np.int64))


def rounded_to_seconds(sequence: Sequence, dose: float, seed: int) -> Sequence:
    t_ns = np.asarray(np.round(sequence.frames_t_ns / 1e9) * 1e9, dtype=np.int64)
    return replace(sequence, frames_t_ns=t_ns)


def backwards(sequence: Sequence, dose: float, seed: int) -> Sequence:
    """Uneven steps make some of the stamps look like jumps of a clock that goes on."""
    rng = np.random.default_rng(seed)
    t_ns = sequence.frames_t_ns + rng.integers(0, 8_000_000, sequence.frame_count)
    return replace(sequence, frames_t_ns=t_ns[::-1])


def _halfway(values: Array) -> Array:
    values[len(values) // 2 :, 3:] *= 180.0 / np.pi
    return values


ONLY_LINEAR, NAN_Y = np.repeat([1.0, 0.0], 3), np.array([0.0, np.nan, 0.0, 0.0, 0.0, 0.0])

CASES = [
    Case(with_values(lambda v: v[:, [0, 1, 2, 3, 5, 4]]), 1.0, "mixed-axes", "blocks", "extrinsic's x, z, y", TWIST),
    Case(with_values(lambda v: v[:, [0, 1, 2, 5, 4, 3]]), 2.0, "mixed-axes", "blocks", "extrinsic's z, y, x", TWIST),
    Case(with_values(lambda v: v[:, [1, 0, 2, 3, 4, 5]]), 3.0, "mixed-axes", "blocks", "the velocities do not", TWIST),
    Case(with_values(_halfway), 4.0, "units", "blocks", "deg/s in a part of the recording", TWIST),
    Case(
        with_values(lambda v: v * (1.0 - 2.0 * ONLY_LINEAR)),
        5.0,
        "disagreement",
        "blocks",
        "px against the measured motion",
        TWIST,
    ),
    Case(with_values(lambda v: 0.0 * v), 6.0, "stuck-samples", "blocks", "velocities are zero while the camera", TWIST),
    Case(with_values(lambda v: v * ONLY_LINEAR), 7.0, "stuck-samples", "blocks", "rates of rotation are zero", TWIST),
    Case(with_values(lambda v: v + NAN_Y), 8.0, "not-finite", "blocks", "y in all of them"),
    Case(faults.linear_unit, 3.281, "units", "repaired", "it is in ft/s", TWIST),
    Case(faults.linear_unit, 1.944, "disagreement", "blocks", "times the camera's", TWIST),
    Case(normalised, 1.0, "intrinsics", "blocks", "normalised image coordinates"),
    Case(one_camera, 1.0, "swapped-coordinates", "blocks", "one camera's columns stand for both"),
    Case(unlike_rows, 2.0, "intrinsics", "blocks", "beside fx_px", IMU),
    Case(frames_of_another_clock, 1e-3, "outside-motion", "blocks", "stamp both by one clock", TWIST),
    Case(rounded_to_seconds, 1.0, "time-order", "blocks", "as stamps are that were rounded"),
    Case(backwards, 1.0, "time-order", "blocks", "time runs backwards"),
    Case(faults.swapped_images, 1.0, "swapped-coordinates", "repaired", "left and right are exchanged"),
    Case(faults.swapped_images, 0.4, "swapped-coordinates", "blocks", "left and right, or u and v, are exchanged"),
    Case(faults.swapped_coordinates, 0.3, "track-scatter", "warned", "mismatches"),
    Case(faults.swapped_coordinates, 1.0, "swapped-coordinates", "blocks", "u and v are exchanged"),
    Case(faults.dropped_sightings, 1.0, "no-sightings", "blocks"),
    Case(faults.nan_span, 3600.0, "not-finite", "blocks", "of the sightings"),
    Case(faults.identity_intrinsics, 1.0, "intrinsics", "blocks", "fx_px = 1 "),
    Case(faults.identity_intrinsics, 0.0, "intrinsics", "blocks", "fx_px = 0 "),
    Case(half_as_large, 0.5, "intrinsics", "blocks", "looks like that of images of 0.5"),
    Case(stamps_in, 10.0, "units", "blocks", "the stamps run", TWIST),
    Case(stamps_in, 1000.0, "units", "blocks", "they are not in seconds"),
    Case(samples_stamped_in, 1000.0, "sparse-motion", "blocks", "check both"),
    Case(mirrored, 0.0, "mixed-axes", "blocks", "mirrored images have the same effect", TWIST),
    Case(mirrored, 0.0, "accelerometer-axes", "blocks", "mirrored images have the same effect", IMU),
    Case(faults.shifted_pixels, 5000.0, "intrinsics", "blocks", "lies outside the sightings"),
    Case(faults.baseline_unit, 1000.0, "units", "repaired", "it is in millimetres, 0.54 m", TWIST),
    Case(faults.baseline_unit, 1000.0, "units", "blocks", "baseline_m is 110", IMU),
    Case(faults.extrinsic_unit, 1000.0, "units", "repaired", "its translation is in millimetres"),
    Case(faults.inverted_extrinsic, 1.0, "mixed-axes", "repaired", "T_imu_cam is inverted", TWIST),
    Case(faults.linear_unit, 3.6, "units", "repaired", "km/h", TWIST),
    Case(faults.linear_unit, 1.0 / 9.80665, "units", "repaired", "it is in g", IMU),
    Case(faults.linear_unit, 3.6, "disagreement", "blocks", "times gravity", IMU),
    Case(faults.angular_unit, 180.0 / np.pi, "units", "repaired", "deg/s"),
    Case(faults.truth_unit, 1000.0, "units", "repaired", "the truth moves"),
    Case(faults.spike, 1e300, "implausible", "repaired", "1 motion sample(s)"),
    Case(faults.few_tracks, 3.0, "mixed-axes", "undecided", "0 of"),
    Case(faults.clock_jump, -0.5, "time-order", "repaired", "the clock jumps back by 0.50 s"),
    Case(faults.motion_gap, 0.5, "motion-gap", "repaired", "times the noise"),
    Case(faults.motion_gap, 0.02, "motion-gap", "repaired", "1 gap(s)", IMU),
    Case(faults.camera_clock, -0.02, "time-offset", "repaired", "stamped early", IMU),
    Case(faults.camera_clock, 0.06, "time-offset", "repaired", "stamped late", TWIST),
    Case(faults.camera_clock, 0.25, "time-offset", "repaired", "stamped late"),
    Case(faults.gyro_bias, 0.15, "gyro-bias", "repaired", "the prior's covariance of it is widened"),
    Case(faults.disturbed_motion, 2.0, "conflict", "warned", "vision and odometry disagree at 5-10 s", TWIST),
    Case(faults.disturbed_motion, 2.0, "conflict", "warned", "m/s^2 of specific force", IMU),
    Case(faults.moving_objects, 0.8, "conflict", "warned"),
    Case(faults.turned_camera, 0.035, "miscalibration", "warned", "about its own x, y, z", IMU),
    Case(faults.turned_camera, 0.5, "miscalibration", "warned", "rad against T_imu_cam", IMU),
    Case(faults.wrong_focal_length, 1.1, "miscalibration", "warned", "tracks and odometry fit fx_px = 7", TWIST),
    Case(faults.wrong_aspect, 0.85, "miscalibration", "warned", "tracks and odometry fit fx_px = 7", TWIST),
    Case(faults.shifted_centre, 25.0, "miscalibration", "warned", "tracks and odometry fit cx_px = 6", TWIST),
    Case(faults.wrong_focal_length, 1.05, "miscalibration", "warned", "fit fx_px = 45", IMU),
    Case(faults.shifted_centre, 15.0, "miscalibration", "warned", "fit cx_px = 3", IMU),
    Case(faults.rolled_right, 0.01, "miscalibration", "warned", "rolled about its optical axis by +0.0"),
    Case(faults.shifted_right, -1.0, "miscalibration", "warned", "the right image's columns are -"),
    Case(faults.extrinsic_unit, -1.0, "lever-arm", "warned", "the camera is off by", IMU),
    Case(faults.linear_unit, 1.1, "vision-scale", "warned", "% shorter than the odometry's", TWIST),
    Case(faults.stretched_disparity, 0.9, "vision-scale", "warned", "% longer than the odometry's", TWIST),
    Case(faults.displaced_camera, 1.0, "lever-arm", "warned", "the camera is off by", IMU),
    Case(faults.outlier_tracks, 0.6, "track-scatter", "warned", "times as much as the stated noise"),
    Case(faults.linear_unit, 0.8, "miscalibration", "warned", "times gravity", IMU),
    Case(faults.alternate_frames_late, 0.02, "uneven-stamps", "warned", "the camera's motion shows", TWIST),
    Case(faults.frame_jitter, 0.015, "uneven-stamps", "warned", "the camera's motion shows", TWIST),
    Case(faults.truth_clock_rate, 1.04, "truth-clock", "warned", "times as fast by the truth's stamps"),
    Case(faults.unwritten_orientations, 1.0, "truth-mismatch", "warned", "all orientations of the truth are equal"),
    Case(faults.gyro_axis_scale, 0.85, "gyro-scale", "warned", "times as fast as the camera about"),
    Case(faults.coarse_samples, 0.1, "coarse-samples", "warned", "in steps of 0.1 rad/s"),
    Case(faults.thinned_motion, 10.0, "sparse-motion", "warned", "every 1 s and frames every 0.1 s", TWIST),
    Case(faults.blackout, 1.0, "thin-vision", "warned", "s ("),
    Case(faults.few_tracks, 3.0, "thin-vision", "warned", "for 100% of the time"),
]


def clean(scenario: str) -> Sequence:
    return recording(scenario, 0)


@cache
def audited(plant: Callable[..., Sequence], dose: float, scenario: str) -> Audit:
    with np.errstate(all="ignore"):
        return audit(plant(clean(scenario), dose, 0))


def name_of(case: Case, scenario: str) -> str:
    return f"{scenario}-{case.plant.__name__}-{case.dose:.3g}"


@pytest.mark.parametrize(
    "case, scenario",
    [pytest.param(case, scenario, id=name_of(case, scenario)) for case in CASES for scenario in case.scenarios],
)
def test_the_fault_is_named_with_the_right_verdict_and_nothing_is_blessed_that_blocks_or_was_not_checked(
    case: Case, scenario: str
) -> None:
    outcome = audited(case.plant, case.dose, scenario)
    blessed = "no fault is left that invalidates a result" in audit_text(outcome)
    assert blessed == (case.verdict == "repaired" and not outcome.undecided)
    assert ("not decidable: " in audit_text(outcome)) == bool(outcome.undecided)
    if case.verdict == "undecided":
        assert {finding.fault for finding in outcome.findings if finding.warning} <= {"thin-vision"}
        assert all(finding.warning for finding in outcome.findings)
        assert case.in_detail in outcome.undecided[case.found]
        return
    found = {finding.fault: finding for finding in outcome.findings}
    assert case.in_detail in found[case.found].detail
    assert any(finding.blocking for finding in outcome.findings) == (case.verdict == "blocks")
    assert found[case.found].blocking == (case.verdict == "blocks")
    assert found[case.found].warning == (case.verdict == "warned")


class Measured(NamedTuple):
    """A fault whose size a check estimates: the groups of the pattern are the size and its standard error.

    ``slack`` is the systematic error of the estimate, and the rounding of its figures.
    """

    check: Callable[[Evidence], Symptom | Undecided | None]
    plant: Callable[..., Sequence]
    dose: float
    recording: tuple[Any, ...]
    pattern: str
    size: float
    slack: float


def late_truth(sequence: Sequence, dose: float, seed: int) -> Sequence:
    assert sequence.truth is not None
    return replace(sequence, truth=replace(sequence.truth, t_ns=sequence.truth.t_ns + round(dose * NS_PER_S)))


STEPS, ANGLE = r"steps are (\S+) \+- (\S+) % ", r"an angle of (\S+) \+- (\S+) rad"
SPEED, GRAVITY = r"camera's is (\S+) \+- (\S+) % higher", r"gravity that is (\S+) \+- (\S+) m/s\^2 "
TURNS, PARTS = r"turns (\S+) \+- (\S+) times as fast", r"changes by (\S+) \+- (\S+) ms"
LATE, PACE = r"truth's stamps are shifted by (\S+) \+- (\S+) ms", r"time passes (\S+) \+- (\S+) times as fast"
SCALE = r"steps are (\S+) \+- (\S+) times the truth's"
MEASURED = [
    # The tracks' noise makes vision's steps up to half a percent longer.
    Measured(steady_difference, faults.wrong_focal_length, 1.02, ("drive", 41, 25.0), STEPS + "longer", 2.0, 0.6),
    Measured(steady_difference, faults.linear_unit, 1.02, ("drive", 41, 25.0), STEPS + "shorter", 2.0, 0.6),
    Measured(steady_difference, faults.shifted_centre, 12.0, ("drive", 43, 25.0), ANGLE, 12.0 / 720.0, 0.003),
    Measured(scale_change, faults.changed_speed, 1.08, ("drive", 1), SPEED, 8.0, 0.0),
    # Half of what drifting tracks make of it.
    Measured(accelerometer_change, faults.changed_speed, 1.06, ("drive-imu", 1, 12.0, True), GRAVITY, 0.59, 0.1),
    Measured(accelerometer_change, faults.changed_speed, 0.97, ("flight", 1, 8.0, True), GRAVITY + "less", 0.29, 0.1),
    Measured(accelerometer_change, faults.changed_speed, 1.06, ("flight-realistic", 1, 8.0, True), GRAVITY, 0.59, 0.1),
    # A bound is off by the noise of the rates beside their scatter, a percent at most here.
    Measured(gyro_scale, faults.gyro_axis_scale, 0.85, ("drive", 51, 15.0, True), TURNS, 0.85, 0.01),
    Measured(gyro_scale, faults.gyro_axis_scale, 1.2, ("drive-imu", 51, 12.0, True), TURNS, 1.2, 0.01),
    # The noise of the camera's rotation lowers the ratio by up to 1.5 %.
    Measured(miscalibration, faults.angular_unit, 1.1, ("drive", 61, 12.0, True), TURNS, 1.1, 0.015),
    Measured(gyro_scale, faults.angular_unit, 1.1, ("flight", 61, 6.0, True), TURNS, 1.1, 0.01),
    Measured(miscalibration, faults.angular_unit, 1.03, ("flight-realistic", 0, 8.0), TURNS, 1.03, 0.005),
    Measured(clock_change, faults.camera_clock_step, 0.08, ("drive-imu", 102, 12.0), PARTS, -80.0, 2.5),
    Measured(clock_change, faults.camera_clock_step, 0.08, ("flight", 102, 6.0), PARTS, -80.0, 2.5),
    Measured(clock_change, faults.camera_clock_step, 0.025, ("flight-realistic", 102, 5.0), PARTS, -25.0, 2.5),
    Measured(truth_mismatch, faults.baseline_unit, 0.8, ("drive", 0, 6.0), SCALE, 0.8, 0.024),
    Measured(truth_mismatch, faults.truth_unit, 1.0 / 0.3048, ("drive", 0, 6.0), SCALE, 0.3048, 0.01),  # in feet
    Measured(truth_mismatch, faults.baseline_unit, 2.0, ("flight", 0, 6.0), SCALE, 2.0, 0.06),
    Measured(truth_mismatch, late_truth, 0.05, ("flight", 5, 12.0), LATE, -50.0, 2.0),
    Measured(truth_mismatch, late_truth, 0.5, ("drive", 5, 12.0), LATE, -500.0, 2.0),
    Measured(truth_mismatch, late_truth, 0.05, ("drive-imu", 5, 12.0), LATE, -50.0, 2.0),
    Measured(truth_clock, faults.truth_clock_rate, 1.03, ("drive", 31, 12.0, True), PACE, 1.03, 0.0),
    Measured(truth_clock, faults.truth_clock_rate, 0.95, ("drive-imu", 31, 12.0, True), PACE, 0.95, 0.0),
    Measured(truth_clock, faults.truth_clock_rate, 1.015, ("flight", 31, 6.0, True), PACE, 1.015, 0.0),
]


@pytest.mark.parametrize("case", MEASURED, ids=lambda one: f"{one.plant.__name__}-{one.recording[0]}-{one.dose:g}")
def test_a_fault_is_reported_with_its_size_and_error_and_the_sound_recording_is_not(case: Measured) -> None:
    sound = recording(*case.recording)
    assert not isinstance(case.check(Evidence(sound)), Symptom)
    found = case.check(Evidence(case.plant(sound, case.dose, 1)))
    assert isinstance(found, Symptom) and found.remedy is None and not found.harmful
    match = re.search(case.pattern, found.detail)
    assert match is not None
    assert float(match[1]) == pytest.approx(case.size, abs=4.0 * float(match[2]) + case.slack)
    assert float(match[2]) < 0.2 * abs(case.size)


@pytest.mark.parametrize("dose", [0.02, -0.02, 0.25])
def test_the_offset_of_the_clocks_is_measured_and_undone(dose: float) -> None:
    sequence = clean("flight")
    repaired = audited(faults.camera_clock, dose, "flight").sequence
    left_s = (
        repaired.frames_t_ns[-1]
        - sequence.frames_t_ns[sequence.frames_t_ns.searchsorted(repaired.frames_t_ns[-1] - NS_PER_S // 40)]
    ) / NS_PER_S
    assert abs(left_s) < 0.01  # three standard errors of 3 ms over six seconds


def test_a_bridge_is_as_noisy_as_its_error_and_nothing_else_is() -> None:
    sequence = clean("flight")
    repaired = audited(faults.motion_gap, 0.5, "flight").sequence
    assert repaired.bridges is not None
    begin_ns, end_ns = repaired.bridges.begin_t_ns[0], repaired.bridges.end_t_ns[0]
    for packet in repaired.packets():
        outside = packet.frame.t_ns <= begin_ns or packet.frame.t_ns >= end_ns + NS_PER_S // 20
        assert packet.motion is None or (packet.motion.noise_scale is None) == outside
    lost = (sequence.motion.t_ns > begin_ns) & (sequence.motion.t_ns < end_ns)
    at = np.searchsorted(repaired.motion.t_ns, sequence.motion.t_ns[lost])
    error = np.sum(repaired.motion.values[at] - sequence.motion.values[lost], axis=0) / 200.0
    stated = repaired.bridges.noise_scale[0] * [2e-3, 1.7e-4] * np.sqrt(0.5)  # densities of the flight's IMU
    assert (np.abs(error) < 3.0 * np.repeat(stated, 3)).all()
    assert (np.abs(error).reshape(2, 3).max(axis=1) > 0.05 * stated).all()
