"""An axis of the gyro with another sensitivity: told with its value, and never where only noise lowers a slope."""

import re
from dataclasses import replace

import numpy as np
import pytest

from toolkit.audit.calibration import gyro_scale
from toolkit.audit.fault import Evidence, Symptom, Undecided
from toolkit.sequence import Sequence
from toolkit.simulation import SCENARIOS, faults, simulate

DURATION_S = {"drive": 15.0, "drive-imu": 12.0, "flight": 8.0, "drive-realistic": 15.0, "flight-realistic": 8.0}


def simulated(scenario: str, seed: int) -> Sequence:
    return simulate(replace(SCENARIOS[scenario], duration_s=DURATION_S[scenario], varied=True), seed)


@pytest.mark.parametrize("dose", [0.85, 1.2])
@pytest.mark.parametrize("scenario", ["drive", "drive-imu", "flight"])
def test_the_sensitivity_of_an_axis_is_reported(scenario: str, dose: float) -> None:
    found = gyro_scale(Evidence(faults.gyro_axis_scale(simulated(scenario, 51), dose)))
    assert isinstance(found, Symptom)
    assert found.warns and found.count == 1
    match = re.search(r"turns (\S+) \+- (\S+) times as fast as the camera about", found.detail)
    assert match is not None
    # A bound is off by the noise of the rates beside their scatter, a percent at most here.
    assert float(match[1]) == pytest.approx(dose, abs=4.0 * float(match[2]) + 0.01)


@pytest.mark.parametrize("seed", [61, 62, 63])
@pytest.mark.parametrize("scenario", list(DURATION_S))
def test_a_sound_gyro_is_not_accused(scenario: str, seed: int) -> None:
    assert not isinstance(gyro_scale(Evidence(simulated(scenario, seed))), Symptom)


def test_noise_of_either_alone_accuses_nobody() -> None:
    sound = simulated("drive", 51)
    rng = np.random.default_rng(3)
    noisy = sound.motion.values + rng.normal(0.0, [0, 0, 0, 0.05, 0.05, 0.05], sound.motion.values.shape)
    for faulty in (
        replace(sound, motion=sound.motion.of(sound.motion.t_ns, noisy)),
        faults.few_tracks(sound, 12.0),  # the camera's own rates are noise in part
    ):
        assert not isinstance(gyro_scale(Evidence(faulty)), Symptom)


def test_what_is_beyond_chance_and_does_not_count_is_reported() -> None:
    found = gyro_scale(Evidence(faults.gyro_axis_scale(simulated("flight", 51), 0.96)))
    assert isinstance(found, Undecided)
    assert "times as fast as the camera about" in found.why
