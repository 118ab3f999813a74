"""Causal estimators find that an IMU has more noise than it states, where it has, and change nothing where not."""

from dataclasses import replace

import numpy as np
import pytest

from filters.kalman.motion_noise import MatchedNoise
from toolkit.metrics import score_run
from toolkit.models.corrections import CorrectionTest
from toolkit.resampling import NS_PER_S
from toolkit.settings import Noise, Settings
from toolkit.simulation import DRIVE, DRIVE_IMU, simulate

WINDOW_S = 2.0
SHAKEN = 4.0


@pytest.fixture(scope="module")
def sound():
    """Return eight seconds of a drive whose noise is as stated."""
    return simulate(replace(DRIVE_IMU, duration_s=8.0), 3)


@pytest.fixture(scope="module")
def shaken(sound):
    """Return the same with four times the noise that its IMU states, drawn on top."""
    motion, noise, rng = sound.motion, sound.noise, np.random.default_rng(0)
    per_sample = SHAKEN / np.sqrt(np.median(np.diff(motion.t_ns)) / 1e9)
    accel = motion.accel_mps2 + rng.normal(0.0, per_sample * noise.accel_noise_density, motion.accel_mps2.shape)
    gyro = motion.gyro_radps + rng.normal(0.0, per_sample * noise.gyro_noise_density, motion.gyro_radps.shape)
    return replace(sound, motion=replace(motion, accel_mps2=accel, gyro_radps=gyro))


def tells(run):
    """Say whether the log of a run says that the IMU's noise was not believed."""
    return any("the tracks contradict the IMU" in line for line in run.log)


def taken_in(noise, lengths, first=0):
    """Have noise take in corrections of 15 degrees of freedom, ten a second, of these squared lengths."""
    for k, nis in enumerate(lengths, first):
        noise.take(k * NS_PER_S // 10, CorrectionTest(nis, 15))


def test_the_noise_is_never_taken_for_less_than_stated():
    noise = MatchedNoise(WINDOW_S)
    taken_in(noise, [*[90.0] * 3, *[0.0] * 200])
    assert noise.scale == 1.0


def test_what_no_noise_explains_is_not_taken_for_noise_without_end():
    noise = MatchedNoise(WINDOW_S)
    taken_in(noise, [1e12] * 40)
    assert noise.scale == 1e4


def test_one_correction_within_chance_moves_nothing_and_many_alike_do():
    noise = MatchedNoise(WINDOW_S)
    taken_in(noise, [40.0])  # by chance once in two thousand
    assert noise.scale == 1.0
    taken_in(noise, [40.0] * 20, first=1)
    assert noise.scale > 2.0


def test_the_scale_settles_where_corrections_are_as_large_as_expected():
    noise = MatchedNoise(WINDOW_S)
    for k in range(300):
        taken_in(noise, [15.0 * 16.0 / noise.scale], first=k)
    assert noise.scale == pytest.approx(16.0, rel=1e-3)  # 300 steps of a twentieth of the way


@pytest.mark.parametrize("name", ["msckf-slam", "fixed-lag"])
def test_the_stated_noise_of_a_sound_imu_is_kept(name, sound, run_estimator):
    assert not tells(run_estimator(name, sound))


@pytest.mark.parametrize("name", ["ekf-slam", "msckf-slam", "fixed-lag", "smart"])
def test_an_imu_that_is_shaken_is_found_and_does_less_harm_unless_its_stated_noise_is_to_be_used(
    name, shaken, run_estimator
):
    run = run_estimator(name, shaken)
    assert tells(run)
    as_stated = run_estimator(name, shaken, settings=Settings(noise=Noise(match_imu=False)))
    assert not tells(as_stated)
    metrics = ("nees_pose_mean", "ate_se3_m", "heldout_reproj_median_px")
    found, believed = (score_run(each, "causal", shaken, only=metrics).values for each in (run, as_stated))
    for metric in metrics:
        assert found[metric] < believed[metric]


def test_the_stated_noise_of_a_twist_is_kept_whatever_tracks_show(run_estimator):
    drive = simulate(replace(DRIVE, duration_s=6.0), 3)
    doubtful = replace(drive, noise=drive.noise.scaled(1.0 / SHAKEN))
    assert not tells(run_estimator("msckf-slam", doubtful))
