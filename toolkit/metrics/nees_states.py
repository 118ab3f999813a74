"""Normalised estimation error squared of what moves the pose: velocity and biases.

Bar-Shalom, Li and Kirubarajan, "Estimation with applications to tracking and navigation" (2001), section 5.4. A filter
may state its pose honestly and its biases not; the error then shows in the pose much later.
"""

from collections.abc import Callable

import numpy as np

from toolkit.geometry import Array
from toolkit.metrics._shared.consistency import StatedErrors, normalised, stated_errors
from toolkit.metrics._shared.evaluation import Evaluation
from toolkit.metrics._shared.scores import Metric, Scores, Unavailable, evaluate
from toolkit.models.imu import IMU_LAYOUT
from toolkit.models.twist import TWIST_LAYOUT

ORDER = 76
METRICS = tuple(
    Metric(
        f"nees_{key}_mean",
        f"mean normalised error squared of the {block} over its 3 degrees of freedom; 1 is consistent",
        "1",
        ("NEES", heading),
        best="one",
        over_seeds=False,
    )
    for key, block, heading in (
        ("vel", "velocity", "vel"),
        ("gyro_bias", "gyro bias", "gyro b"),
        ("accel_bias", "accelerometer bias", "acc b"),
    )
)
_LAYOUTS = {layout.size: layout for layout in (IMU_LAYOUT, TWIST_LAYOUT)}


def score(evaluation: Evaluation) -> Scores:
    """Score the stated covariances of velocity and biases against the truth."""
    stated = stated_errors(evaluation)
    layout = _LAYOUTS.get(stated.cov.shape[-1])
    if layout is None:
        raise Unavailable("the covariance is that of the pose alone")

    def mean(block: slice | None, errors: Callable[[], Array]) -> float:
        if block is None:
            raise Unavailable("it is no part of the state where the motion is a measured twist")
        return float(normalised(errors(), stated.cov[:, block, block]).mean()) / 3.0

    return evaluate(
        {
            "nees_vel_mean": lambda: mean(layout.velocity, lambda: _velocity_errors(evaluation, stated)),
            "nees_gyro_bias_mean": lambda: mean(layout.gyro_bias, lambda: _bias_errors(evaluation, stated)[:, 3:]),
            "nees_accel_bias_mean": lambda: mean(layout.accel_bias, lambda: _bias_errors(evaluation, stated)[:, :3]),
        }
    )


def _velocity_errors(evaluation: Evaluation, stated: StatedErrors) -> Array:
    """Return the errors (n, 3) m/s of the velocity in the body frame, where the stated covariance has them."""
    estimated, true = evaluation.estimate.v_world, _true(evaluation, "v_world", stated)
    if estimated is None:
        raise Unavailable("the estimator gives no velocity")
    errors = stated.errors
    own_poses = evaluation.estimate.T_world_imu[errors.rows]
    return _turned(errors.T_world_imu, true) - _turned(own_poses, estimated[errors.rows])


def _turned(T_world_imu: Array, vectors_world: Array) -> Array:
    """Return vectors (n, 3) of the world in the body frames of poses (n, 4, 4)."""
    return np.asarray((vectors_world[:, None] @ T_world_imu[:, :3, :3])[:, 0])


def _bias_errors(evaluation: Evaluation, stated: StatedErrors) -> Array:
    """Return the errors (n, 6) of the biases [accel, gyro]."""
    estimated, true = evaluation.estimate.bias, _true(evaluation, "bias", stated)
    if estimated is None:
        raise Unavailable("the estimator gives no bias")
    return np.asarray(true - estimated[stated.errors.rows])


def _true(evaluation: Evaluation, name: str, stated: StatedErrors) -> Array:
    """Return the true velocity (n, 3) or biases (n, 6) at the estimates' stamps, interpolated linearly between its own.

    Both change little within a frame: a stamp between two of the truth's is a matter of rounding.
    """
    truth = evaluation.sequence.truth
    values = None if truth is None else getattr(truth, name)
    if truth is None or values is None:
        raise Unavailable(f"the ground truth has no {'velocity' if name == 'v_world' else 'biases'}")
    seconds, at_s = (1e-9 * (t_ns - truth.t_ns[0]) for t_ns in (truth.t_ns, stated.errors.t_ns))
    return np.column_stack([np.interp(at_s, seconds, column) for column in values.T])
