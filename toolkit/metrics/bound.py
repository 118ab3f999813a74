"""The Cramér-Rao bound of the recording, and the estimator's excess error over the efficient estimate.

Van Trees, "Detection, estimation and modulation theory", part I (1968), section 2.4; how bound and efficient estimate
are computed is in :mod:`toolkit.metrics.parts.cramer_rao`. The error of an unbiased estimator is the error of the
efficient one on the same measurements plus a part ``d`` that is not correlated with it, so its covariance is the bound
P plus that of d. Most of the error of a single run is due to the noise that both share, above all the error of the
start.

Without an exact truth the bound that the model claims is used, linearised at the run's own final estimate. The ratio of
the error to it is then a test of the model: about 1 where model and estimator are consistent.
"""

from dataclasses import dataclass

import numpy as np

from toolkit.geometry import Array, IntArray
from toolkit.metrics.parts.consistency import body_errors, stated_errors
from toolkit.metrics.parts.cramer_rao import claimed_bound, efficient
from toolkit.metrics.parts.evaluation import Evaluation
from toolkit.metrics.parts.scores import Metric, Scores, Unavailable
from toolkit.metrics.parts.state_errors import NO_SUCH_BLOCK, state_errors
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
        found = against_bound(evaluation)
    except Unavailable as why:
        return _against_claimed_bound(evaluation, str(why))
    position_m = _rms(found.bound, POSITION)
    lost_m = float(np.sqrt(np.square(found.excess[:, POSITION]).sum(axis=1).mean()))
    values: dict[str, float | None] = {"efficiency_percent": 100.0 * position_m / float(np.hypot(position_m, lost_m))}
    values |= _sizes(found.bound) | {"error_over_bound": _rms_error_m(evaluation) / position_m}
    blocks = _blocks(found.layout)
    per_block: dict[str, float | None] = {
        f"excess_{key}": None if block is None else _excess(found.excess, found.bound, block)
        for key, block in blocks.items()
    } | _claims(found.stated, found.bound, blocks)
    return _in_order(values | per_block, {key: NO_SUCH_BLOCK for key, value in per_block.items() if value is None})


def _in_order(values: dict[str, float | None], notes: dict[str, str]) -> Scores:
    return Scores({metric.key: values[metric.key] for metric in METRICS}, notes)


def _against_claimed_bound(evaluation: Evaluation, why: str) -> Scores:
    """Score against the bound at the run's own final estimate; ``why`` is the reason for the lack of an exact one."""
    run, sequence, estimate = evaluation.run, evaluation.sequence, evaluation.estimate
    bound = claimed_bound(sequence, run.final or run.causal or estimate, evaluation.output)
    lost = ["efficiency_percent", *(f"excess_{key}" for key in _BLOCKS)]
    values: dict[str, float | None] = dict.fromkeys(lost) | _sizes(bound)
    notes = dict.fromkeys(lost, why)
    try:
        values["error_over_bound"] = _rms_error_m(evaluation) / _rms(bound, POSITION)
    except Unavailable as reason:
        values["error_over_bound"], notes["error_over_bound"] = None, str(reason)
    blocks = _blocks(motion_model(sequence.noise, sequence.gravity_world).layout)
    values |= _claims(_stated(evaluation, bound.shape), bound, blocks)
    notes |= {f"claimed_{key}": NO_SUCH_BLOCK for key, block in blocks.items() if block is None}
    return _in_order(values, notes).remarked(values.keys() - notes.keys(), f"linearised at its own answer: {why}")


def _stated(evaluation: Evaluation, shape: tuple[int, ...]) -> Array:
    """Return the covariances (K, d, d) that an output states at the frames. Raises Unavailable where it has none."""
    estimate, frames_t_ns = evaluation.estimate, evaluation.sequence.frames_t_ns
    if estimate.cov is None or estimate.cov.shape[1:] != shape[1:]:
        raise Unavailable("the estimator states no covariance of the whole state")
    if not np.array_equal(estimate.t_ns, frames_t_ns):
        raise Unavailable("the estimate lacks the state of a frame")
    return estimate.cov


def _rms_error_m(evaluation: Evaluation) -> float:
    """Return the RMS distance from the true positions as in the NEES: aligned by the first pose if need be."""
    return float(np.sqrt(np.square(body_errors(evaluation).distance_m).mean()))


def _sizes(bound: Array) -> dict[str, float | None]:
    return {"bound_position_m": _rms(bound, POSITION), "bound_rotation_deg": float(np.degrees(_rms(bound, ROTATION)))}


def _claims(stated: Array, bound: Array, blocks: dict[str, slice | None]) -> dict[str, float | None]:
    return {f"claimed_{key}": None if one is None else _claimed(stated, bound, one) for key, one in blocks.items()}


def _blocks(layout: Layout) -> dict[str, slice | None]:
    return dict(zip(_BLOCKS, (slice(0, layout.size), POSE, layout.velocity, layout.biases), strict=True))


def _rms(bound: Array, block: slice) -> float:
    return float(np.sqrt(np.mean(np.trace(bound[:, block, block], axis1=1, axis2=2))))


def _excess(excess: Array, bound: Array, block: slice) -> float:
    squared = mahalanobis_squared(excess[:, block], bound[:, block, block])
    return float(np.mean(squared)) / float(block.stop - block.start)


def _claimed(stated: Array, bound: Array, block: slice) -> float:
    ratio = np.linalg.solve(bound[:, block, block], stated[:, block, block])
    return float(np.mean(np.trace(ratio, axis1=1, axis2=2))) / float(block.stop - block.start)
