"""Faults of the motion samples: found where they are planted, with their size, and not where a sensor has its ways."""

from dataclasses import replace

import numpy as np
import pytest

from tests.audit.conftest import recording, with_values
from toolkit.audit import Finding, audit
from toolkit.audit.calibration import gyro_scale
from toolkit.audit.fault import Check, Evidence, Symptom, Undecided
from toolkit.audit.samples import (
    coarse_samples,
    gravity_removed,
    implausible,
    overstated_noise,
    stuck_samples,
    understated_noise,
    units,
)
from toolkit.audit.samples import saturated_samples as saturated
from toolkit.geometry import Array, interpolate_poses
from toolkit.measurements import ImuNoise, TwistNoise
from toolkit.models.noise import white_sigma
from toolkit.motion_samples import ImuSamples, TwistSamples
from toolkit.sequence import Sequence
from toolkit.simulation import faults

KINDS = ("drive", "drive-imu", "flight")


def found(sequence: Sequence, fault: str) -> Finding:
    (finding,) = (finding for finding in audit(sequence).findings if finding.fault == fault)
    return finding


@pytest.mark.parametrize("scenario", ["flight", "drive-imu"])
def test_a_driver_that_hangs_is_a_gap_that_is_bridged(scenario: str) -> None:
    hung = faults.stuck_motion(recording(scenario), 0.5, seed=4)
    repeats = int((hung.motion.values[1:] == hung.motion.values[:-1]).all(axis=1).sum())
    outcome = audit(hung)
    reported = {finding.fault: finding for finding in outcome.findings}
    assert (reported["stuck-samples"].count, reported["stuck-samples"].repaired) == (repeats, True)
    assert reported["motion-gap"].count == 1
    bridges = outcome.sequence.bridges
    assert bridges is not None
    assert (bridges.end_t_ns - bridges.begin_t_ns) / 1e9 == pytest.approx([0.5], abs=0.05)
    assert (bridges.noise_scale > 1.0).all()


@pytest.mark.parametrize(
    ("rows", "columns", "named"),
    [
        (slice(None), slice(3, 6), "the gyro repeats one value for 6"),
        (slice(400, None), [2], "the accelerometer z repeats one value for"),
        (slice(400, None), [4], "the gyro y repeats one value for"),
    ],
)
def test_a_sensor_or_an_axis_that_is_not_connected_blocks_and_is_named(
    rows: slice, columns: slice | list[int], named: str
) -> None:
    def silent(values: Array) -> Array:
        values[rows, columns] = 0.0
        return values

    reported = found(with_values(recording("flight"), silent), "stuck-samples")
    assert reported.blocking and not reported.repaired
    assert named in reported.detail


def test_samples_at_the_end_of_a_range_warn_with_axis_value_and_count() -> None:
    sound = recording("flight")
    limit = float(np.quantile(sound.motion.values[:, 4], 0.9))
    cut = int((sound.motion.values[:, 4] >= limit).sum())
    most = np.where(np.arange(6) == 4, limit, np.inf)
    reported = found(with_values(sound, lambda values: np.minimum(values, most)), "saturated-samples")
    assert reported.warning and not reported.blocking
    assert f"gyro y at {limit:.3g} rad/s ({cut} samples)" in reported.detail
    assert "gyro x" not in reported.detail and "accelerometer" not in reported.detail


