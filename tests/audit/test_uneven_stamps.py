"""Stamps that come unevenly while the images do not: reported, and never where images are lost or come unevenly."""

import re
from dataclasses import replace

import numpy as np
import pytest

from toolkit.audit.edits import keep_frames
from toolkit.audit.fault import Evidence, Symptom
from toolkit.audit.timing import _even_steps_s, _followed, uneven_stamps
from toolkit.sequence import Sequence
from toolkit.simulation import SCENARIOS, faults, simulate

SCENARIOS_OF = ("drive", "drive-imu", "flight")


def simulated(scenario: str, seed: int = 71) -> Sequence:
    return simulate(replace(SCENARIOS[scenario], duration_s=10.0, varied=True), seed)


def with_frames_lost(sequence: Sequence) -> Sequence:
    lost = np.random.default_rng(5).uniform(size=sequence.frame_count) < 0.3
    lost[[0, -1]] = False
    return keep_frames(sequence, np.flatnonzero(~lost))


@pytest.mark.parametrize("fault", [faults.alternate_frames_late, faults.frame_jitter])
@pytest.mark.parametrize("scenario", SCENARIOS_OF)
def test_stamps_that_the_cameras_motion_does_not_follow_are_reported(scenario: str, fault: faults.Fault) -> None:
    found = uneven_stamps(Evidence(fault(simulated(scenario), 0.015, 3)))
    assert isinstance(found, Symptom) and found.warns
    match = re.search(r"motion shows (\S+) \+- (\S+) of", found.detail)
    assert match is not None
    # None of it, and less: a stamp that is late lengthens one step and shortens the next by the same.
    assert -0.5 < float(match[1]) < 0.1


@pytest.mark.parametrize("seed", [71, 72, 73])
@pytest.mark.parametrize("scenario", SCENARIOS_OF)
def test_frames_that_are_lost_or_stamped_rightly_are_not_accused(scenario: str, seed: int) -> None:
    sound = simulated(scenario, seed)
    for sequence in (sound, with_frames_lost(sound), faults.camera_clock(sound, 0.03)):
        assert uneven_stamps(Evidence(sequence)) is None


@pytest.mark.parametrize("frames", [100, 101])
@pytest.mark.parametrize("scenario", SCENARIOS_OF)
def test_every_other_frame_late_is_reported_whichever_steps_are_more_and_where_frames_are_lost(
    scenario: str, frames: int
) -> None:
    """Of long and short steps that alternate the median is either; and a lost frame is no unevenness."""
    late = faults.alternate_frames_late(simulated(scenario), 0.015).truncated(frames)
    for sequence in (late, with_frames_lost(late)):
        found = uneven_stamps(Evidence(sequence))
        assert isinstance(found, Symptom)
        reported = re.search(r"motion shows (\S+) \+- (\S+) of", found.detail)
        assert reported is not None
        assert -0.25 < float(reported[1]) < 0.1


def test_the_motion_follows_all_of_the_steps_where_stamps_are_right() -> None:
    """Images two and three steps after one another, by turns."""
    sound = simulated("flight")
    sound = keep_frames(sound, np.flatnonzero(np.isin(np.arange(sound.frame_count) % 5, (0, 2))))
    assert uneven_stamps(Evidence(sound)) is None
    camera, step_s = Evidence(sound).camera_motion, np.diff(sound.frames_t_ns) / 1e9
    rates = np.hstack([camera.v_mps, camera.w_radps])
    followed = _followed(rates, step_s, _even_steps_s(step_s), camera.known)
    assert followed is not None
    assert followed.value == pytest.approx(1.0, abs=4.0 * followed.error + 0.02)


def test_a_vehicle_that_stands_decides_nothing() -> None:
    standing = faults.frame_jitter(faults.standstill(simulated("drive"), 8.0, 1), 0.015, 3)
    camera = Evidence(standing).camera_motion
    still = np.linalg.norm(camera.v_mps, axis=1) < 0.05
    step_s = np.diff(standing.frames_t_ns) / 1e9
    rates = np.hstack([camera.v_mps, camera.w_radps])
    followed = _followed(rates, step_s, _even_steps_s(step_s), camera.known & still)
    assert followed is None or followed.value + 5.0 * followed.error > 0.5
