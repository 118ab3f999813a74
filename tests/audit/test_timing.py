"""Faults of time: clocks that are set, drift or differ, and uneven stamps: told where planted, with figures."""

import re
from dataclasses import replace

import numpy as np
import pytest

from tests.audit.conftest import LONGER_S, details, recording
from toolkit.audit import audit
from toolkit.audit.clocks import camera_offset, change_of_offset
from toolkit.audit.fault import Evidence, Symptom, Undecided
from toolkit.audit.self_calibration import LATE
from toolkit.audit.timing import LEAST_OFFSET_S, clock_change, clock_jump, time_offset, uneven_stamps
from toolkit.sequence import Sequence
from toolkit.simulation import faults


@pytest.mark.parametrize("steps", [-1.0, 0.6])
@pytest.mark.parametrize("scenario", LONGER_S)
def test_a_clock_that_is_set_by_steps_is_reported_with_its_size_and_cut_at(scenario: str, steps: float) -> None:
    sound = recording(scenario, 1, 6.0)
    dose_s = steps * float(np.diff(sound.frames_s[:2])[0])
    found = clock_jump(Evidence(faults.clock_jump(sound, dose_s, 1)))
    if scenario == "flight" and isinstance(found, Undecided):  # its tracks tell half of a step on some seeds only
        assert abs(steps) < 1.0 and "jump together" in found.why
        return
    assert isinstance(found, Symptom) and found.harmful and found.remedy is not None
    match = re.search(r"set by ([-+][\d.]+) s at", found.detail)
    assert match is not None and float(match[1]) == pytest.approx(dose_s, abs=1e-6)
    kept = found.remedy
    assert np.ptp(np.diff(kept.frames_t_ns)) <= 2 and np.ptp(np.diff(kept.motion.t_ns)) <= 2  # rounded to nanoseconds
    assert kept.frame_count >= sound.frame_count // 2


@pytest.mark.parametrize("scenario", LONGER_S)
def test_a_pause_of_both_streams_is_no_jump_for_the_vehicle_goes_on(scenario: str) -> None:
    sound = recording(scenario, 1, 6.0)
    step_s = float(np.diff(sound.frames_s[:2])[0])
    begin_s, end_s = sound.duration_s / 2.0 + step_s * np.array([0.4, 2.6])
    samples_s = sound.elapsed_s(sound.motion.t_ns)
    there = sound.with_frames(np.flatnonzero((sound.frames_s < begin_s) | (sound.frames_s > end_s)))
    paused = there.with_samples((samples_s < begin_s) | (samples_s > end_s))
    assert paused.frame_count < sound.frame_count
    assert clock_jump(Evidence(paused)) is None


def test_a_frame_and_a_sample_that_are_there_twice_are_repeats_and_not_a_jump() -> None:
    sound = recording("drive", 1, 6.0)
    row, seen = 30, sound.observations
    sample = int(np.searchsorted(sound.motion.t_ns, sound.frames_t_ns[row]))
    twice = sound.with_frames(np.sort(np.append(np.arange(sound.frame_count), row)))
    copied = np.flatnonzero(seen.frame == row)
    frame = np.append(np.where(seen.frame > row, seen.frame + 1, seen.frame), np.full(copied.size, row + 1))
    rows = np.append(np.arange(len(seen)), copied)
    twice = replace(twice, observations=type(seen).sorted(frame, seen.track_id[rows], seen.uv_px[rows]))
    found = {f.fault: f for f in audit(twice.with_samples(np.sort(np.append(np.arange(61), sample)))).findings}
    assert "clock-jump" not in found
    assert found["time-order"].count == 2 and "sorted by time" in found["time-order"].detail


