"""What changes during a recording, and samples that hang, leap or are too few: told where planted, and nowhere else."""

import re
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from toolkit.audit import Audit, audit
from toolkit.audit.clocks import camera_offset, change_of_offset
from toolkit.audit.fault import Evidence, Symptom
from toolkit.audit.timing import LARGEST_ERROR_S, OFFSET_SIGMAS, _constant_phase_s, clock_change
from toolkit.sequence import Sequence
from toolkit.simulation import SCENARIOS, faults, simulate

LENGTH_S = {"drive": 12.0, "drive-imu": 12.0, "flight": 6.0}


@cache
def sound(scenario: str) -> Sequence:
    return simulate(replace(SCENARIOS[scenario], duration_s=LENGTH_S[scenario]), 1)


def messages(outcome: Audit) -> dict[str, str]:
    return {finding.fault: finding.detail for finding in outcome.findings}


def test_odometry_that_is_faster_from_the_middle_on_is_reported_with_its_error() -> None:
    reported = messages(audit(faults.changed_speed(sound("drive"), 1.08)))["scale-change"]
    found = re.search(
        r"from about (\d+) s on the odometry's speed relative to the camera's is ([\d.]+) \+- ([\d.]+) % higher",
        reported,
    )
    assert found is not None
    assert float(found[1]) == pytest.approx(6.0, abs=1.2)  # a tenth of the recording
    assert float(found[2]) == pytest.approx(8.0, abs=3.0 * float(found[3]))


def test_odometry_that_is_a_little_faster_is_within_what_sound_drives_have() -> None:
    assert "scale-change" not in messages(audit(faults.changed_speed(sound("drive"), 1.04)))


def test_a_scale_that_wanders_hides_a_step_and_the_audit_says_how_large_a_one() -> None:
    clean = sound("drive")
    values = clean.motion.values.copy()
    t_s = (clean.motion.t_ns - clean.motion.t_ns[0]) / 1e9
    values[:, :3] *= 1.0 + 0.04 * np.sin(2.0 * np.pi * t_s / 7.0)[:, None]
    reported = audit(replace(clean, motion=clean.motion.of(clean.motion.t_ns, values))).undecided["scale-change"]
    found = re.search(r"a step by less than (\d+) % would not show", reported)
    assert found is not None
    assert 8 <= int(found[1]) <= 20
    assert "scale-change" not in audit(clean).undecided


@pytest.mark.parametrize("scenario", LENGTH_S)
def test_an_image_that_jumps_and_stays_is_reported_at_its_time(scenario: str) -> None:
    faulty = faults.jumped_image(sound(scenario), 15.0)
    angle_rad = np.sqrt(2.0) * 15.0 / faulty.rig.fx_px
    found = re.search(r"at ([\d.]+) s \(by ([\d.]+) rad\)", messages(audit(faulty))["image-jump"])
    assert found is not None
    assert float(found[1]) == pytest.approx(LENGTH_S[scenario] / 2.0, abs=0.2)
    # A shift is a rotation in the middle of the image only, and close points take some of it for a translation.
    assert float(found[2]) == pytest.approx(angle_rad, rel=0.35)


def test_a_rotation_that_is_over_at_once_is_no_jump_that_stays() -> None:
    clean = sound("drive")
    values = clean.motion.values.copy()
    values[60, 5] += 0.4
    outcome = audit(replace(clean, motion=clean.motion.of(clean.motion.t_ns, values)))
    assert "image-jump" not in messages(outcome)


@pytest.mark.parametrize("scenario", ["drive-imu", "flight"])
def test_a_camera_clock_that_is_set_on_the_way_is_reported(scenario: str) -> None:
    reported = messages(audit(faults.camera_clock_step(sound(scenario), 0.08)))["clock-change"]
    found = re.search(r"changes by (-?\d+) \+- (\d+) ms", reported)
    assert found is not None
    assert float(found[1]) == pytest.approx(-80.0, abs=3.0 * float(found[2]))


