"""The Cramér-Rao bound of the recording, and the estimator's excess error over the efficient estimate.

Van Trees, "Detection, estimation and modulation theory", part I (1968), section 2.4; how bound and efficient estimate
are computed is in :mod:`toolkit.metrics.parts.cramer_rao`. The error of an unbiased estimator is the error of the
efficient one on the same measurements plus a part ``d`` that is not correlated with it, so its covariance is the bound
P plus that of d. Most of the error of a single run is due to the noise that both share, above all the error of the
start.

Without an exact truth the bound that the model claims is used, linearised at the run's own final estimate. The ratio of
the error to it is then a test of the model: about 1 where model and estimator are consistent.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from toolkit.geometry import Array, IntArray
from toolkit.metrics.parts.consistency import NO_SUCH_BLOCK, body_errors, state_errors, stated_errors
from toolkit.metrics.parts.cramer_rao import claimed_bound, efficient
from toolkit.metrics.parts.evaluation import Evaluation, lengths, rmse
from toolkit.metrics.parts.scores import Metric, Scores, Unavailable, evaluate
from toolkit.models.gating import mahalanobis_squared
from toolkit.models.motion import motion_model
from toolkit.models.state import POSE, POSITION, ROTATION, Layout

ORDER = 85
GROUP = ON_REQUEST = "bound"
_BLOCKS = {"variance": "whole state", "pose": "pose", "vel": "velocity", "bias": "biases"}


def _metric(key: str, meaning: str, heading: tuple[str, str], unit: str = "1") -> Metric:
    return Metric(key, meaning, unit, heading, best="", over_seeds=True)


METRICS = (
    Metric(
        "efficiency_percent",
        "bound_position_m over the RMS position error to be expected of the estimator (percent)",
        "%",
        ("effi-", "ciency"),
        name="efficiency",
        best="most",
        over_seeds=True,
    ),
    _metric("bound_position_m", "least RMS position error of any unbiased estimator (m)", ("bound", "pos"), "m"),
    _metric("bound_rotation_deg", "the same of the rotation (deg)", ("bound", "rot"), "deg"),
    _metric("error_over_bound", "RMS position error over bound_position_m", ("error", "/bound")),
    *(
        _metric(
            f"excess_{key}",
            f"variance of the {what} beyond the bound, over the bound: mean of d^T P^-1 d over its degrees of freedom",
            ("excess", key[:8]),
        )
        for key, what in _BLOCKS.items()
    ),
    *(
        _metric(
            f"claimed_{key}",
            f"stated variance of the {what} over the bound: mean trace of P^-1 times it over its degrees of freedom",
            ("stated", key[:8]),
        )
        for key, what in _BLOCKS.items()
    ),
)


@dataclass(frozen=True, eq=False)
class AgainstBound:
    """An output and its bound at stamps (n,): its errors beyond the efficient estimate (n, d), and two covariances.

    ``bound`` and ``stated`` (n, d, d) are the Cramér-Rao bound and the stated covariance, in the layout's order.
    """

    t_ns: IntArray
    layout: Layout
    excess: Array
    bound: Array
    stated: Array


def against_bound(evaluation: Evaluation) -> AgainstBound:
    """Return an output with its bound: that of the data up to each frame, or of the whole recording.

    Raises Unavailable where the recording has no bound, or the output no stated covariance of the whole state.
    """
    best, stated = efficient(evaluation.sequence, evaluation.output), stated_errors(evaluation)
    frames = np.searchsorted(evaluation.sequence.frames_t_ns, stated.errors.t_ns)
    excess = state_errors(evaluation, stated) - best.errors[frames]
    return AgainstBound(stated.errors.t_ns, best.layout, excess, best.covs[frames], stated.cov)


def score(evaluation: Evaluation) -> Scores:
    """Score an output against the bound, or against the one the model claims where there is no exact truth."""
    try:
        found, why = against_bound(evaluation), ""
    except Unavailable as reason:
        found, why = _against_claimed_bound(evaluation), str(reason)
    position_m, layout = _rms(found.bound, POSITION), found.layout
    blocks = dict(zip(_BLOCKS, (slice(0, layout.size), POSE, layout.velocity, layout.biases), strict=True))

    def of_excess(compute: Callable[[], float]) -> float:
        if why:
            raise Unavailable(why)
        return compute()

    scores = evaluate(
        {
            "efficiency_percent": lambda: of_excess(
                lambda: 100.0 * position_m / np.hypot(position_m, rmse(lengths(found.excess[:, POSITION])))
            ),
            "bound_position_m": lambda: position_m,
            "bound_rotation_deg": lambda: float(np.degrees(_rms(found.bound, ROTATION))),
            # The RMS distance from the true positions is that of the NEES: aligned by the first pose if need be.
            "error_over_bound": lambda: rmse(body_errors(evaluation).distance_m) / position_m,
            **{f"excess_{key}": partial(of_excess, partial(_excess, found, block)) for key, block in blocks.items()},
            **{f"claimed_{key}": partial(_claimed, found, block) for key, block in blocks.items()},
        }
    )
    return scores.remarked(scores.values, f"linearised at its own answer: {why}" if why else "")


def _against_claimed_bound(evaluation: Evaluation) -> AgainstBound:
    """Return an output with the bound at the run's own final estimate, which leaves no errors beyond the efficient one.

    Raises Unavailable where the output states no covariance of the whole state at every frame.
    """
    run, sequence, estimate = evaluation.run, evaluation.sequence, evaluation.estimate
    bound = claimed_bound(sequence, run.final or run.causal or estimate, evaluation.output)
    if estimate.cov is None or estimate.cov.shape[1:] != bound.shape[1:]:
        raise Unavailable("the estimator states no covariance of the whole state")
    if not np.array_equal(estimate.t_ns, sequence.frames_t_ns):
        raise Unavailable("the estimate lacks the state of a frame")
    layout = motion_model(sequence.noise, sequence.gravity_world).layout
    return AgainstBound(estimate.t_ns, layout, np.empty((0, layout.size)), bound, estimate.cov)


def _rms(bound: Array, block: slice) -> float:
    return float(np.sqrt(np.mean(np.trace(bound[:, block, block], axis1=1, axis2=2))))


def _excess(found: AgainstBound, block: slice | None) -> float:
    if block is None:
        raise Unavailable(NO_SUCH_BLOCK)
    squared = mahalanobis_squared(found.excess[:, block], found.bound[:, block, block])
    return float(np.mean(squared)) / float(block.stop - block.start)


def _claimed(found: AgainstBound, block: slice | None) -> float:
    if block is None:
        raise Unavailable(NO_SUCH_BLOCK)
    ratio = np.linalg.solve(found.bound[:, block, block], found.stated[:, block, block])
    return float(np.mean(np.trace(ratio, axis1=1, axis2=2))) / float(block.stop - block.start)