def test_while_the_vehicle_stands_a_jump_and_a_pause_look_the_same_and_none_is_reported() -> None:
    """What its tracks move by is noise, of which every interval has as much, however long it is."""
    standing = faults.standstill(recording("drive", 1, 6.0), 6.0, 1)
    speed_mps = np.linalg.norm(standing.motion.values[:, :3], axis=1)
    at_s = float(np.median(standing.elapsed_s(standing.motion.t_ns[speed_mps < 0.2]))) + 0.03
    samples_s = standing.elapsed_s(standing.motion.t_ns)
    for leap_s in (0.5, 2.0):
        kept = [(t_s < at_s - 0.5 * leap_s) | (t_s > at_s + 0.5 * leap_s) for t_s in (standing.frames_s, samples_s)]
        paused = standing.with_frames(np.flatnonzero(kept[0])).with_samples(kept[1])
        leap_ns = round(leap_s * 1e9)
        frames_t_ns = standing.frames_t_ns + np.where(standing.frames_s > at_s, leap_ns, 0)
        moved = replace(standing.motion, t_ns=standing.motion.t_ns + np.where(samples_s > at_s, leap_ns, 0))
        for sequence in (paused, replace(standing, frames_t_ns=frames_t_ns, motion=moved)):
            reported = clock_jump(Evidence(sequence))
            assert isinstance(reported, Undecided) and "do not determine whether time passed" in reported.why


def with_frames_lost(sequence: Sequence) -> Sequence:
    lost = np.random.default_rng(5).uniform(size=sequence.frame_count) < 0.3
    lost[[0, -1]] = False
    return sequence.with_frames(np.flatnonzero(~lost))


@pytest.mark.parametrize("fault", [faults.alternate_frames_late, faults.frame_jitter])
@pytest.mark.parametrize("scenario", LONGER_S)
def test_stamps_that_the_cameras_motion_does_not_follow_are_reported(scenario: str, fault: faults.Fault) -> None:
    late = fault(recording(scenario, 71, 10.0, varied=True), 0.015, 3)
    # Of long and short steps that alternate the median is either; and a lost frame is no unevenness.
    lost = with_frames_lost(late.truncated(100))
    for sequence in (late, lost) if fault is faults.alternate_frames_late else (late,):
        found = uneven_stamps(Evidence(sequence))
        assert isinstance(found, Symptom) and found.warns
        match = re.search(r"motion shows (\S+) \+- (\S+) of", found.detail)
        # None of it, and less: a stamp that is late lengthens one step and shortens the next by the same.
        assert match is not None and -0.5 < float(match[1]) < 0.1


@pytest.mark.parametrize("scenario", LONGER_S)
def test_frames_that_are_lost_or_uneven_as_stamped_or_of_a_vehicle_that_stands_are_not_accused(scenario: str) -> None:
    sound = recording(scenario, 71, 10.0, varied=True)
    by_turns = sound.with_frames(np.flatnonzero(np.isin(np.arange(sound.frame_count) % 5, (0, 2))))
    for sequence in (sound, with_frames_lost(sound), faults.camera_clock(sound, 0.03), by_turns):
        assert uneven_stamps(Evidence(sequence)) is None
    parked = faults.standstill(recording("drive", 71, 10.0), 60.0, 1)
    stands_ns = parked.motion.t_ns[np.abs(parked.motion.values[:, :3]).max(axis=1) < 0.05]
    at_rest = np.flatnonzero((parked.frames_t_ns > stands_ns[0]) & (parked.frames_t_ns < stands_ns[-1]))
    jittered = faults.frame_jitter(parked.with_frames(at_rest[10:-10]), 0.015, 3)
    assert uneven_stamps(Evidence(jittered)) is None


@pytest.mark.parametrize(
    ("scenario", "duration_s", "seed"),
    [("drive-imu", 9.0, 501), ("drive-imu", 9.0, 705), ("flight-realistic", 5.0, 511)],
)
def test_clocks_that_keep_pace_do_not_part_by_what_rotations_of_half_a_recording_err(
    scenario: str, duration_s: float, seed: int
) -> None:
    evidence = Evidence(recording(scenario, seed, duration_s, varied=True))
    assert evidence.intervals is not None
    by_rotations = change_of_offset(evidence.sequence, evidence.intervals)
    assert by_rotations is not None
    assert abs(by_rotations.value) > 5.0 * by_rotations.error + 0.005
    assert clock_change(evidence) is None


