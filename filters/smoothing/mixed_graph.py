"""A graph of GTSAM's own factors and of Python factors, linearised and evaluated at once where these are twists.

GTSAM passes a Python factor a copy of all values at each call, and calls them one at a time: a thousand twist factors
then take as long as the thirty thousand stereo factors of the same graph. Residuals, noise and derivatives here are
those of the factors one by one (:func:`~toolkit.models.twist.twist_factor`), on arrays.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Self

import gtsam
import numpy as np

from toolkit.geometry import Array, IntArray, se3_adjoint, se3_exp, se3_inverse, se3_log, se3_right_jacobian
from toolkit.models.factors import B, X, linear_factor, poses_of, python_factors
from toolkit.models.graph_state import GraphIncrement
from toolkit.models.twist import TwistIncrement


class MixedGraph:
    """A graph in the form a solver takes; the Python factors of twists, given by their last states, are on arrays."""

    def __init__(
        self, graph: gtsam.NonlinearFactorGraph, increments: Mapping[int, GraphIncrement] | None = None
    ) -> None:
        self.whole, self._native = graph, gtsam.NonlinearFactorGraph(graph)
        twists = {k: one for k, one in (increments or {}).items() if isinstance(one, TwistIncrement)}
        self._twists = TwistFactors.of(twists) if twists else None
        together = set(self._twists.keys) if self._twists is not None else set()
        self._single = list[gtsam.CustomFactor]()
        for place, factor in python_factors(graph).items():
            self._native.remove(place)
            if tuple(factor.keys()) not in together:
                self._single.append(factor)

    def linear(self, values: gtsam.Values) -> gtsam.GaussianFactorGraph:
        linear = self._native.linearize(values)
        if self._twists is not None:
            for factor in self._twists.linear(values):
                linear.add(factor)
        for single in self._single:
            linear.add(single.linearize(values.extract(single.keys())))
        return linear

    def error(self, values: gtsam.Values) -> float:
        """Return half the sum of squares, or the sum of losses."""
        of_twists = 0.0 if self._twists is None else 0.5 * float(np.square(self._twists.residuals(values)).sum())
        one_by_one = sum(factor.error(values.extract(factor.keys())) for factor in self._single)
        return self._native.error(values) + of_twists + one_by_one


@dataclass(frozen=True, eq=False)
class TwistFactors:
    """The steps to N states ``k`` (N,), each integrated about its gyro bias (N, 3) rad/s: T_start_end (N, 4, 4).

    ``d_step_d_bias`` (N, 6, 3) is as in a step; ``whitening`` (N, 6, 6) maps its noise to unit covariance.
    """

    k: IntArray
    T_start_end: Array
    d_step_d_bias: Array
    gyro_bias: Array
    whitening: Array

    @classmethod
    def of(cls, increments: Mapping[int, TwistIncrement]) -> Self:
        steps = [increment.step for increment in increments.values()]
        return cls(
            np.array(list(increments), dtype=np.int64),
            np.array([step.T_start_end for step in steps]),
            np.array([step.d_step_d_bias for step in steps]),
            np.array([increment.gyro_bias for increment in increments.values()]),
            np.linalg.inv(np.linalg.cholesky(np.array([step.cov for step in steps]))),
        )

    @property
    def keys(self) -> list[tuple[int, ...]]:
        """Return the keys of pose and gyro bias at the start and of the pose at the end, in a factor's order."""
        return [(X(k - 1), X(k), B(k - 1)) for k in self.k.tolist()]

    def residuals(self, values: gtsam.Values) -> Array:
        """Return the whitened residuals (N, 6)."""
        return self._whitened(se3_log(self._errors(values)[1]))

    def linear(self, values: gtsam.Values) -> Iterator[gtsam.JacobianFactor]:
        step_now, error_pose = self._errors(values)
        error = se3_log(error_pose)
        by_end = self.whitening @ np.linalg.inv(se3_right_jacobian(error))
        by_step = -by_end @ se3_adjoint(se3_inverse(error_pose))
        by_start, by_bias = by_step @ se3_adjoint(se3_inverse(step_now)), by_step @ self.d_step_d_bias
        rows = zip(self.keys, by_start, by_end, by_bias, -self._whitened(error), strict=True)
        for keys, *jacobians, negative in rows:
            yield linear_factor(list(zip(keys, jacobians, strict=True)), negative)

    def _errors(self, values: gtsam.Values) -> tuple[Array, Array]:
        """Return the steps (N, 4, 4) with the biases of the values, and their errors at the ends."""
        bias = np.array([values.atVector(B(k - 1)) for k in self.k.tolist()])
        correction = (self.d_step_d_bias @ (bias - self.gyro_bias)[..., None])[..., 0]
        step_now = self.T_start_end @ se3_exp(correction)
        start, end = poses_of(values, self.k - 1), poses_of(values, self.k)
        return step_now, se3_inverse(step_now) @ (se3_inverse(start) @ end)

    def _whitened(self, residuals: Array) -> Array:
        return np.asarray((self.whitening @ residuals[..., None])[..., 0])
