"""On tracks that walk and are offset, an estimator that is told so knows how far it is off; told white, it does not."""

from dataclasses import replace

import numpy as np
import pytest

from filters import fixed_lag, msckf_fej, msckf_slam
from toolkit.metrics import score_run
from toolkit.runner import run
from toolkit.settings import POLICIES, Noise, Settings
from toolkit.simulation import FLIGHT
from toolkit.simulation.track_noise import TrackNoise

# Four times the noise of real tracks: told white, with half a pixel for every sighting, it shows in a few seconds.
NOISE = TrackNoise(np.array([0.12, 0.24, 0.12]), np.full(3, 0.5), np.array([0.0, 2.8, 0.0]))
SCENARIO = replace(FLIGHT, duration_s=3.0, camera=replace(FLIGHT.camera, max_tracks=30))
# Windowed filters told white noise would find for themselves that it is not.
SETTINGS = Settings(noise=Noise(match_tracks=False), outliers=POLICIES["none"])


@pytest.mark.parametrize(
    ("estimator", "rate_hz"),
    # Told half the walk, the filters' NEES is 4 at either rate; the smoother's is 5 at 20 Hz, and 1.4 at 10 Hz.
    [(msckf_fej, 10.0), (msckf_slam, 10.0), (fixed_lag, 20.0)],
    ids=["msckf_fej", "msckf_slam", "fixed_lag"],
)
def test_the_covariance_is_that_of_the_errors_where_the_noise_of_tracks_is_reported(estimator, rate_hz, oracle):
    messages, white = [], []
    scenario = replace(SCENARIO, camera=replace(SCENARIO.camera, rate_hz=rate_hz))
    for seed in range(3):
        sequence = oracle.with_track_errors(scenario, NOISE, seed)
        untold = replace(sequence, rig=replace(sequence.rig, track_noise=None))
        for which, found in ((sequence, messages), (untold, white)):
            result = run("one", estimator.build, which, which.prior, settings=SETTINGS)
            scores = score_run(result, "causal", which, only=["nees_pose_mean"])
            found.append(scores.values["nees_pose_mean"])
    # Errors of successive poses are nearly the same one: of three runs the mean is known to a third at best.
    assert 0.5 < np.mean(messages) < 1.6
    # Above what is let pass for honest, by more than the mean of the runs of an honest filter varies.
    assert np.mean(white) > 1.8