@pytest.mark.parametrize("step", [1e-4, 0.05])
def test_a_coarse_sensor_or_one_read_twice_is_neither_stuck_nor_at_its_end(step: float) -> None:
    coarse = with_values(recording("flight"), lambda values: np.round(values / step) * step)
    assert stuck_samples(Evidence(coarse)) is None
    assert saturated(Evidence(coarse)) is None
    twice = with_values(recording("flight"), lambda values: values[np.arange(len(values)) // 2 * 2])
    assert stuck_samples(Evidence(twice)) is None


@pytest.mark.parametrize("dose_s", [0.35, 0.8])
def test_odometry_that_hangs_is_bridged(dose_s: float) -> None:
    hung = faults.stuck_motion(recording("drive"), dose_s, 1)
    repeats = (hung.motion.values[1:] == hung.motion.values[:-1]).all(axis=1)
    symptom = stuck_samples(Evidence(hung))
    assert isinstance(symptom, Symptom) and symptom.remedy is not None
    assert symptom.count == repeats.sum()


def test_wheels_that_stand_or_roll_straight_ahead_and_odometry_that_often_repeats_itself_do_not_hang() -> None:
    sound, rng = recording("drive", 2, 8.0), np.random.default_rng(2)
    standing, rolling = sound.motion.values.copy(), sound.motion.values.copy()
    standing[20:40], rolling[20:40] = 0.0, [1.5, 0.0, 0.0, 0.0, 0.0, 0.0]
    kept = np.maximum.accumulate(np.where(rng.uniform(size=len(sound.motion.t_ns)) < 0.6, np.arange(80 + 1), 0))
    held = sound.motion.values[kept]
    assert (held[3:] == held[:-3]).all(axis=1).any()  # four in a row are there, as is common in the rest of it
    for values in (standing, rolling, held):
        assert stuck_samples(Evidence(with_values(sound, lambda _, values=values: values))) is None  # type: ignore[misc]


@pytest.mark.parametrize("scenario", KINDS)
def test_a_sample_that_leaves_its_neighbours_and_comes_back_is_dropped_alone(scenario: str) -> None:
    sound, row = recording(scenario, 1), 23
    assert implausible(Evidence(sound)) is None
    for size in (4.0, -5.0, 80.0):
        for k in range(6):
            leap = size * (np.arange(len(sound.motion.t_ns)) == row)[:, None] * np.eye(6)[k]
            symptom = implausible(Evidence(with_values(sound, lambda values, leap=leap: values + leap)))  # type: ignore[misc]
            assert isinstance(symptom, Symptom) and symptom.count == 1 and symptom.remedy is not None
            assert np.setdiff1d(sound.motion.t_ns, symptom.remedy.motion.t_ns).tolist() == [sound.motion.t_ns[row]]


def test_a_knock_that_lasts_knocks_that_are_usual_and_hard_braking_are_motion() -> None:
    def knocked(values: Array) -> Array:
        values[400:403, 2] += [4.0, 8.0, 4.0]
        return values

    def walking(values: Array) -> Array:
        values[50::60, 2] += 8.0  # a leg that strikes the ground every 0.3 s
        return values

    def braking(values: Array) -> Array:
        values[60:, :3] *= 0.02
        return values

    for scenario, change in (("flight", knocked), ("flight", walking), ("drive", braking)):
        assert implausible(Evidence(with_values(recording(scenario), change))) is None


def test_steps_count_from_half_of_the_stated_noise_on() -> None:
    """A gyro of 200 samples a second and a density of 1.7e-4 rad/s/sqrt(Hz): 0.0024 rad/s a sample."""
    sigma = 1.7e-4 * np.sqrt(200.0)
    for share, expected in ((0.01, False), (0.4, False), (0.6, True)):
        step = np.where(np.arange(6) < 3, 1e-12, share * sigma * np.sqrt(12.0))
        rounded = with_values(recording("flight"), lambda values, step=step: step * np.round(values / step))  # type: ignore[misc]
        assert (coarse_samples(Evidence(rounded)) is not None) == expected
    unused = with_values(recording("drive"), lambda values: values * [1.0, 0.0, 1.0, 1.0, 1.0, 1.0])
    assert coarse_samples(Evidence(unused)) is None


def exchanged(sequence: Sequence) -> Sequence:
    return with_values(sequence, lambda values: values[:, [3, 4, 5, 0, 1, 2]])


@pytest.mark.parametrize("scenario", KINDS)
def test_exchanged_halves_are_found_and_set_right(scenario: str) -> None:
    sound = recording(scenario)
    outcome = audit(exchanged(sound))
    assert [(f.fault, f.repaired) for f in outcome.findings] == [("exchanged-samples", True)]
    np.testing.assert_array_equal(outcome.sequence.motion.values, sound.motion.values)


def test_noise_that_was_estimated_from_the_samples_is_exchanged_with_them() -> None:
    """A loader that knows no noise takes the scatter of what it read."""
    swapped = exchanged(recording("drive", 1, 6.0))
    root_dt = np.sqrt(np.median(np.diff(swapped.motion.t_ns)) / 1e9)
    linear, angular = (white_sigma(half) * root_dt for half in np.split(swapped.motion.values, 2, axis=1))
    assert isinstance(swapped.noise, TwistNoise)
    estimated = replace(swapped.noise, velocity_noise_density=linear, gyro_noise_density=angular)
    noise = audit(replace(swapped, noise=estimated)).sequence.noise
    assert isinstance(noise, TwistNoise)
    np.testing.assert_array_equal(noise.velocity_noise_density, angular)
    np.testing.assert_array_equal(noise.gyro_noise_density, linear)


def test_noise_of_gyro_or_camera_is_no_sensitivity_and_what_does_not_count_is_undecided() -> None:
    sound, rng = recording("drive", 51, 15.0), np.random.default_rng(3)
    noise = rng.normal(0.0, [0, 0, 0, 0.05, 0.05, 0.05], sound.motion.values.shape)
    for faulty in (with_values(sound, lambda values: values + noise), faults.few_tracks(sound, 12.0)):
        assert not isinstance(gyro_scale(Evidence(faulty)), Symptom)
    beyond_chance = gyro_scale(Evidence(faults.gyro_axis_scale(recording("flight", 51), 0.96)))
    assert isinstance(beyond_chance, Undecided)


@pytest.mark.parametrize(
    ("check", "name", "factor"),
    [
        (overstated_noise, "accel_noise_density", 1e3),
        (overstated_noise, "gyro_noise_density", 1e3),
        (overstated_noise, "accel_random_walk", 1e4),  # the motion of a flight hides a smaller walk
        (understated_noise, "accel_noise_density", 0.02),
        (understated_noise, "gyro_noise_density", 0.02),
    ],
)
def test_noise_stated_far_off_is_reported_by_its_name_and_room_for_vibration_is_not(
    check: Check, name: str, factor: float
) -> None:
    flight = recording("flight", 3, 8.0)
    noise = flight.noise
    assert isinstance(noise, ImuNoise)
    reported = check(Evidence(replace(flight, noise=replace(noise, **{name: factor * getattr(noise, name)}))))
    assert isinstance(reported, Symptom) and reported.warns
    assert name in reported.detail
    assert check(Evidence(replace(flight, noise=noise.scaled(10.0 if factor > 1.0 else 1.0 / 15.0)))) is None


def test_gravity_that_was_taken_out_is_no_unit() -> None:
    """What is left of a flight's accelerations is a tenth of gravity in the median, as values in g are."""
    flight = recording("flight", 3, 8.0)
    motion, truth = flight.motion, flight.truth
    assert isinstance(motion, ImuSamples) and truth is not None
    poses = interpolate_poses(truth.t_ns, truth.T_world_imu, np.clip(motion.t_ns, *truth.t_ns[[0, -1]]))
    left = motion.accel_mps2 + np.einsum("nji,j->ni", poses[:, :3, :3], flight.gravity_world)

    def reading(accel_mps2: Array) -> Evidence:
        return Evidence(replace(flight, motion=ImuSamples(motion.t_ns, accel_mps2, motion.gyro_radps)))

    for removed in (left, left / np.median(np.linalg.norm(left, axis=1))):
        assert isinstance(gravity_removed(reading(removed)), Symptom)
        assert units(reading(removed)) is None
    assert gravity_removed(reading(np.tile([0.1, 0.2, -0.1], (motion.t_ns.size, 1)))) is not None  # at rest
    for scale in (0.3, 1.0 / 9.80665):
        assert gravity_removed(reading(scale * motion.accel_mps2)) is None


def test_a_camera_far_from_the_origin_of_a_long_vehicle_is_in_no_other_unit() -> None:
    """Odometry of a point 14 m behind, by which the tracks move as they should; and the same arm in millimetres."""
    drive = recording("drive")
    behind_m, motion, arm = np.array([-14.0, 0.0, 0.0]), drive.motion, drive.rig.T_imu_cam.copy()
    assert isinstance(motion, TwistSamples)
    arm[:3, 3] -= behind_m
    v_mps = motion.v_mps + np.cross(motion.w_radps, behind_m)
    moved = replace(
        drive, motion=TwistSamples(motion.t_ns, v_mps, motion.w_radps), rig=replace(drive.rig, T_imu_cam=arm)
    )
    assert units(Evidence(moved)) is None
    assert "its translation is in millimetres" in units(Evidence(faults.extrinsic_unit(drive, 1000.0))).detail


@pytest.mark.parametrize(
    ("scenario", "order", "signs"),
    [
        ("flight", (0, 1, 2), (-1.0, -1.0, -1.0)),  # gravity's sign
        ("flight", (1, 0, 2), (1.0, 1.0, 1.0)),
        ("drive-imu", (0, 1, 2), (1.0, 1.0, -1.0)),
    ],
)
def test_an_accelerometer_in_other_axes_than_the_gyro_is_named(
    scenario: str, order: tuple[int, ...], signs: tuple[float, ...]
) -> None:
    turned = with_values(recording(scenario, 3, 12.0), lambda v: np.hstack([v[:, list(order)] * signs, v[:, 3:]]))
    reported = found(turned, "accelerometer-axes")
    assert reported.blocking
    named = ", ".join(("-" if sign < 0 else "") + "xyz"[axis] for axis, sign in zip(order, signs, strict=True))
    assert f"the accelerometer's x, y, z are the gyro's {named}" in reported.detail
