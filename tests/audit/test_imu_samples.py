"""Samples of an IMU that repeat or pile up: found where planted, never where a sensor is only coarse or at rest."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from toolkit.audit import Finding, audit
from toolkit.audit.conventions import accelerometer_axes
from toolkit.audit.fault import Evidence
from toolkit.audit.samples import saturated_samples as saturated
from toolkit.audit.samples import stuck_samples as stuck
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


def test_wheels_that_stand_still_give_zeros_and_are_not_checked() -> None:
    halted = faults.standstill(simulate(replace(SCENARIOS["drive"], duration_s=6.0), 3), 3.0, seed=1)
    stands = np.abs(halted.motion.values[:, :1]) < 0.5
    silent = _with_values(halted, np.where(stands, 0.0, halted.motion.values))
    assert stuck(Evidence(silent)) is None
    assert saturated(Evidence(silent)) is None


def test_an_accelerometer_of_zeros_ends_without_a_warning_of_numpy(clean_recording: Clean) -> None:
    """Which way is up cannot be told: the start is refused or level, and nothing divides by zero."""
    sound = clean_recording("flight", 3, 8.0)
    found = _found(_with_values(sound, np.zeros_like(sound.motion.values)), "stuck-samples")
    assert found.blocking


@pytest.mark.parametrize("column, name", [(2, "accelerometer z"), (4, "gyro y")])
def test_one_axis_that_repeats_a_value_is_named(clean_recording: Clean, column: int, name: str) -> None:
    sound = clean_recording("flight", 3, 8.0)
    values = sound.motion.values.copy()
    values[len(values) // 4 :, column] = values[len(values) // 4, column]
    found = _found(_with_values(sound, values), "stuck-samples")
    assert found.blocking
    assert f"the {name} repeats one value for" in found.detail


def test_a_gyro_sample_no_body_can_turn_by_is_dropped_alone(clean_recording: Clean) -> None:
    sound = clean_recording("flight", 3, 8.0)
    values = sound.motion.values.copy()
    values[[100, 300, 500], [3, 4, 0]] = [300.0, -80.0, 900.0]
    outcome = audit(_with_values(sound, values))
    assert next(f for f in outcome.findings if f.fault == "implausible").count == 3
    assert outcome.sequence.motion.t_ns.size == len(values) - 3


ORDERS = [((0, 1, 2), (-1.0, -1.0, -1.0)), ((0, 1, 2), (1.0, 1.0, -1.0)), ((1, 0, 2), (1.0, 1.0, 1.0))]


@pytest.mark.parametrize("order, signs", ORDERS, ids=["gravity's sign", "one sign", "exchanged"])
@pytest.mark.parametrize("scenario", ["flight", "drive-imu"])
def test_an_accelerometer_in_other_axes_than_the_gyro_is_named(
    clean_recording: Clean, scenario: str, order: tuple[int, ...], signs: tuple[float, ...]
) -> None:
    sound = clean_recording(scenario, 3, 12.0)
    values = sound.motion.values.copy()
    values[:, :3] = values[:, list(order)] * signs
    found = _found(_with_values(sound, values), "accelerometer-axes")
    assert found.blocking
    named = ", ".join(("-" if sign < 0 else "") + "xyz"[axis] for axis, sign in zip(order, signs, strict=True))
    assert f"the accelerometer's x, y, z are the gyro's {named}" in found.detail


@pytest.mark.parametrize("scenario", ["flight", "flight-realistic", "drive-imu"])
@pytest.mark.parametrize("seed", [11, 12, 13])
def test_a_sound_accelerometer_is_not_accused(clean_recording: Clean, scenario: str, seed: int) -> None:
    assert accelerometer_axes(Evidence(clean_recording(scenario, seed, 12.0))) is None