def test_a_step_of_the_camera_clock_is_no_offset_to_shift_all_frames_by() -> None:
    """A shift by 0.26 s mended the half that had it, spoilt the other, and left no change to be seen."""
    found = audit(faults.camera_clock_step(recording("drive", 0), 0.3))
    offset = next(finding for finding in found.findings if finding.fault == "time-offset")
    assert offset.warning and not offset.repaired
    parted = re.search(r"by (-?\d+) \+- (\d+) ms more in the second half", offset.detail)
    assert parted is not None and abs(int(parted[1]) + 300) < 5 * int(parted[2])


def test_a_camera_clock_that_drifts_is_reported_and_one_that_cannot_be_compared_is_not_blessed() -> None:
    assert "clock-change" in details(audit(faults.camera_clock_drift(recording("drive-imu"), 0.02)))
    assert "would not show" in audit(recording("drive")).undecided["clock-change"]


@pytest.mark.parametrize("seed", range(2))
def test_a_gyro_that_has_only_noise_has_no_offset_from_the_camera(seed: int) -> None:
    # As where a vehicle stands: at some shift the noise always differs least, and looks known to a millisecond there.
    rng, flight = np.random.default_rng(seed), recording("flight").truncated(100)
    values = flight.motion.values.copy()
    values[:, 3:] = rng.normal(0.0, 0.01, (len(values), 3))
    still = replace(flight, motion=flight.motion.of(flight.motion.t_ns, values))
    intervals = Evidence(still).intervals
    assert intervals is not None
    noise = intervals._replace(w_cam_radps=rng.normal(0.0, 0.001, (len(intervals.interval), 3)))
    assert camera_offset(still, noise) is None


@pytest.mark.parametrize("late_s", [0.02, -0.03])
def test_twists_beside_every_frame_are_reported_where_the_tracks_allow_a_clock_that_is_off(late_s: float) -> None:
    late = faults.camera_clock(recording("drive"), late_s)
    reported = details(audit(late))["time-offset"]
    assert f"to be shifted by {-1e3 * late_s:+.0f} ms" in reported
    found = re.search(r"the offset is ([+-]\d+) \+- (\d+) ms, (which is consistent with zero|[\d.]+)", reported)
    assert found is not None
    # Both are rounded to whole milliseconds.
    least, most = ((abs(int(found[1])) + by) / (int(found[2]) - by) for by in (-0.5, 0.5))
    assert least <= (float(found[3]) if found[3][0].isdigit() else 2.0) <= max(most, 2.0)
    other_rate = replace(late, motion=late.motion.of(late.motion.t_ns * 21 // 20, late.motion.values))
    assert "time-offset" not in details(audit(other_rate))


@pytest.mark.parametrize("samples", [2, 3])
def test_frames_are_not_shifted_where_the_gyro_alone_is_late(samples: int) -> None:
    """Velocities that fit as they are stamped speak against a shift of the frames; a late camera they bear out."""
    clean = recording("drive")
    values = clean.motion.values.copy()
    values[samples:, 3:] = clean.motion.values[:-samples, 3:]
    late = replace(clean, motion=clean.motion.of(clean.motion.t_ns, values))
    found = audit(late)
    offset = next(finding for finding in found.findings if finding.fault == "time-offset")
    assert offset.warning and "the gyro alone is shifted" in offset.detail
    np.testing.assert_array_equal(found.sequence.frames_t_ns, late.frames_t_ns)
    assert "the frames are shifted by it" in details(audit(faults.camera_clock(clean, -0.1 * samples)))["time-offset"]


def test_where_repeated_shifts_leave_as_much_the_offset_is_that_of_the_rotations(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    late = faults.camera_clock(recording("flight"), 0.02)
    intervals, fitted = Evidence(late).intervals, Evidence(late).self_calibration
    assert intervals is not None and fitted is not None
    rotations = camera_offset(late, intervals)
    assert rotations is not None and abs(fitted.value[LATE]) > LEAST_OFFSET_S
    monkeypatch.setattr("toolkit.audit.fault.self_calibration", lambda *_: fitted)  # whatever the frames' stamps are
    offset = time_offset(Evidence(late))
    assert isinstance(offset, Symptom)
    assert f"shifted by {1e3 * rotations.value:.1f} +- {1e3 * rotations.error:.1f} ms" in offset.detail
