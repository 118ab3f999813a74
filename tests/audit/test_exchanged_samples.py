"""Velocities and rates in each other's place are exchanged back, and what has another unit is not taken for that."""

from dataclasses import replace

import numpy as np
import pytest

from toolkit.audit import audit
from toolkit.audit.fault import Evidence
from toolkit.audit.samples import exchanged_samples
from toolkit.measurements import TwistNoise
from toolkit.models.noise import white_sigma
from toolkit.sequence import Sequence
from toolkit.simulation import SCENARIOS, faults, simulate

KINDS = ("drive", "drive-imu", "flight")


def recording(scenario: str, seed: int) -> Sequence:
    return simulate(replace(SCENARIOS[scenario], duration_s=6.0, varied=seed % 2 == 1), seed)


def exchanged(sequence: Sequence) -> Sequence:
    motion = sequence.motion
    return replace(sequence, motion=motion.of(motion.t_ns, motion.values[:, [3, 4, 5, 0, 1, 2]]))


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("scenario", KINDS)
def test_exchanged_halves_are_found_and_set_right(scenario: str, seed: int) -> None:
    sound = recording(scenario, seed)
    outcome = audit(exchanged(sound))
    assert [(f.fault, f.repaired) for f in outcome.findings if f.fault != "clock-change"] == [
        ("exchanged-samples", True)
    ]
    np.testing.assert_array_equal(outcome.sequence.motion.values, sound.motion.values)


def test_noise_that_was_estimated_from_the_samples_is_exchanged_with_them() -> None:
    """A loader that knows no noise takes the scatter of what it read."""
    swapped = exchanged(recording("drive", 1))
    root_dt = np.sqrt(np.median(np.diff(swapped.motion.t_ns)) / 1e9)
    linear, angular = (white_sigma(half) * root_dt for half in np.split(swapped.motion.values, 2, axis=1))
    assert isinstance(swapped.noise, TwistNoise)
    estimated = replace(swapped.noise, velocity_noise_density=linear, gyro_noise_density=angular)
    noise = audit(replace(swapped, noise=estimated)).sequence.noise
    assert isinstance(noise, TwistNoise)
    np.testing.assert_array_equal(noise.velocity_noise_density, angular)
    np.testing.assert_array_equal(noise.gyro_noise_density, linear)


@pytest.mark.parametrize("dose", [1.0, 3.6, 100.0, 0.102])
@pytest.mark.parametrize("scenario", KINDS)
def test_sound_samples_and_other_units_are_not_exchanged(scenario: str, dose: float) -> None:
    sound = recording(scenario, 5)
    for sequence in (faults.linear_unit(sound, dose), faults.angular_unit(sound, dose)):
        assert exchanged_samples(Evidence(sequence)) is None
