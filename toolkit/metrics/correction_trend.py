"""Tests whether the corrections of a causal output have a trend: whether they push the state one way beyond chance.

Row errors, a rotated camera, wheel slip or late stamps affect all tracks of a frame alike. Each track is affected so
little that it passes its gate, and the innovations stay near their covariance while they push the state one way, frame
after frame. The corrections of a consistent estimator are independent from frame to frame, and the covariance of their
sum over a stretch of time is the sum of their reductions of the state's covariance (:mod:`toolkit.models.corrections`):
its squared Mahalanobis length is chi-square distributed. A correction is an estimate less the prediction by the
measured motion from the estimate before, with the noise of the motion that all estimators assume.
"""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from scipy.special import chdtri

from toolkit.estimate import Trajectory
from toolkit.geometry import Array, IntArray
from toolkit.metrics.parts.evaluation import Evaluation
from toolkit.metrics.parts.scores import Metric, Scores, Unavailable
from toolkit.models.corrections import Correction, PredictedSteps, predicted_steps
from toolkit.models.state import Belief

ORDER = 73
CAUSAL_ONLY = "corrections from frame to frame belong to the causal output"
TREND, LIMIT = "correction_trend", "correction_trend_limit"
# Length of a stretch (s): errors shared by all tracks add up within it; in longer stretches biases absorb them.
_STRETCH_S = 1.0
# A variance that is reduced by no more than this share of it is as it was predicted.
_ROUNDING = 1e-12
NOTHING_CORRECTED = f"nothing was corrected over {_STRETCH_S:g} s"
# A consistent estimator exceeds half of the limit less than once in a million runs. The other half allows for filters
# that linearise at estimates which they correct later, and so count some information twice (docs/metrics.md).
_BY_CHANCE, _BY_LINEARISATION = 1e-6, 2.0
METRICS = (
    Metric(
        TREND,
        "mean squared sum of the corrections over 1 s, over the covariance that they removed; 1 is consistent",
        "1",
        ("correction", "trend"),
        best="one",
    ),
    Metric(
        LIMIT,
        "limit of the correction trend by chance, without errors that correct the state in one direction",
        "1",
        ("trend", "limit"),
        name="correction trend, limit",
        best="",
    ),
)


def score(evaluation: Evaluation) -> Scores:
    """Score the corrections of a causal output; raise Unavailable where there are none to test."""
    tests = [(nis, dof) for nis, dof in _tests(evaluation) if dof]
    if not tests:
        raise Unavailable(NOTHING_CORRECTED)
    nis, dof = np.sum(tests, axis=0)
    return Scores({TREND: float(nis / dof), LIMIT: _BY_LINEARISATION * float(chdtri(dof, _BY_CHANCE) / dof)})


def _tests(evaluation: Evaluation) -> Iterator[tuple[float, int]]:
    """Yield the test of the summed corrections of each whole stretch."""
    steps = predicted_steps(evaluation.estimate, evaluation.sequence)
    if steps is None:
        raise Unavailable("there is no measured motion between two frames with a pose")
    cov = _stated_cov(evaluation.estimate, steps)
    before = replace(steps.beliefs, cov=cov[steps.start]).predicted(steps.predictions)
    corrections = Correction.of(before, _answers(before, evaluation.estimate, cov, steps.end))
    taken, variance = (np.diagonal(each, axis1=1, axis2=2) for each in (corrections.taken, before.cov))
    sigma2 = np.where(taken > _ROUNDING * variance, taken, 0.0)
    for rows in _stretches(steps.dt_s):
        total = Correction(corrections.moved[rows].sum(axis=0), corrections.taken[rows].sum(axis=0))
        yield total.test(np.sqrt(sigma2[rows].sum(axis=0)))


def _stretches(dt_s: Array) -> Iterator[slice]:
    """Yield the steps of each whole stretch, given their lengths (S,)."""
    first, since_s = 0, 0.0
    for k, each_s in enumerate(dt_s.tolist()):
        since_s += each_s
        if since_s > _STRETCH_S - 1e-6:
            yield slice(first, k + 1)
            first, since_s = k + 1, 0.0


def _stated_cov(trajectory: Trajectory, steps: PredictedSteps) -> Array:
    """Return the covariances (N, d, d) of the whole state; raise Unavailable where they are not stated."""
    layout, cov = steps.beliefs.layout, trajectory.cov
    if cov is None or cov.shape[-1] != layout.size or not np.isfinite(cov).all():
        raise Unavailable("the estimator states no covariance of its whole state")
    walked = np.diagonal(steps.predictions.noise, axis1=1, axis2=2).mean(axis=0)[layout.biases]
    if (np.median(np.diagonal(cov, axis1=1, axis2=2)[:, layout.biases], axis=0) < walked).any():
        raise Unavailable("the estimator does not estimate biases, and their effect on its state has one direction")
    return cov


def _answers(before: Belief, trajectory: Trajectory, cov: Array, rows: IntArray) -> Belief:
    """Return states of the trajectory as stacked beliefs; parts that it lacks are taken from the prediction."""
    v_world = before.v_world if trajectory.v_world is None else trajectory.v_world[rows]
    bias = before.bias if trajectory.bias is None else trajectory.bias[rows]
    return Belief(before.layout, trajectory.T_world_imu[rows], v_world, bias, cov[rows])
