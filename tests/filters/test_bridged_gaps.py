"""Estimators that bridge gaps between tracks: less error there, no more claimed than they know, no change elsewhere."""

from dataclasses import replace

import numpy as np
import pytest

from toolkit.measured_motion import TwistNoise
from toolkit.metrics import score_run
from toolkit.settings import Noise, Settings, Window
from toolkit.simulation import DRIVE, simulate
from toolkit.simulation.track_faults import cut_tracks

# Twists as noisy as those of the course's drives: 0.5 m/s and 0.05 rad/s on samples of 0.1 s.
NOISY = TwistNoise(np.full(3, 0.5 * np.sqrt(0.1)), np.full(3, 0.05 * np.sqrt(0.1)), np.full(3, 1e-5))
SCENARIO = replace(
    DRIVE, duration_s=5.0, motion=replace(DRIVE.motion, noise=NOISY), camera=replace(DRIVE.camera, max_tracks=30)
)
BRIDGED, UNBRIDGED = Noise(), Noise(bridge_gaps=False)


@pytest.mark.parametrize("name", ["msckf-fej", "msckf-slam", "fixed-lag", "batch"])
def test_the_error_is_lower_and_not_claimed_to_be_lower_still(name, run_estimator):
    """All tracks end before one frame in twelve."""
    errors_m, nees = [], []
    for seed in range(2):
        sequence = cut_tracks(simulate(SCENARIO, seed), 0.08, seed)
        runs = [run_estimator(name, sequence, settings=Settings(noise=noise)) for noise in (UNBRIDGED, BRIDGED)]
        scores = [score_run(run, "final", sequence, only=["ate_none_m", "nees_pose_mean"]).values for run in runs]
        errors_m.append([values["ate_none_m"] for values in scores])
        nees.append(scores[1]["nees_pose_mean"])
    without, bridged = np.mean(errors_m, axis=0)
    assert bridged < 0.8 * without
    # Errors of successive poses are nearly the same one: of two runs the mean is known to two thirds at best.
    assert np.mean(nees) < 1.7


@pytest.mark.parametrize("name", ["msckf-slam", "fixed-lag"])
def test_where_tracks_lead_on_everywhere_nothing_changes(name, run_estimator):
    sequence = simulate(replace(DRIVE, duration_s=1.0), 1)
    runs = [run_estimator(name, sequence, settings=Settings(noise=noise)) for noise in (UNBRIDGED, BRIDGED)]
    np.testing.assert_array_equal(runs[0].final.T_world_imu, runs[1].final.T_world_imu)


@pytest.mark.parametrize("name", ["msckf-fej", "fixed-lag"])
def test_a_window_too_short_for_three_states_is_left_as_it_is(name, run_estimator):
    sequence = cut_tracks(simulate(replace(SCENARIO, duration_s=1.5), 0), 0.3, 0)
    settings = Settings(noise=BRIDGED, window=Window(lag_s=0.05))
    assert run_estimator(name, sequence, settings=settings).status == "ok"
