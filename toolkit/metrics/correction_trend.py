"""Do the corrections of a causal answer lean one way for longer than chance has it?

Row errors, a turned camera, an odometer that slips or stamps that are late do the same to all tracks of a frame: each
track has so little of it that it passes its gate, and the innovations stay near their covariance while they turn the
state one way, frame after frame. The corrections of a consistent estimator are independent from frame to frame, and
their sum over a stretch of time has the covariance that they took away (:mod:`toolkit.models.corrections`): its squared
length is chi-square distributed. Corrections are the answers less what the measured motion predicts from the answers
before, with the noise that the estimator took it for; where that is what is stated, nothing else has to be reported.
"""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from scipy.special import chdtri

from toolkit.estimate import Trajectory
from toolkit.geometry import Array
from toolkit.metrics.parts.evaluation import Evaluation
from toolkit.metrics.parts.scores import Metric, Scores, Unavailable
from toolkit.models.corrections import Correction, CorrectionTest
from toolkit.models.motion import PredictedStep, predicted_steps
from toolkit.models.state import Belief

ORDER = 73
CAUSAL_ONLY = "corrections from frame to frame belong to the causal output"
TREND, LIMIT = "correction_trend", "correction_trend_limit"
# What all tracks of some frames share adds up within it; longer ones lose what biases absorb.
_STRETCH_S = 1.0
NOTHING_CORRECTED = f"nothing was corrected over {_STRETCH_S:g} s"
# A consistent estimator is beyond half of the limit less than once in a million runs. The other half is for filters
# that linearise at estimates they have since corrected, and so count some information twice: chosen with 36 sound
# simulated runs of each of three filters in view, one of which it leaves beyond the limit (docs/metrics.md).
_BY_CHANCE, _BY_LINEARISATION = 1e-6, 2.0
METRICS = (
    Metric(
        TREND,
        "mean squared sum of the corrections over 1 s, by the covariance that they took away; 1 is consistent",
        "1",
        ("correction", "trend"),
        best="one",
    ),
    Metric(
        LIMIT,
        "what the correction trend of a run stays below by chance, where nothing turns its state one way",
        "1",
        ("trend", "limit"),
        name="correction trend, limit",
        best="",
    ),
)


def score(evaluation: Evaluation) -> Scores:
    """Score the corrections of a causal output.

    Raises Unavailable where there are none: no covariance of the whole state, or no second in which any is corrected.
    """
    tests = [test for test in _tests(evaluation) if test.dof]
    if not tests:
        raise Unavailable(NOTHING_CORRECTED)
    nis, dof = np.sum(tests, axis=0)
    return Scores({TREND: float(nis / dof), LIMIT: _BY_LINEARISATION * float(chdtri(dof, _BY_CHANCE) / dof)})


def _tests(evaluation: Evaluation) -> Iterator[CorrectionTest]:
    """Yield the test of the summed corrections of each whole stretch."""
    steps = list(predicted_steps(evaluation.estimate, evaluation.sequence, _noise_scale(evaluation)))
    cov = _stated_cov(evaluation.estimate, steps)
    total, since_s, sigma2 = None, 0.0, np.zeros(cov.shape[-1])
    for step in steps:
        before = replace(step.belief, cov=cov[step.start]).predicted(step.prediction)
        correction = Correction.of(before, _answer(before, evaluation.estimate, cov, step.end))
        total = correction if total is None else total + correction
        sigma2, since_s = sigma2 + np.maximum(np.diag(correction.taken), 0.0), since_s + step.dt_s
        if since_s > _STRETCH_S - 1e-6:
            yield total.test(np.sqrt(sigma2))
            total, since_s, sigma2 = None, 0.0, np.zeros(cov.shape[-1])


def _noise_scale(evaluation: Evaluation) -> Array | None:
    """Return how many times its stated variance the run took the noise of the motion up to each row (N,) for."""
    scale = evaluation.run.info.get("motion_noise_scale")
    return None if scale is None else np.nan_to_num(scale, nan=1.0)


def _stated_cov(trajectory: Trajectory, steps: list[PredictedStep]) -> Array:
    """Return the covariances (N, d, d) of the whole state; raise Unavailable where they are not stated."""
    if not steps:
        raise Unavailable("there is no measured motion between two frames with a pose")
    layout, cov = steps[0].belief.layout, trajectory.cov
    if cov is None or cov.shape[-1] != layout.size or not np.isfinite(cov).all():
        raise Unavailable("the estimator states no covariance of its whole state")
    walked = np.mean([np.diag(step.prediction.noise) for step in steps], axis=0)[layout.biases]
    if (np.median(np.diagonal(cov, axis1=1, axis2=2)[:, layout.biases], axis=0) < walked).any():
        raise Unavailable("the estimator holds its biases, and what they do to its state does lean one way")
    return cov


def _answer(before: Belief, trajectory: Trajectory, cov: Array, row: int) -> Belief:
    """Return a state of the trajectory as a belief; what it lacks is as predicted."""
    v_world = before.v_world if trajectory.v_world is None else trajectory.v_world[row]
    bias = before.bias if trajectory.bias is None else trajectory.bias[row]
    return Belief(before.layout, trajectory.T_world_imu[row], v_world, bias, cov[row])
