"""Python factors of one form, evaluated and linearised all at once, for a solver that has many of them.

GTSAM calls each Python factor separately: a thousand twist factors then take as long as the thirty thousand stereo
factors of the same graph. Residuals, noise and derivatives here are those of the factors one by one
(:func:`~toolkit.models.twist.twist_factor`), on arrays.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import gtsam
import numpy as np

from toolkit.geometry import Array, IntArray, se3_adjoint, se3_exp, se3_inverse, se3_log, se3_right_jacobian
from toolkit.models.factors import B, X, linear_factor
from toolkit.models.state import Increment
from toolkit.models.twist import TwistIncrement

Keys = tuple[int, ...]


class LinearisedStack(NamedTuple):
    """Whitened residuals (N, 6) and their Jacobians (N, 6, d) to each variable of a factor, in its order."""

    residuals: Array
    derivatives: tuple[Array, ...]


class StackedFactors(Protocol):
    """N factors of one form."""

    @property
    def keys(self) -> Sequence[Keys]:
        """Return the keys of each factor, by which it is found in a graph of single factors."""

    def residuals(self, values: gtsam.Values) -> Array:
        """Return the whitened residuals (N, 6)."""

    def linearised(self, values: gtsam.Values) -> LinearisedStack:
        """Return residuals and derivatives about some values."""


def linear_factors(stack: StackedFactors, values: gtsam.Values) -> Iterator[gtsam.JacobianFactor]:
    """Yield the factors, linearised at some values."""
    residuals, derivatives = stack.linearised(values)
    for row, keys in enumerate(stack.keys):
        yield linear_factor([(key, of[row]) for key, of in zip(keys, derivatives, strict=True)], -residuals[row])


def stacked(increments: Mapping[int, Increment]) -> list[StackedFactors]:
    """Return the stack of the steps whose factors are in Python, given by the index of their last state; or none."""
    steps = {k: increment for k, increment in increments.items() if isinstance(increment, TwistIncrement)}
    return [StackedSteps.of(steps)] if steps else []


@dataclass(frozen=True, eq=False)
class StackedSteps:
    """The steps to N states ``k`` (N,), each integrated about its gyro bias (N, 3) rad/s: T_start_end (N, 4, 4).

    ``d_step_d_bias`` (N, 6, 3) is as in a step; ``whitening`` (N, 6, 6) maps its noise to unit covariance.
    """

    k: IntArray
    T_start_end: Array
    d_step_d_bias: Array
    gyro_bias: Array
    whitening: Array

    @classmethod
    def of(cls, increments: Mapping[int, TwistIncrement]) -> "StackedSteps":
        """Return the steps to states by their indices."""
        steps = [increment.step for increment in increments.values()]
        return cls(
            np.array(list(increments), dtype=np.int64),
            np.array([step.T_start_end for step in steps]),
            np.array([step.d_step_d_bias for step in steps]),
            np.array([increment.gyro_bias for increment in increments.values()]),
            np.linalg.inv(np.linalg.cholesky(np.array([step.cov for step in steps]))),
        )

    @property
    def keys(self) -> Sequence[Keys]:
        """Return the keys of pose and gyro bias at the start and of the pose at the end, in a factor's order."""
        return [(X(k - 1), X(k), B(k - 1)) for k in self.k.tolist()]

    def residuals(self, values: gtsam.Values) -> Array:
        """Return the whitened residuals (N, 6)."""
        return _whitened(self.whitening, se3_log(self._errors(values)[1]))

    def linearised(self, values: gtsam.Values) -> LinearisedStack:
        """Return residuals and derivatives about some values."""
        step_now, error_pose = self._errors(values)
        error = se3_log(error_pose)
        by_end = self.whitening @ np.linalg.inv(se3_right_jacobian(error))
        by_step = -by_end @ se3_adjoint(se3_inverse(error_pose))
        by_start = by_step @ se3_adjoint(se3_inverse(step_now))
        return LinearisedStack(_whitened(self.whitening, error), (by_start, by_end, by_step @ self.d_step_d_bias))

    def _errors(self, values: gtsam.Values) -> tuple[Array, Array]:
        """Return the steps (N, 4, 4) with the biases of the values, and their errors at the ends."""
        bias = np.array([values.atVector(B(k - 1)) for k in self.k.tolist()])
        correction = (self.d_step_d_bias @ (bias - self.gyro_bias)[..., None])[..., 0]
        step_now = self.T_start_end @ se3_exp(correction)
        moved = se3_inverse(_poses(values, self.k - 1)) @ _poses(values, self.k)
        return step_now, se3_inverse(step_now) @ moved


def _whitened(whitening: Array, residuals: Array) -> Array:
    return np.asarray((whitening @ residuals[..., None])[..., 0])


def _poses(values: gtsam.Values, frames: IntArray) -> Array:
    return np.array([values.atPose3(X(k)).matrix() for k in frames.tolist()])
