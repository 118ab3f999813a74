"""Normalised estimation error squared: compares the errors of pose, velocity and biases with the stated covariance.

Bar-Shalom, Li and Kirubarajan, "Estimation with applications to tracking and navigation" (2001), section 5.4. A filter
may be consistent in its pose and not in its biases; the error shows in the pose much later.
"""

from collections.abc import Callable
from typing import Any

import numpy as np

from toolkit.geometry import Array
from toolkit.metrics.parts.consistency import (
    NO_SUCH_BLOCK,
    PLACED,
    POSE_DOF,
    UNCOUPLED,
    StatedErrors,
    bias_errors,
    layout_of,
    nees_band,
    nees_of,
    stated_errors,
    velocity_errors,
)
from toolkit.metrics.parts.evaluation import Evaluation
from toolkit.metrics.parts.scores import Metric, Scores, Unavailable, evaluate
from toolkit.models.gating import mahalanobis_squared

ORDER = 75


def _mean(key: str, meaning: str, heading: str, **shown: Any) -> Metric:
    return Metric(f"nees_{key}_mean", meaning, "1", ("NEES", heading), best="one", **shown)


_ALONE = "the same of the {} alone, over its 3 degrees of freedom"
_OF_BLOCK = "mean normalised error squared of the {} over its {} degrees of freedom; 1 is consistent"
_OF_POSE = (
    _mean("pose", _OF_BLOCK.format("pose", 6), "pose", table="always", over_seeds=True),
    _mean("ori", _ALONE.format("orientation"), "rot", over_seeds=True),
    _mean("pos", _ALONE.format("position"), "pos", over_seeds=True),
    Metric(
        "nees_pose_in_band_percent",
        "poses whose NEES is within the two-sided 95 % chi-square band of one run (percent)",
        "%",
        ("NEES", "in band"),
        best="most",
    ),
)
_OF_STATE = (
    _mean("vel", _OF_BLOCK.format("velocity", 3), "vel"),
    _mean("gyro_bias", _OF_BLOCK.format("gyro bias", 3), "gyro b"),
    _mean("accel_bias", _OF_BLOCK.format("accelerometer bias", 3), "acc b"),
)
METRICS = (*_OF_POSE, *_OF_STATE)
OF_POSE = tuple(metric.key for metric in _OF_POSE)


def score(evaluation: Evaluation) -> Scores:
    return Scores.attempt(_OF_POSE, lambda: of_stated(stated_errors(evaluation))) | Scores.attempt(
        _OF_STATE, lambda: _of_state(evaluation)
    )


def of_stated(stated: StatedErrors) -> Scores:
    """Score the covariances of some errors; of the pose there is no value where its blocks are stated apart."""
    nees = nees_of(stated)
    low, high = nees_band(POSE_DOF)
    scores = Scores(
        {
            "nees_pose_mean": float(nees.pose.mean()),
            "nees_ori_mean": float(nees.orientation.mean()),
            "nees_pos_mean": float(nees.position.mean()),
            "nees_pose_in_band_percent": 100.0 * float(np.mean((nees.pose >= low) & (nees.pose <= high))),
        }
    )
    if not nees.is_coupled:
        scores = scores.without(("nees_pose_mean", "nees_pose_in_band_percent"), UNCOUPLED)
    return scores.remarked(scores.values, PLACED if nees.placed else "")


def _of_state(evaluation: Evaluation) -> Scores:
    stated = stated_errors(evaluation)
    layout = layout_of(stated)

    def mean(block: slice | None, errors: Callable[[], Array]) -> float:
        if block is None:
            raise Unavailable(NO_SUCH_BLOCK)
        return float(mahalanobis_squared(errors(), stated.cov[:, block, block]).mean()) / 3.0

    return evaluate(
        {
            "nees_vel_mean": lambda: mean(layout.velocity, lambda: velocity_errors(evaluation, stated)),
            "nees_gyro_bias_mean": lambda: mean(layout.gyro_bias, lambda: bias_errors(evaluation, stated)[:, 3:]),
            "nees_accel_bias_mean": lambda: mean(layout.accel_bias, lambda: bias_errors(evaluation, stated)[:, :3]),
        }
    )