@pytest.mark.parametrize(
    ("scenario", "duration_s", "seed"),
    [("drive-imu", 9.0, 501), ("drive-imu", 9.0, 705), ("flight-realistic", 5.0, 511)],
)
def test_clocks_that_keep_pace_do_not_part_by_what_rotations_of_half_a_recording_err(
    scenario: str, duration_s: float, seed: int
) -> None:
    evidence = Evidence(simulate(replace(SCENARIOS[scenario], duration_s=duration_s, varied=True), seed))
    assert evidence.intervals is not None
    by_rotations = change_of_offset(evidence.sequence, evidence.intervals)
    assert by_rotations is not None
    assert abs(by_rotations.value) > 5.0 * by_rotations.error + 0.005
    assert clock_change(evidence) is None


@pytest.mark.parametrize("duration_s", [5.0, 8.0])
def test_a_camera_clock_that_is_set_by_little_is_reported_within_its_error(duration_s: float) -> None:
    flight = simulate(replace(SCENARIOS["flight-realistic"], duration_s=duration_s), 102)
    symptom = clock_change(Evidence(faults.camera_clock_step(flight, 0.025)))
    assert isinstance(symptom, Symptom)
    found = re.search(r"changes by (-?\d+) \+- (\d+) ms", symptom.detail)
    assert found is not None
    # Printed to a millisecond.
    assert float(found[1]) == pytest.approx(-25.0, abs=3.0 * float(found[2]) + 0.5)


@pytest.mark.parametrize("seed", [0, 1, 3])
def test_a_step_of_the_camera_clock_is_no_offset_to_shift_all_frames_by(seed: int) -> None:
    """A shift by 0.26 s mended the half that had it, spoilt the other, and left no change to be seen."""
    found = audit(faults.camera_clock_step(simulate(replace(SCENARIOS["drive"], duration_s=12.0), seed), 0.3))
    offset = next(finding for finding in found.findings if finding.fault == "time-offset")
    assert not offset.repaired
    assert offset.warning
    parted = re.search(r"by (-?\d+) \+- (\d+) ms more in the second half", offset.detail)
    assert parted is not None
    assert abs(int(parted[1]) + 300) < 5 * int(parted[2])


def test_a_camera_clock_that_drifts_is_reported() -> None:
    assert "clock-change" in messages(audit(faults.camera_clock_drift(sound("drive-imu"), 0.02)))


def test_clocks_that_cannot_be_compared_are_not_blessed() -> None:
    assert "would not show" in audit(sound("drive")).undecided["clock-change"]


@pytest.mark.parametrize("seed", range(3))
def test_a_gyro_that_has_only_noise_has_no_offset_from_the_camera(seed: int) -> None:
    # As where a vehicle stands: at some shift the noise always differs least, and looks known to a millisecond there.
    rng, flight = np.random.default_rng(seed), sound("flight").truncated(100)
    values = flight.motion.values.copy()
    values[:, 3:] = rng.normal(0.0, 0.01, (len(values), 3))
    still = replace(flight, motion=flight.motion.of(flight.motion.t_ns, values))
    intervals = Evidence(still).intervals
    assert intervals is not None
    noise = intervals._replace(w_cam_radps=rng.normal(0.0, 0.001, (len(intervals.interval), 3)))
    assert camera_offset(still, noise) is None


def test_odometry_that_hangs_is_reported_and_wheels_that_stand_or_roll_straight_do_not_hang() -> None:
    clean = sound("drive")
    assert "for 1.5 s" in messages(audit(faults.stuck_motion(clean, 1.5, 1)))["stuck-samples"]
    for still in (np.zeros(6), np.array([1.5, 0.0, 0.0, 0.0, 0.0, 0.0])):
        values = clean.motion.values.copy()
        values[40:60] = still
        counted = replace(clean, motion=clean.motion.of(clean.motion.t_ns, values))
        assert "stuck-samples" not in messages(audit(counted))


@pytest.mark.parametrize("seed", range(4))
def test_one_twist_that_leaps_where_no_vehicle_can_is_dropped(seed: int) -> None:
    outcome = audit(faults.spike(sound("drive"), 50.0, seed))
    assert [(f.fault, f.count, f.repaired) for f in outcome.findings] == [("implausible", 1, True)]
    assert np.abs(outcome.sequence.motion.values).max() < 20.0


