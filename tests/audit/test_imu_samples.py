"""Samples of an IMU that repeat or pile up: found where planted, never where a sensor is only coarse or at rest."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from toolkit.audit import Finding, audit
from toolkit.audit.fault import Evidence
from toolkit.audit.saturated_samples import check as saturated
from toolkit.audit.stuck_samples import check as stuck
from toolkit.sequence import Sequence
from toolkit.simulation import SCENARIOS, faults, simulate

Clean = Callable[..., Sequence]


def _found(sequence: Sequence, fault: str) -> Finding:
    (finding,) = (finding for finding in audit(sequence).findings if finding.fault == fault)
    return finding


def _with_values(sequence: Sequence, values: np.ndarray) -> Sequence:
    return replace(sequence, motion=sequence.motion.of(sequence.motion.t_ns, values))


@pytest.mark.parametrize("scenario", ["flight", "drive-imu"])
def test_a_driver_that_hangs_is_a_gap_that_is_bridged(clean_recording: Clean, scenario: str) -> None:
    sound = clean_recording(scenario, 3, 8.0)
    hung = faults.stuck_motion(sound, 0.5, seed=4)
    repeats = int((hung.motion.values[1:] == hung.motion.values[:-1]).all(axis=1).sum())
    outcome = audit(hung)
    found = {finding.fault: finding for finding in outcome.findings}
    assert (found["stuck-samples"].count, found["stuck-samples"].repaired) == (repeats, True)
    assert found["motion-gap"].count == 1
    bridges = outcome.sequence.bridges
    assert bridges is not None
    assert (bridges.end_t_ns - bridges.begin_t_ns) / 1e9 == pytest.approx([0.5], abs=0.05)
    assert (bridges.noise_scale > 1.0).all()


def test_a_sensor_that_is_not_connected_blocks_and_is_named(clean_recording: Clean) -> None:
    sound = clean_recording("flight", 3, 8.0)
    values = sound.motion.values.copy()
    values[:, 3:] = 0.0
    found = _found(_with_values(sound, values), "stuck-samples")
    assert found.blocking and not found.repaired
    assert "the gyro repeats one value for 8" in found.detail
    assert "accelerometer" not in found.detail


def test_samples_at_the_end_of_a_range_warn_with_axis_value_and_count(clean_recording: Clean) -> None:
    sound = clean_recording("flight", 3, 8.0)
    values = sound.motion.values.copy()
    limit = float(np.quantile(values[:, 4], 0.9))
    cut = int((values[:, 4] >= limit).sum())
    values[:, 4] = np.minimum(values[:, 4], limit)
    found = _found(_with_values(sound, values), "saturated-samples")
    assert found.warning and not found.blocking
    assert f"gyro y at {limit:.3g} rad/s ({cut} samples)" in found.detail
    assert "gyro x" not in found.detail and "accelerometer" not in found.detail


@pytest.mark.parametrize("step", [1e-4, 1e-2, 0.05])
def test_a_coarse_sensor_is_neither_stuck_nor_at_its_end(clean_recording: Clean, step: float) -> None:
    sound = clean_recording("flight", 3, 8.0)
    coarse = _with_values(sound, np.round(sound.motion.values / step) * step)
    assert stuck(Evidence(coarse)) is None
    assert saturated(Evidence(coarse)) is None


def test_a_sensor_read_twice_as_often_as_it_measures_is_not_stuck(clean_recording: Clean) -> None:
    sound = clean_recording("flight", 3, 8.0)
    held = sound.motion.values[np.arange(len(sound.motion.t_ns)) // 2 * 2]
    assert stuck(Evidence(_with_values(sound, held))) is None


def test_wheels_that_stand_still_give_zeros_and_are_not_judged() -> None:
    halted = faults.standstill(simulate(replace(SCENARIOS["drive"], duration_s=6.0), 3), 3.0, seed=1)
    silent = _with_values(halted, np.where(np.abs(halted.motion.values) < 0.5, 0.0, halted.motion.values))
    assert stuck(Evidence(silent)) is None
    assert saturated(Evidence(silent)) is None


def test_an_accelerometer_of_zeros_ends_without_a_warning_of_numpy(clean_recording: Clean) -> None:
    """Which way is up cannot be told: the start is refused or level, and nothing divides by zero."""
    sound = clean_recording("flight", 3, 8.0)
    found = _found(_with_values(sound, np.zeros_like(sound.motion.values)), "stuck-samples")
    assert found.blocking
