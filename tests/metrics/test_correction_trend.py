"""Corrections that lean one way are told from those of a consistent estimator, which are independent."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.special import chdtri

from toolkit.answers import Run
from toolkit.estimate import Landmarks, Trajectory
from toolkit.metrics import Evaluation, correction_trend
from toolkit.metrics.correction_trend import LIMIT, TREND
from toolkit.metrics.parts.scores import Unavailable
from toolkit.models.corrections import Correction
from toolkit.models.motion import motion_model
from toolkit.models.state import POSE, predicted
from toolkit.simulation import DRIVE, DRIVE_IMU, simulate

DURATION_S = {"drive": 40.0, "drive-imu": 20.0}


@pytest.fixture(scope="module", params=["drive", "drive-imu"])
def recording(request):
    """Return a drive with twists, or with an IMU."""
    scenario = {"drive": DRIVE, "drive-imu": DRIVE_IMU}[request.param]
    return simulate(replace(scenario, duration_s=DURATION_S[request.param]), 4)


@cache
def fixes(recording, lean=0.0, seed=0):
    """Return the run of a Kalman filter whose pose is measured in every frame, and the squares of its innovations.

    The true state is drawn: what the filter predicts from it, moved by the noise that the motion states, and by
    ``lean`` standard deviations of it forwards: the position, or the velocity where it is part of the state.
    """
    model, rng = motion_model(recording.noise, recording.gravity_world), np.random.default_rng(seed)
    belief = model.initial_belief(recording.prior)
    d, noise = len(belief.cov), np.diag(np.repeat([1e-3, 1e-2], 3) ** 2)
    forwards = 3 if model.layout.velocity is None else model.layout.velocity.start
    truth, reported, nis = belief.moved(rng.multivariate_normal(np.zeros(d), belief.cov), belief.cov), [], []
    for packet in recording.packets():
        belief = predicted(belief, model, packet.motion)
        if packet.motion is not None:
            prediction = model.integrate(packet.motion, truth.bias).predict(truth)
            moved = rng.multivariate_normal(np.zeros(d), prediction.noise, check_valid="ignore")
            moved[forwards] += lean * np.sqrt(prediction.noise[forwards, forwards])
            truth = truth.predicted(prediction).moved(moved, belief.cov)
        innovation = belief.error_to(truth)[POSE] + rng.multivariate_normal(np.zeros(6), noise, check_valid="ignore")
        S = belief.cov[POSE, POSE] + noise
        gain = np.linalg.solve(S, belief.cov[POSE]).T
        nis.append(float(innovation @ np.linalg.solve(S, innovation)))
        belief = belief.moved(gain @ innovation, belief.cov - gain @ S @ gain.T)
        reported.append(belief.estimate(packet.frame.t_ns))
    causal = Trajectory.of(reported)
    return Run("fixes", "ok", causal, causal, Landmarks.none(), None, {}), np.array(nis) / 6.0


def scored(run, recording):
    return correction_trend.score(Evaluation(run, "causal", recording)).values


def test_the_trend_of_a_consistent_filter_is_one(recording):
    trends = [scored(fixes(recording, seed=seed)[0], recording)[TREND] for seed in range(2)]
    seconds = 2 * (recording.duration_s - 1.0)
    # Four standard errors of chi-square with at least six degrees of freedom a second.
    assert np.mean(trends) == pytest.approx(1.0, abs=4.0 * np.sqrt(2.0 / (6.0 * seconds)))


def test_a_lean_that_innovations_hardly_show_is_beyond_the_limit(recording):
    """Of an IMU most is taken for a bias of its accelerometer: it takes more of it."""
    run, nis = fixes(recording, lean={"twist": 1.5, "imu": 30.0}[recording.motion_kind])
    values = scored(run, recording)
    assert values[TREND] > values[LIMIT]
    assert nis.mean() - 1.0 < 0.25 * (values[TREND] - 1.0)
    upright = scored(fixes(recording)[0], recording)
    assert upright[TREND] < 0.6 * upright[LIMIT]


def test_the_limit_is_twice_what_chance_exceeds_once_in_a_million(recording):
    """With six to all of the state's degrees of freedom in each whole second."""
    limit = scored(fixes(recording)[0], recording)[LIMIT]
    seconds, d = int(recording.duration_s), motion_model(recording.noise, recording.gravity_world).layout.size
    bounds = [2.0 * chdtri(dof, 1e-6) / dof for dof in ((seconds - 1) * 6, (seconds + 1) * d)]
    assert bounds[1] < limit < bounds[0]


def test_what_corrects_nothing_and_what_holds_its_biases_has_no_trend(recording):
    run, _ = fixes(recording)
    model = motion_model(recording.noise, recording.gravity_world)
    reported, belief = [], model.initial_belief(recording.prior)
    for packet in recording.packets():
        belief = predicted(belief, model, packet.motion)
        reported.append(belief.estimate(packet.frame.t_ns))
    with pytest.raises(Unavailable, match="nothing was corrected"):
        scored(replace(run, causal=Trajectory.of(reported)), recording)
    held = run.causal.cov.copy()
    held[:, model.layout.biases] = held[:, :, model.layout.biases] = 0.0
    with pytest.raises(Unavailable, match="does not estimate biases"):
        scored(replace(run, causal=replace(run.causal, cov=held)), recording)
    with pytest.raises(Unavailable, match="no covariance of its whole state"):
        scored(replace(run, causal=replace(run.causal, cov=None)), recording)


def test_what_was_added_elsewhere_hides_as_much_that_is_taken_away() -> None:
    """A smoother that linearises anew adds to one variance: what another lost is told where it is more than that."""
    taken = np.array([0.2, 0.05, 0.0, -0.1])
    test = Correction(np.sqrt(np.abs(taken)), np.diag(taken)).test(np.ones(4))
    assert test == (pytest.approx(1.0), 1)