def test_a_vehicle_that_brakes_hard_and_stays_slow_leaps_not() -> None:
    clean = sound("drive")
    values = clean.motion.values.copy()
    values[60:, :3] *= 0.02
    outcome = audit(replace(clean, motion=clean.motion.of(clean.motion.t_ns, values)))
    assert "implausible" not in messages(outcome)


def test_mismatches_beneath_a_noise_that_is_stated_too_large_are_reported_by_their_size() -> None:
    clean = faults.wrong_noise(sound("drive"), 2.0)
    only_the_noise = messages(audit(clean))["track-scatter"]
    assert "stated 2 times too large" in only_the_noise
    assert "have residuals of more than" not in only_the_noise
    reported = messages(audit(faults.exchanged_tracks(clean, 0.1, 1)))["track-scatter"]
    found = re.search(r"frame ([\d.]+)% \+- ([\d.]+)% of the sightings have residuals of more", reported)
    assert found is not None
    # An exchanged sighting spoils the step to it and the one from it: nearly twice the share, less those lost as pairs.
    assert 10.0 < float(found[1]) < 20.0


def test_samples_that_are_rarer_than_frames_are_reported() -> None:
    assert "every 1 s and frames every 0.1 s" in messages(audit(faults.thinned_motion(sound("drive"))))["sparse-motion"]
    assert "sparse-motion" not in messages(audit(faults.thinned_motion(sound("drive"), 3.0)))


@pytest.mark.parametrize("late_s", [0.02, -0.03])
def test_twists_that_come_beside_every_frame_are_reported_where_the_tracks_allow_a_clock_that_is_off(
    late_s: float,
) -> None:
    reported = messages(audit(faults.camera_clock(sound("drive"), late_s)))["time-offset"]
    assert f"to be shifted by {-1e3 * late_s:+.0f} ms" in reported
    found = re.search(r"the offset is ([+-]\d+) \+- (\d+) ms, (which is consistent with zero|[\d.]+)", reported)
    assert found is not None
    # Both are rounded to whole milliseconds.
    least, most = ((abs(int(found[1])) + by) / (int(found[2]) - by) for by in (-0.5, 0.5))
    assert least <= (float(found[3]) if found[3][0].isdigit() else 2.0) <= max(most, 2.0)


def test_twists_at_the_frames_or_at_another_rate_are_no_clock_that_is_off() -> None:
    clean = sound("drive")
    assert not messages(audit(clean))
    late = faults.camera_clock(clean, 0.02)
    other_rate = replace(late, motion=late.motion.of(late.motion.t_ns * 21 // 20, late.motion.values))
    assert _constant_phase_s(late) == pytest.approx(0.02)
    assert _constant_phase_s(other_rate) is None
    assert _constant_phase_s(clean) is None


@pytest.mark.parametrize("samples", [2, 3])
def test_frames_are_not_shifted_where_the_gyro_alone_is_late(samples: int) -> None:
    """Velocities that fit as they are stamped speak against a shift of the frames; a late camera they bear out."""
    clean = sound("drive")
    values = clean.motion.values.copy()
    values[samples:, 3:] = clean.motion.values[:-samples, 3:]
    late = replace(clean, motion=clean.motion.of(clean.motion.t_ns, values))
    found = audit(late)
    offset = next(finding for finding in found.findings if finding.fault == "time-offset")
    assert offset.warning
    assert "the gyro alone is shifted" in offset.detail
    np.testing.assert_array_equal(found.sequence.frames_t_ns, late.frames_t_ns)
    assert "the frames are shifted by it" in messages(audit(faults.camera_clock(clean, -0.1 * samples)))["time-offset"]


def test_an_offset_beyond_chance_is_reported_though_it_is_known_badly() -> None:
    """50 ms, known to more than 6.4 ms: six seconds of a level drive hold little turning."""
    late = faults.camera_clock(sound("drive-imu").truncated(75), -0.05)
    evidence = Evidence(late)
    assert evidence.intervals is not None
    found = camera_offset(late, evidence.intervals)
    assert found is not None
    assert LARGEST_ERROR_S < found.error < abs(found.value) / OFFSET_SIGMAS
    assert "frames are stamped early" in messages(audit(late))["time-offset"]
