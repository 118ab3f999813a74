"""A clock that is set on the way is told from a pause, a repeated stamp and stamps that tremble, by the tracks."""

import re
from dataclasses import replace

import numpy as np
import pytest

from toolkit.audit import audit
from toolkit.audit.edits import keep_frames, keep_samples
from toolkit.audit.fault import Evidence, Symptom, Undecided
from toolkit.audit.timing import clock_jump
from toolkit.sequence import Sequence
from toolkit.simulation import SCENARIOS, faults, simulate

KINDS = ("drive", "drive-imu", "flight")


def recording(scenario: str, seed: int) -> Sequence:
    return simulate(replace(SCENARIOS[scenario], duration_s=6.0, varied=seed % 2 == 1), seed)


@pytest.mark.parametrize("steps", [-1.0, -0.6, 0.6, 1.0, 4.0])
@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("scenario", KINDS)
def test_a_clock_that_is_set_by_steps_is_reported_with_its_size_and_cut_at(
    scenario: str, seed: int, steps: float
) -> None:
    sound = recording(scenario, seed)
    dose_s = steps * float(np.diff(sound.frames_s[:2])[0])
    found = clock_jump(Evidence(faults.clock_jump(sound, dose_s, seed)))
    if scenario == "flight" and isinstance(found, Undecided):  # its tracks tell half of a step on some seeds only
        assert abs(steps) < 1.0 and "jump together" in found.why
        return
    assert isinstance(found, Symptom) and found.harmful and found.remedy is not None
    match = re.search(r"set by ([-+][\d.]+) s at", found.detail)
    assert match is not None and float(match[1]) == pytest.approx(dose_s, abs=1e-6)
    kept = found.remedy
    assert np.ptp(np.diff(kept.frames_t_ns)) <= 2 and np.ptp(np.diff(kept.motion.t_ns)) <= 2  # rounded to nanoseconds
    assert kept.frame_count >= sound.frame_count // 2


@pytest.mark.parametrize("scenario", KINDS)
@pytest.mark.parametrize("seed", range(3))
def test_a_pause_of_both_streams_is_none_for_the_vehicle_goes_on(scenario: str, seed: int) -> None:
    sound = recording(scenario, seed)
    step_s = float(np.diff(sound.frames_s[:2])[0])
    begin_s, end_s = sound.duration_s / 2.0 + step_s * np.array([0.4, 2.6])
    samples_s = sound.elapsed_s(sound.motion.t_ns)
    there = keep_frames(sound, np.flatnonzero((sound.frames_s < begin_s) | (sound.frames_s > end_s)))
    paused = keep_samples(there, (samples_s < begin_s) | (samples_s > end_s))
    assert paused.frame_count < sound.frame_count
    assert clock_jump(Evidence(paused)) is None


def test_a_frame_and_a_sample_that_are_there_twice_are_repeats_and_not_a_jump() -> None:
    sound = recording("drive", 1)
    row = 30
    sample = int(np.searchsorted(sound.motion.t_ns, sound.frames_t_ns[row]))
    twice = keep_frames(sound, np.sort(np.append(np.arange(sound.frame_count), row)))
    seen = sound.observations
    copied = np.flatnonzero(seen.frame == row)
    frame = np.append(np.where(seen.frame > row, seen.frame + 1, seen.frame), np.full(copied.size, row + 1))
    rows = np.append(np.arange(len(seen)), copied)
    twice = replace(twice, observations=type(seen).sorted(frame, seen.track_id[rows], seen.uv_px[rows]))
    twice = keep_samples(twice, np.sort(np.append(np.arange(sound.motion.t_ns.size), sample)))
    found = {finding.fault: finding for finding in audit(twice).findings}
    assert "clock-jump" not in found
    assert found["time-order"].count == 2 and "sorted by time" in found["time-order"].detail


@pytest.mark.parametrize("seed", range(5))
def test_stamps_that_tremble_together_are_no_jumps(seed: int) -> None:
    sound, rng = recording("drive", seed), np.random.default_rng(seed)
    late_ns = np.rint(rng.normal(0.0, 0.02e9, sound.frame_count)).astype(np.int64)
    stamps = np.interp(sound.motion.t_ns, sound.frames_t_ns, sound.frames_t_ns + late_ns).astype(np.int64)
    motion = sound.motion.of(stamps, sound.motion.values)
    assert clock_jump(Evidence(replace(sound, frames_t_ns=sound.frames_t_ns + late_ns, motion=motion))) is None


@pytest.mark.parametrize("seed", range(4))
def test_while_the_vehicle_stands_a_jump_and_a_pause_look_the_same_and_none_is_reported(seed: int) -> None:
    """What its tracks move by is noise, of which every interval has as much, however long it is."""
    standing = faults.standstill(recording("drive", seed), 6.0, seed)
    speed_mps = np.linalg.norm(standing.motion.values[:, :3], axis=1)
    stands_s = standing.elapsed_s(standing.motion.t_ns[speed_mps < 0.2])
    at_s = float(np.median(stands_s)) + 0.03
    samples_s = standing.elapsed_s(standing.motion.t_ns)
    for leap_s in (0.5, 2.0):
        kept = [(t_s < at_s - 0.5 * leap_s) | (t_s > at_s + 0.5 * leap_s) for t_s in (standing.frames_s, samples_s)]
        paused = keep_samples(keep_frames(standing, np.flatnonzero(kept[0])), kept[1])
        leap_ns = round(leap_s * 1e9)
        jumped = replace(
            standing,
            frames_t_ns=standing.frames_t_ns + np.where(standing.frames_s > at_s, leap_ns, 0),
            motion=replace(standing.motion, t_ns=standing.motion.t_ns + np.where(samples_s > at_s, leap_ns, 0)),
        )
        for sequence in (paused, jumped):
            reported = clock_jump(Evidence(sequence))
            assert isinstance(reported, Undecided)
            assert "do not determine whether time passed" in reported.why
