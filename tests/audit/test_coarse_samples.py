"""Motion samples that were rounded are told with their step beside the stated noise, and no others."""

from dataclasses import replace

import numpy as np
import pytest

from toolkit.audit.fault import Evidence, Symptom
from toolkit.audit.samples import coarse_samples
from toolkit.sequence import Sequence
from toolkit.simulation import SCENARIOS, faults, simulate


def simulated(scenario: str) -> Sequence:
    return simulate(replace(SCENARIOS[scenario], duration_s=12.0), 3)


@pytest.mark.parametrize("scenario", ["drive", "drive-imu", "flight"])
def test_rounded_samples_are_reported_with_their_step(scenario: str) -> None:
    found = coarse_samples(Evidence(faults.coarse_samples(simulated(scenario), 0.1)))
    assert isinstance(found, Symptom) and found.warns
    assert "in steps of 0.1 rad/s, which adds errors of 0.029" in found.detail


@pytest.mark.parametrize("scenario", ["drive", "drive-imu", "flight"])
def test_samples_with_all_their_digits_are_not_accused(scenario: str) -> None:
    sound = simulated(scenario)
    assert coarse_samples(Evidence(sound)) is None
    assert coarse_samples(Evidence(faults.coarse_samples(sound, 1e-4))) is None


def test_steps_count_from_half_of_the_stated_noise_on() -> None:
    """A gyro of 200 samples a second and a density of 1.7e-4 rad/s/sqrt(Hz): 0.0024 rad/s a sample."""
    flight = simulated("flight")
    sigma = 1.7e-4 * np.sqrt(200.0)
    for share, expected in ((0.4, False), (0.6, True)):
        values = flight.motion.values.copy()
        step = share * sigma * np.sqrt(12.0)
        values[:, 3:] = step * np.round(values[:, 3:] / step)
        found = coarse_samples(Evidence(replace(flight, motion=flight.motion.of(flight.motion.t_ns, values))))
        assert (found is not None) == expected


def test_a_wheel_that_stands_or_an_axis_that_is_never_used_is_no_step() -> None:
    drive = simulated("drive")
    values = drive.motion.values.copy()
    values[:, 1] = 0.0
    values[:40, :3] = 0.0
    assert coarse_samples(Evidence(replace(drive, motion=drive.motion.of(drive.motion.t_ns, values)))) is None
