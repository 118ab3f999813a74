"""What a seed changes, what it does not, and that a simulated recording is clean."""

from dataclasses import replace

import numpy as np
import pytest

from toolkit.datasets import simulated
from toolkit.geometry import Array, se3_inverse, se3_log
from toolkit.models.stereo import CHANNELS, disparity_px
from toolkit.sequence import check_runnable
from toolkit.simulation import DRIVE, DRIVE_IMU, FLIGHT, SCENARIOS, Scenario, noise_free, simulate

every_scenario = pytest.mark.parametrize("scenario", SCENARIOS.values(), ids=SCENARIOS)


def short(scenario: Scenario) -> Scenario:
    return replace(scenario, duration_s=3.0)


@every_scenario
def test_seeds_differ_in_errors_only_and_give_the_same_bits_again(scenario: Scenario) -> None:
    one, again, other = (simulate(short(scenario), seed) for seed in (1, 1, 2))
    assert one.content_hash() == again.content_hash() != other.content_hash()
    np.testing.assert_array_equal(one.truth.T_world_imu, other.truth.T_world_imu)
    np.testing.assert_array_equal(one.truth.v_world, other.truth.v_world)
    assert one.noise == other.noise and other.name == scenario.name
    assert "seed 2" in other.provenance.source
    assert np.abs(one.motion.values - other.motion.values).min() > 0.0


@every_scenario
def test_one_stream_of_errors_does_not_move_another(scenario: Scenario) -> None:
    plain = simulate(short(scenario), 1)
    outliers, other_tracks = (
        simulate(replace(short(scenario), camera=replace(scenario.camera, **changed)), 1)
        for changed in ({"outlier_rate": 0.2}, {"loss_per_frame": 0.3})
    )
    np.testing.assert_array_equal(plain.observations.track_id, outliers.observations.track_id)
    for one in (outliers, other_tracks):
        np.testing.assert_array_equal(plain.motion.values, one.motion.values)
        np.testing.assert_array_equal(plain.prior.T_world_imu, one.prior.T_world_imu)


def test_scenarios_under_one_seed_are_independent_draws() -> None:
    drive, imu, flight = (_prior_errors(scenario) for scenario in (DRIVE, DRIVE_IMU, FLIGHT))
    # 240 products of independent standard normal numbers: their mean has a standard deviation of 0.065.
    for one, other in ((drive, imu), (drive, flight), (imu, flight)):
        assert abs(np.mean(one * other)) < 4.0 / np.sqrt(one.size)


def _prior_errors(scenario: Scenario) -> Array:
    """Return the errors (40, 6) of the prior's pose under 40 seeds, in standard deviations."""
    errors = []
    for seed in range(40):
        sequence = simulate(replace(scenario, duration_s=0.2), seed)
        error = se3_log(se3_inverse(sequence.truth.T_world_imu[0]) @ sequence.prior.T_world_imu)
        errors.append(error / np.sqrt(np.diag(sequence.prior.cov)[:6]))
    return np.array(errors)


@every_scenario
def test_a_varied_world_has_trajectory_and_landmarks_of_its_own_under_every_seed(scenario: Scenario) -> None:
    fixed, one, again, other = (
        simulate(replace(short(scenario), varied=varied), seed)
        for varied, seed in ((False, 1), (True, 1), (True, 1), (True, 2))
    )
    assert one.content_hash() == again.content_hash()
    for different in (fixed, other):
        assert np.abs(one.truth.T_world_imu - different.truth.T_world_imu).max() > 0.1
    np.testing.assert_array_equal(one.motion.t_ns, fixed.motion.t_ns)


@pytest.mark.parametrize(("varied", "fewest"), [(False, 40), (True, 20)])
@every_scenario
def test_a_recording_is_clean_and_the_camera_sees_enough(scenario: Scenario, varied: bool, fewest: int) -> None:
    for seed in range(3):
        sequence = simulate(replace(scenario, duration_s=10.0, varied=varied), seed)
        seen, (width, height) = sequence.observations, scenario.camera.size_px
        check_runnable(sequence)
        assert disparity_px(seen.uv_px).min() > 0.0
        assert np.bincount(seen.frame, minlength=sequence.frame_count).min() >= fewest
        assert (seen.uv_px >= 0.0).all()
        assert (seen.uv_px <= [width - 1, width - 1, height - 1]).all()


@every_scenario
def test_tracks_live_as_long_as_a_real_trackers_do(scenario: Scenario) -> None:
    """The KITTI recordings of the project have 10 to 13 sightings a track, EuRoC's front ends 20 and more."""
    lives = np.bincount(simulate(scenario, 0).observations.track_id)
    low, high = (15.0, 35.0) if scenario is FLIGHT else (8.0, 16.0)
    assert low < lives.mean() < high


def test_five_scenarios_are_recordings_by_name() -> None:
    assert set(simulated.BUILT_IN) == {"drive", "drive-imu", "flight", "drive-realistic", "flight-realistic"}


@pytest.mark.parametrize(
    "scenario", [s for s in SCENARIOS.values() if s.track_noise is not None], ids=lambda scenario: scenario.name
)
def test_errors_of_realistic_tracks_are_those_stated(scenario: Scenario) -> None:
    short = replace(scenario, duration_s=8.0, slip_share=0.0)
    exact, noisy = (simulate(each, 3).observations for each in (noise_free(short), short))
    assert np.array_equal(exact.track_id, noisy.track_id) and short.track_noise is not None
    error_px = (noisy.uv_px - exact.uv_px) @ CHANNELS.T
    first, row = np.unique(noisy.track_id, return_index=True, return_inverse=True)[1:]
    age = noisy.frame - noisy.frame[first][row]
    noise = short.track_noise
    for old in (0, 4):
        variance_px2 = noise.white_px**2 + old * noise.walk_px**2 + noise.offset_px**2
        # Some two hundred tracks and more: four standard errors of a standard deviation are 20 %.
        np.testing.assert_allclose(error_px[age == old].std(axis=0), np.sqrt(variance_px2), rtol=0.2)
