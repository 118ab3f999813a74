"""The error of the whole stated state: pose, velocity and biases in the order of an Estimate's covariance.

Every error is the motion, or the difference, from the estimate to the truth, in the body frame.
"""

import numpy as np

from toolkit.geometry import Array, se3_log
from toolkit.metrics.parts.consistency import StatedErrors
from toolkit.metrics.parts.evaluation import Evaluation
from toolkit.metrics.parts.scores import Unavailable
from toolkit.models.state import IMU_LAYOUT, POSE, TWIST_LAYOUT, Layout

NO_SUCH_BLOCK = "it is no part of the state where the motion is a measured twist"
_LAYOUTS = {layout.size: layout for layout in (IMU_LAYOUT, TWIST_LAYOUT)}


def layout_of(stated: StatedErrors) -> Layout:
    """Return the layout of the stated covariance; raise Unavailable if it is that of the pose alone."""
    layout = _LAYOUTS.get(stated.cov.shape[-1])
    if layout is None:
        raise Unavailable("the covariance is that of the pose alone")
    return layout


def state_errors(evaluation: Evaluation, stated: StatedErrors) -> Array:
    """Return the errors (n, d) of the whole state. Raises Unavailable if a block or its truth is missing."""
    layout = layout_of(stated)
    errors = np.zeros((len(stated.cov), layout.size))
    errors[:, POSE] = se3_log(stated.errors.T_estimate_truth)
    biases = bias_errors(evaluation, stated)
    errors[:, layout.gyro_bias] = biases[:, 3:]
    if layout.accel_bias is not None:
        errors[:, layout.accel_bias] = biases[:, :3]
    if layout.velocity is not None:
        errors[:, layout.velocity] = velocity_errors(evaluation, stated)
    return errors


def velocity_errors(evaluation: Evaluation, stated: StatedErrors) -> Array:
    """Return the errors (n, 3) m/s of the velocity. Raises Unavailable where there is none, or no true one."""
    estimated, true = evaluation.estimate.v_world, _true(evaluation, "v_world", stated)
    if estimated is None:
        raise Unavailable("the estimator gives no velocity")
    errors = stated.errors
    own_poses = evaluation.estimate.T_world_imu[errors.rows]
    return _turned(errors.T_world_imu, true) - _turned(own_poses, estimated[errors.rows])


def bias_errors(evaluation: Evaluation, stated: StatedErrors) -> Array:
    """Return the errors (n, 6) of the biases [accel, gyro]. Raises Unavailable where there is none, or no true one."""
    estimated, true = evaluation.estimate.bias, _true(evaluation, "bias", stated)
    if estimated is None:
        raise Unavailable("the estimator gives no bias")
    return np.asarray(true - estimated[stated.errors.rows])


def _turned(T_world_imu: Array, vectors_world: Array) -> Array:
    """Return vectors (n, 3) of the world in the body frames of poses (n, 4, 4)."""
    return np.asarray((vectors_world[:, None] @ T_world_imu[:, :3, :3])[:, 0])


def _true(evaluation: Evaluation, name: str, stated: StatedErrors) -> Array:
    """Return the true velocity (n, 3) or biases (n, 6) at the estimates' stamps, interpolated linearly between its own.

    Both change little within a frame, and stamps lie between two of the truth's only by rounding.
    """
    truth = evaluation.sequence.truth
    values = None if truth is None else getattr(truth, name)
    if truth is None or values is None:
        raise Unavailable(f"the ground truth has no {'velocity' if name == 'v_world' else 'biases'}")
    seconds, at_s = (1e-9 * (t_ns - truth.t_ns[0]) for t_ns in (truth.t_ns, stated.errors.t_ns))
    return np.column_stack([np.interp(at_s, seconds, column) for column in values.T])
