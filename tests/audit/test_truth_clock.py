"""A truth by a clock of another pace, or without orientations: told where planted, with its standard error."""

import re
from dataclasses import replace

import numpy as np
import pytest

from toolkit.audit import audit
from toolkit.audit.fault import Evidence, Symptom, Undecided
from toolkit.audit.truth import truth_clock, truth_mismatch
from toolkit.sequence import Sequence
from toolkit.simulation import SCENARIOS, faults, simulate

DURATION_S = {"drive": 12.0, "drive-imu": 12.0, "flight": 6.0}


def simulated(scenario: str, seed: int) -> Sequence:
    return simulate(replace(SCENARIOS[scenario], duration_s=DURATION_S[scenario], varied=True), seed)


@pytest.mark.parametrize("pace", [1.03, 0.95, 1.015])
@pytest.mark.parametrize("scenario", list(DURATION_S))
def test_the_pace_of_the_truths_clock_is_reported(scenario: str, pace: float) -> None:
    faulty = faults.truth_clock_rate(simulated(scenario, 31), pace)
    symptom = truth_clock(Evidence(faulty))
    assert isinstance(symptom, Symptom)
    assert symptom.warns and symptom.remedy is None
    match = re.search(r"time passes (\S+) \+- (\S+) times as fast", symptom.detail)
    assert match is not None
    assert float(match[1]) == pytest.approx(pace, abs=4.0 * float(match[2]))
    assert float(match[2]) < 0.005  # a third of the least pace that is planted; measured 0.0010 to 0.0031


@pytest.mark.parametrize("seed", range(41, 45))
@pytest.mark.parametrize("scenario", list(DURATION_S))
def test_a_truth_by_the_frames_clock_is_not_accused(scenario: str, seed: int) -> None:
    evidence = Evidence(simulated(scenario, seed))
    assert not isinstance(truth_clock(evidence), Symptom)
    assert evidence.truth_clock is not None and evidence.truth_clock.rate is not None
    value, error = evidence.truth_clock.rate
    assert abs(value) < 4.0 * error


def test_a_clock_is_reported_once_either_by_its_offset_or_by_its_pace() -> None:
    sound = simulated("flight", 32)
    assert sound.truth is not None
    late = replace(sound, truth=replace(sound.truth, t_ns=sound.truth.t_ns + 100_000_000))
    messages = [[f.fault for f in audit(s).findings] for s in (faults.truth_clock_rate(sound, 1.04), late)]
    assert [[name for name in names if "truth" in name] for names in messages] == [["truth-clock"], ["truth-mismatch"]]


def test_a_truth_without_turns_leaves_its_clock_open() -> None:
    """On a road that goes straight ahead nothing tells the truth's clock."""
    straight = faults.standstill(simulated("drive", 4), 8.0, 1)
    reported = truth_clock(Evidence(straight))
    assert isinstance(reported, Undecided)
    assert "too little change of rotation" in reported.why


@pytest.mark.parametrize("scenario", list(DURATION_S))
def test_orientations_that_were_not_written_are_reported(scenario: str) -> None:
    faulty = faults.unwritten_orientations(simulated(scenario, 33))
    symptom = truth_mismatch(Evidence(faulty))
    assert isinstance(symptom, Symptom)
    assert "all orientations of the truth are equal" in symptom.detail
    assert faulty.truth is not None
    assert np.ptp(faulty.truth.T_world_imu[:, :3, 3], axis=0).max() > 0.0
