"""Levenberg-Marquardt, one iteration at a time, with the ways a solve can go wrong checked.

The damping is Levenberg's multiple of the identity, as in GTSAM's optimizer: it is divided by ten after a step that
lowered the error, and multiplied by ten after one that did not. GTSAM's optimizer itself would not do: it returns
unchanged values without a message when an error is not a number, it is slow with Python factors, and it moves landmarks
in metres only.

GTSAM passes a Python factor a copy of all values at each call, and calls them one at a time: a thousand twist factors
then take as long as the thirty thousand stereo factors of the same graph. In a :class:`MixedGraph` residuals, noise and
derivatives are those of the factors one by one (:func:`~toolkit.models.twist.twist_factor`), on arrays.

A step of GTSAM's turns a pose about itself and moves a landmark along a straight line, and the two separate where the
step is long: by 6 cm where a stretch of road turns by 0.01 rad and shifts by 12 m, pixels for a near landmark. A weakly
determined direction, such as the drift of a long drive, is then damped as if it overshot. The measurement also depends
on a far landmark's depth so nonlinearly that a step in metres overshoots, while the disparity is nearly linear
(Civera, Davison & Montiel 2008, "Inverse depth parametrization for monocular SLAM"). From the first step on that raises
the error, landmarks are therefore moved in the image of the camera that first saw each (:class:`FirstImages`), with
hardly any damping.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import NamedTuple, Self

import gtsam
import numpy as np

from filters.smoothing.indeterminate import variable_named
from toolkit.errors import EstimatorError
from toolkit.geometry import Array, IntArray, se3_adjoint, se3_exp, se3_inverse, se3_log, se3_right_jacobian
from toolkit.measurements import StereoFrame, StereoRig
from toolkit.models import stereo
from toolkit.models.factors import B, L, X, linear_factor, poses_of, python_factors
from toolkit.models.graph_state import GraphIncrement
from toolkit.models.stereo import CHANNELS
from toolkit.models.twist import TwistIncrement
from toolkit.progress import SILENT, Progress

_FIRST_DAMPING, _MOST_DAMPING, _DAMPING_FACTOR = 1e-3, 1e8, 10.0
# Damping of steps in images, which overshoot little; with less, GTSAM finds far landmarks undetermined.
_DAMPING_IN_IMAGES = 1e-7
# Least decrease of the error, half a sum of squares in sigma: with exact measurements the error is near zero, and a
# relative criterion is never met.
_LEAST_DECREASE = 1e-12
# If a step raises the error by less than this share of it, the solve is at a minimum.
_NEGLIGIBLE_INCREASE = 1e-5
_FROM_CHANNELS = np.linalg.inv(CHANNELS)
# Largest growth of the logarithm of the depth in one step; it keeps disparities positive.
_MOST_FARTHER = 2.0


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
        steps = list(increments.values())
        return cls(
            np.array(list(increments), dtype=np.int64),
            np.array([step.T_start_end for step in steps]),
            np.array([step.d_step_d_bias for step in steps]),
            np.array([step.gyro_bias for step in steps]),
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


@dataclass(frozen=True, eq=False)
class FirstImages:
    """The M landmarks of a graph, L(track id) of ``track_ids`` (M,), and the frame X(``first``) that first saw each.

    Landmarks that keep their place in the image of a pose move with it. ``at_once`` says that they do so from the first
    step on.
    """

    track_ids: IntArray
    first: IntArray
    rig: StereoRig
    at_once: bool = False

    @classmethod
    def of(cls, frames: list[StereoFrame], rig: StereoRig, at_once: bool = False) -> "FirstImages":
        """Return the landmarks that frames (K,) see."""
        of_frame = np.repeat(np.arange(len(frames)), [frame.track_ids.size for frame in frames])
        track_ids, begins = np.unique(np.concatenate([frame.track_ids for frame in frames]), return_index=True)
        return cls(track_ids, of_frame[begins], rig, at_once)

    @classmethod
    def in_graph(cls, graph: gtsam.NonlinearFactorGraph, rig: StereoRig) -> "FirstImages":
        """Return the landmarks that stereo factors of a graph see; those with linear factors alone are left out."""
        first: dict[int, int] = {}
        for factor in map(graph.at, range(graph.size())):
            if isinstance(factor, gtsam.GenericStereoFactor3D | gtsam.GenericProjectionFactorCal3_S2):
                frame, track_id = (gtsam.Symbol(key).index() for key in factor.keys())  # noqa: SIM118 - not a mapping
                first[track_id] = min(frame, first.get(track_id, frame))
        ids = sorted(first)
        return cls(np.array(ids, dtype=np.int64), np.array([first[i] for i in ids], dtype=np.int64), rig)

    def taken(self, values: gtsam.Values, step: gtsam.VectorValues) -> gtsam.Values:
        """Return the values after a graph's own step, whose landmark parts are metres in the world.

        Each landmark moves in the image (c, d, v) px of the frame that first saw it, by its own step and the pose's. A
        landmark that is not in front of that camera has no image there, and is moved in metres.
        """
        points = np.array([values.atPoint3(L(i)) for i in self.track_ids.tolist()]).reshape(-1, 3)
        seen = stereo.predict(points, poses_of(values, self.first), self.rig)
        image = seen.uv_px @ CHANNELS.T
        front = image[:, 1] > 0.0
        image, ids, first = image[front], self.track_ids[front].tolist(), self.first[front]
        frames, row = np.unique(first, return_inverse=True)
        of_points = np.asarray(step.vector([L(i) for i in ids])).reshape(-1, 3)
        of_poses = step.vector([X(k) for k in frames.tolist()]).reshape(-1, 6)[row]
        by_pose, by_point = CHANNELS @ seen.d_uv_d_pose[front], CHANNELS @ seen.d_uv_d_point[front]
        change = np.einsum("mij,mj->mi", by_point, of_points) + np.einsum("mij,mj->mi", by_pose, of_poses)
        farther = np.clip(-change[:, 1] / image[:, 1], 0.0, _MOST_FARTHER)
        moved = image + change
        moved[:, 1] = np.where(farther > 0.0, image[:, 1] * np.exp(-farther), moved[:, 1])
        there = values.retract(step)
        places = stereo.triangulate_world(moved @ _FROM_CHANNELS.T, poses_of(there, first), self.rig)
        for track_id, place in zip(ids, places, strict=True):
            there.update(L(track_id), place)
        return there


@dataclass(frozen=True)
class Stopping:
    """When to stop: at a small decrease of the error relative to it, or after too many iterations.

    ``at_overshoot`` is for a solve that need not reach the minimum: it ends at the first step that raises the error
    after one that lowered it, because damping that step until it lowers the error takes an elimination for each
    attempt. A solve that has used up its iterations still counts as converged if the last one gained no more than a
    share ``enough`` of the error.
    """

    relative_decrease: float = 1e-5
    max_iterations: int = 50
    at_overshoot: bool = False
    enough: float = 0.0


class Solution(NamedTuple):
    """The values reached, their error (half the sum of squares), the iterations taken and whether it converged.

    ``overshot`` says whether a step of landmarks in metres raised the error.
    """

    values: gtsam.Values
    error: float
    iterations: int
    converged: bool
    overshot: bool = False


class _Reached(NamedTuple):
    """The values that a solve has reached, their error, and the damping of its next step."""

    values: gtsam.Values
    error: float
    damping: float


def solve(
    graph: gtsam.NonlinearFactorGraph | MixedGraph,
    start: gtsam.Values,
    stopping: Stopping,
    progress: Progress = SILENT,
    stage: str = "solving",
    landmarks: FirstImages | None = None,
    ordering: gtsam.Ordering | None = None,
) -> Solution:
    """Minimise the error of a graph from a start; ``progress`` is called at every iteration with the stage's name.

    ``landmarks`` are the images in which the graph's landmarks are moved once a step in metres has raised the error.
    ``ordering`` is the elimination order, by default COLAMD's.

    If no step, however short, lowers the error, the start is a minimum. Raises EstimatorError if the error at the start
    is not finite: some measurement or initial value is NaN.
    """
    mixed = graph if isinstance(graph, MixedGraph) else MixedGraph(graph)
    if ordering is None:
        ordering = gtsam.Ordering.ColamdNonlinearFactorGraph(mixed.whole)
    steps = _Steps(mixed, ordering, start.dims(), stopping.at_overshoot)
    in_images = landmarks if landmarks is not None and landmarks.at_once else None
    here = _Reached(start, mixed.error(start), _FIRST_DAMPING if in_images is None else _DAMPING_IN_IMAGES)
    if not np.isfinite(here.error):
        raise EstimatorError("the smoother's error is not a number at its start; look for NaN in the measurements")
    overshot = False
    for iteration in range(1, stopping.max_iterations + 1):
        progress.advance(iteration - 1, total=stopping.max_iterations, stage=stage)
        before, here = here, steps.next(here, in_images)
        gained = before.error - here.error
        if in_images is None and here.damping >= before.damping:
            overshot = True
            if landmarks is not None:
                # That step's damping does not show how near the minimum is, so it never ends the solve.
                in_images, here, gained = landmarks, here._replace(damping=_DAMPING_IN_IMAGES), np.inf
        if gained <= max(stopping.relative_decrease * here.error, _LEAST_DECREASE):
            return Solution(here.values, here.error, iteration, True, overshot)
    enough = gained <= stopping.enough * here.error
    return Solution(here.values, here.error, stopping.max_iterations, enough, overshot)


class _Steps:
    """Takes the steps of one solve."""

    def __init__(
        self, graph: MixedGraph, ordering: gtsam.Ordering, sizes: Mapping[int, int], ends_at_overshoot: bool
    ) -> None:
        self._graph, self._ordering, self._sizes, self._ends = graph, ordering, sizes, ends_at_overshoot
        self._has_lowered = False
        # Those of the last damping alone, which far along a solve stays: each takes some megabytes.
        self._damped_by, self._damping_factors = -1.0, gtsam.GaussianFactorGraph()

    def next(self, here: _Reached, images: FirstImages | None) -> _Reached:
        """Return the least damped step that lowers the error, with landmarks moved in images or, if None, in metres.

        Returns the same if none does. If a step raises the error only negligibly the solve is at a minimum: more
        damping would gain no more (GTSAM's rule).
        """
        linear, damping = self._graph.linear(here.values), here.damping
        while damping < _MOST_DAMPING:
            step = self._eliminated(linear, damping)
            if step is not None:
                there = here.values.retract(step) if images is None else images.taken(here.values, step)
                error = self._graph.error(there)
                if error <= here.error:
                    self._has_lowered = True
                    least = 0.0 if images is None else _DAMPING_IN_IMAGES
                    return _Reached(there, error, max(damping / _DAMPING_FACTOR, least))
                if error - here.error < _NEGLIGIBLE_INCREASE * here.error or (self._ends and self._has_lowered):
                    break
            damping *= _DAMPING_FACTOR
        return here

    def _eliminated(self, linear: gtsam.GaussianFactorGraph, damping: float) -> gtsam.VectorValues | None:
        """Return the damped step; None if the linear system does not determine it."""
        if damping != self._damped_by:
            self._damped_by, self._damping_factors = damping, _damping_factors(self._sizes, damping)
        damped = gtsam.GaussianFactorGraph()
        damped.push_back(linear)
        damped.push_back(self._damping_factors)
        try:
            return damped.eliminateSequential(self._ordering).optimize()
        except RuntimeError as refusal:
            variable_named(refusal)
            return None


def _damping_factors(sizes: Mapping[int, int], damping: float) -> gtsam.GaussianFactorGraph:
    """Return factors that damp variables, whose keys have sizes, at their values."""
    graph = gtsam.GaussianFactorGraph()
    parts = {size: (np.sqrt(damping) * np.eye(size), np.zeros(size)) for size in set(sizes.values())}
    units = {size: gtsam.noiseModel.Unit.Create(size) for size in parts}
    for key, size in sizes.items():
        graph.add(key, *parts[size], units[size])
    return graph
