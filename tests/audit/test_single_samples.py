"""Single samples that are no motion, and short runs of one value: found where planted, never in sound recordings."""

from dataclasses import replace

import numpy as np
import pytest

from toolkit.audit.fault import Evidence, Symptom
from toolkit.audit.samples import implausible, stuck_samples
from toolkit.geometry import Array
from toolkit.sequence import Sequence
from toolkit.simulation import SCENARIOS, faults, simulate

KINDS = ("drive", "drive-imu", "flight")


def recording(scenario: str, seed: int) -> Sequence:
    return simulate(replace(SCENARIOS[scenario], duration_s=8.0, varied=seed % 2 == 1), seed)


def with_values(sequence: Sequence, values: Array) -> Sequence:
    return replace(sequence, motion=sequence.motion.of(sequence.motion.t_ns, values))


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("scenario", KINDS)
def test_a_sample_that_leaves_its_neighbours_and_comes_back_is_dropped_alone(scenario: str, seed: int) -> None:
    sound = recording(scenario, seed)
    row = 10 + 13 * seed
    for size in (4.0, -5.0, 8.0):
        for k in range(6):
            values = sound.motion.values.copy()
            values[row, k] += size
            found = implausible(Evidence(with_values(sound, values)))
            assert isinstance(found, Symptom) and found.count == 1 and found.remedy is not None
            assert np.setdiff1d(sound.motion.t_ns, found.remedy.motion.t_ns).tolist() == [sound.motion.t_ns[row]]


@pytest.mark.parametrize("scenario", KINDS)
@pytest.mark.parametrize("seed", range(8))
def test_no_sample_of_a_sound_recording_is_dropped(scenario: str, seed: int) -> None:
    evidence = Evidence(recording(scenario, seed))
    assert implausible(evidence) is None
    assert stuck_samples(evidence) is None


def test_a_knock_that_lasts_and_knocks_that_are_usual_are_motion() -> None:
    sound = recording("flight", 1)
    knocked = sound.motion.values.copy()
    knocked[400:403, 2] += [4.0, 8.0, 4.0]
    assert implausible(Evidence(with_values(sound, knocked))) is None
    walking = sound.motion.values.copy()
    walking[50::60, 2] += 8.0  # a leg that strikes the ground every 0.3 s
    assert implausible(Evidence(with_values(sound, walking))) is None


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("dose_s", [0.35, 0.5, 0.8])
def test_odometry_that_hangs_for_a_third_of_a_second_is_bridged(dose_s: float, seed: int) -> None:
    hung = faults.stuck_motion(recording("drive", seed), dose_s, seed)
    repeats = (hung.motion.values[1:] == hung.motion.values[:-1]).all(axis=1)
    found = stuck_samples(Evidence(hung))
    assert isinstance(found, Symptom) and found.remedy is not None
    assert found.count == repeats.sum()


def test_odometry_that_repeats_itself_now_and_then_or_holds_each_value_does_not_hang() -> None:
    """What is common in the rest of a recording is no fault where it lasts a little longer."""
    sound, rng = recording("drive", 2), np.random.default_rng(2)
    kept = np.maximum.accumulate(np.where(rng.uniform(size=len(sound.motion.t_ns)) < 0.6, np.arange(80 + 1), 0))
    held = with_values(sound, sound.motion.values[kept])
    runs = (held.motion.values[3:] == held.motion.values[:-3]).all(axis=1)
    assert runs.any()  # four in a row are there
    assert stuck_samples(Evidence(held)) is None
