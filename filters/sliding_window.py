"""Sliding-window smoother that solves its window anew at every frame, what left it included (Sibley et al. 2010).

What it approximates: what leaves becomes a Gaussian on the oldest state of the window and on the landmarks seen before
it. Its mean and its covariance are never computed again, but it is linearised at the estimates of every frame, as the
past is in a Kalman filter; `fixed-lag` keeps the linearisation points instead. States leave before a frame corrects,
and a frame is iterated to convergence, so that the window of the newest state alone is the iterated filter (Bell &
Cathey 1993). Two options say what that Gaussian is: the coordinates in which it is one, and whether its covariances
between the state and the landmarks are kept. Answers are read as in `fixed-lag`.
"""

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import gtsam
import numpy as np

from filters.fixed_lag import FixedLag
from filters.kalman.coordinates import inverse_depth, inverse_depth_jacobian
from filters.kalman.thinning import Thinned
from filters.smoothing.graph_builder import GraphExtension
from filters.smoothing.indeterminate import LAST, Recovery, variable_named
from toolkit.errors import EstimatorError
from toolkit.estimator import Estimator, Setup
from toolkit.geometry import Array, se3_inverse, se3_right_jacobian, skew, transform
from toolkit.measurements import NS_PER_S
from toolkit.models.factors import L, kind_of, linear_factor, ordering_of
from toolkit.settings import Scalar

CITES = ("sibley2010sliding", "bell1993iterated", "gtsam")
RUNG, CHANGE = 95, "what left the window linearised anew, a frame iterated to convergence"
OPTIONS = {"marginals": ("invariant", "latest"), "cross_covariances": (True, False)}
INGREDIENTS = (
    "landmark uncertainty",
    "biases",
    "cross-covariances",
    "consistent linearisation",
    "invariant error",
    "inverse depth",
    "past poses",
    "long-lived landmarks",
    "relinearisation",
)
WITHOUT = {
    "biases": {"noise.biases": "fixed"},
    "cross-covariances": {"cross_covariances": False},
    "past poses": {"window.most_states": 1},
}

# A step that lowers the error by no more than this, half a squared sigma, is the last: it moves nothing by more than a
# standard deviation. The weights of a robust loss change with every step, so that shorter steps are many.
_NEGLIGIBLE = 0.5
_MOST_STEPS, _MOST_HALVINGS = 10, 6
_UNSOLVED = "the last step in the window was longer than one standard deviation; further such windows are not listed"
_UNIT = gtsam.noiseModel.Unit.Create(1)


def build(setup: Setup) -> Estimator:
    """Return the estimator for one sequence."""
    lag_s = setup.settings.window.seconds(setup.motion_kind)
    coordinates: dict[Scalar, Coordinates] = {"invariant": InBody(setup.rig.T_imu_cam), "latest": Coordinates()}
    kept: dict[Scalar, Kept] = {True: whole, False: without_cross_covariances}
    chosen = setup.choice("marginals", coordinates), setup.choice("cross_covariances", kept)
    return Thinned(setup, FixedLag(setup, lag_s, SlidingWindow(round(lag_s * NS_PER_S), *chosen)))


class Coordinates:
    """What the errors of a Gaussian on one state and some landmarks are measured in: here GTSAM's own tangent spaces.

    Velocities and landmarks are in the axes of the world. Keys are in the order pose, (velocity,) bias, landmarks.
    """

    def errors(self, at: gtsam.Values, values: gtsam.Values, keys: list[int]) -> tuple[Array, Array]:
        """Return the errors (n,) of values against others, and their Jacobian (n, n) in GTSAM's tangent spaces.

        Here the identity, which it is to first order.
        """
        error = np.asarray(at.localCoordinates(values).vector(keys))
        return error, np.eye(error.size)

    def pass_on(self, old: gtsam.Pose3, new: gtsam.Pose3, landmarks: Sequence[int]) -> None:
        """Take note that the Gaussian is on another state from now on; ``landmarks`` are all that are in it then."""


@dataclass
class InBody(Coordinates):
    """Velocity and landmarks in the axes of the state, which a turned or displaced world leaves as they are.

    Heading and position of the whole therefore stay unobservable at changing estimates, as in the right-invariant error
    (Barrau & Bonnabel 2017), from which these differ by a constant matrix. Landmarks are (x / z, y / z, 1 / z) of the
    camera that saw them first, which moves with the state (Civera, Davison & Montiel 2008), as in `iekf`.
    """

    T_imu_cam: Array
    _anchors: dict[int, Array] = field(default_factory=dict)

    def errors(self, at: gtsam.Values, values: gtsam.Values, keys: list[int]) -> tuple[Array, Array]:
        """Return the errors (n,) and their exact Jacobian (n, n)."""
        before, after = at.atPose3(keys[0]).matrix(), values.atPose3(keys[0]).matrix()
        error = np.asarray(at.localCoordinates(values).vector(keys))
        to_body, H = after[:3, :3].T, np.eye(error.size)
        H[:6, :6] = np.linalg.inv(se3_right_jacobian(error[:6]))
        if kind_of(keys[1]) == "v":
            v_body = to_body @ values.atVector(keys[1])
            error[6:9] = v_body - before[:3, :3].T @ at.atVector(keys[1])
            H[6:9, :3], H[6:9, 6:9] = skew(v_body), to_body
        landmarks = [key for key in keys if kind_of(key) == "l"]
        if landmarks:
            first, anchors = error.size - 3 * len(landmarks), np.array([self._anchors[key] for key in landmarks])
            seen = transform(se3_inverse(after), np.array([values.atPoint3(key) for key in landmarks]))
            old = transform(se3_inverse(before), np.array([at.atPoint3(key) for key in landmarks]))
            to_anchors = se3_inverse(anchors)
            now, then = transform(to_anchors, seen), transform(to_anchors, old)
            error[first:] = (inverse_depth(now) - inverse_depth(then)).reshape(-1)
            by_seen = inverse_depth_jacobian(now) @ to_anchors[:, :3, :3]
            H[first:, :3], H[first:, 3:6] = (by_seen @ skew(seen)).reshape(-1, 3), -by_seen.reshape(-1, 3)
            for i, by_point in enumerate(by_seen @ to_body):
                H[first + 3 * i : first + 3 * i + 3, first + 3 * i : first + 3 * i + 3] = by_point
        return error, H

    def pass_on(self, old: gtsam.Pose3, new: gtsam.Pose3, landmarks: Sequence[int]) -> None:
        """Leave the cameras where they are in the world; landmarks that are new were seen first from the old state."""
        T_new_old = new.between(old).matrix()
        self._anchors = {key: T_new_old @ self._anchors.get(key, self.T_imu_cam) for key in landmarks}


class Gaussian(NamedTuple):
    """A Gaussian of errors e (n,) in some coordinates about values.

    The residuals ``root e - told`` have unit covariance: ``root`` is (m, n), ``told`` (m,).
    """

    keys: list[int]
    at: gtsam.Values
    root: Array
    told: Array
    coordinates: Coordinates

    def linear(self, values: gtsam.Values) -> gtsam.GaussianFactor:
        """Return the factor linearised at some values."""
        error, H = self.coordinates.errors(self.at, values.extract(self.keys), self.keys)
        sizes = self.at.dims()
        columns = np.split(self.root @ H, np.cumsum([sizes[key] for key in self.keys])[:-1], axis=1)
        return linear_factor(list(zip(self.keys, columns, strict=True)), self.told - self.root @ error)

    def error(self, values: gtsam.Values) -> float:
        """Return half the sum of squares."""
        error, _ = self.coordinates.errors(self.at, values.extract(self.keys), self.keys)
        return 0.5 * float(np.square(self.root @ error - self.told).sum())


Kept = Callable[[Array, Array, int], tuple[Array, Array]]
"""Changes a Gaussian, given by its root (m, n) and what it told (m,); the first ``size`` errors are the state's."""


def whole(root: Array, told: Array, size: int) -> tuple[Array, Array]:
    """Return the Gaussian as it is."""
    return root, told


def without_cross_covariances(root: Array, told: Array, size: int) -> tuple[Array, Array]:
    """Return the Gaussian as if state and landmarks were independent; raise EstimatorError if it is singular."""
    information = root.T @ root
    try:
        cov, mean = np.linalg.inv(information), np.linalg.solve(information, root.T @ told)
        cov[:size, size:], cov[size:, :size] = 0.0, 0.0
        root = np.linalg.inv(np.linalg.cholesky(cov))
    except np.linalg.LinAlgError as refusal:
        raise EstimatorError(
            "what left the window does not determine its state and landmarks, so their cross-covariances cannot be "
            "left out: set cross_covariances to true, or a larger noise"
        ) from refusal
    return root, root @ mean


class SlidingWindow:
    """Adds factors and values with their stamps; variables older than the lag are marginalised."""

    def __init__(self, lag_ns: int, coordinates: Coordinates, kept: Kept) -> None:
        self._lag_ns, self._coordinates, self._kept = lag_ns, coordinates, kept
        # Each with its keys, which every marginalisation asks of all of them.
        self._factors: list[tuple[frozenset[int], gtsam.NonlinearFactor]] = []
        self._left: Gaussian | None = None
        self._values = gtsam.Values()
        # The states in the order of time, each with its keys, and the landmarks: both with their last stamps.
        self._states: list[tuple[int, list[int]]] = []
        self._landmarks: dict[int, int] = {}
        self._tree = gtsam.GaussianBayesTree()
        self._is_told = False

    def add(self, extension: GraphExtension, t_ns: int) -> Recovery:
        """Add a packet's factors and values at a time, and solve; return the recoveries.

        Raises EstimatorError where the system does not determine a state.
        """
        self._states.append((t_ns, sorted(extension.state_keys, key=_place)))
        self._landmarks |= dict.fromkeys(map(L, extension.landmark_ids), t_ns)
        added = (extension.factors.at(i) for i in range(extension.factors.size()))
        self._factors += [(frozenset(factor.keys()), factor) for factor in added]
        self._values.insert(extension.values)
        oldest_ns = t_ns - self._lag_ns
        unseen = [key for key, seen_ns in self._landmarks.items() if seen_ns < oldest_ns]
        while self._states[0][0] < oldest_ns:
            leaving = self._states.pop(0)[1]
            is_last = self._states[0][0] >= oldest_ns
            self._marginalise([*leaving, *(unseen if is_last else ())])
        return self._solved()

    def drop(self, track_ids: Collection[int]) -> Recovery:
        """Remove landmarks and their sightings in the window; the others keep what older sightings told of them."""
        leaving = {L(i) for i in track_ids}
        self._factors = [one for one in self._factors if leaving.isdisjoint(one[0])]
        self._marginalise(sorted(leaving))
        return self._solved()

    def values(self) -> gtsam.Values:
        """Return the latest values of the window."""
        return self._values

    def jointMarginalCovariance(self, keys: list[int]) -> gtsam.JointMarginal:  # noqa: N802 - GTSAM's name
        """Return the joint marginal of some variables of the window."""
        return self._tree.jointMarginalCovariance(keys)

    def rebuilt_by_qr(self, refusal: RuntimeError) -> Recovery:
        """Raise the refusal of a covariance again: every frame is solved anew, nothing is left to rebuild."""
        raise refusal

    def _marginalise(self, leaving: list[int]) -> None:
        """Marginalise landmarks, or the variables of the state before the oldest one; what they told stays."""
        gone, values, state = set(leaving), self._values, self._states[0][1]
        linear = gtsam.GaussianFactorGraph()
        for keys_of, factor in self._factors:
            if not gone.isdisjoint(keys_of):
                linear.push_back(factor.linearize(values))
        if self._left is not None:
            linear.push_back(self._left.linear(values))
        known = set(linear.keyVector())
        if gone & known:
            self._factors = [one for one in self._factors if gone.isdisjoint(one[0])]
            _, rest = linear.eliminatePartialSequential(ordering_of(key for key in leaving if key in known))
            landmarks = sorted(key for key in known - gone if kind_of(key) == "l")
            before = leaving[0] if kind_of(leaving[0]) == "x" else state[0]
            self._coordinates.pass_on(values.atPose3(before), values.atPose3(state[0]), landmarks)
            keys = [*state, *landmarks]
            at = values.extract(keys)
            root, told = self._kept(*rest.jacobian(ordering_of(keys)), at.extract(state).dim())
            _, H = self._coordinates.errors(at, at, keys)
            self._left = Gaussian(keys, at, np.asarray(np.linalg.solve(H.T, root.T).T), told, self._coordinates)
        for key in leaving:
            self._landmarks.pop(key, None)
            if values.exists(key):
                values.erase(key)

    def _solved(self) -> Recovery:
        """Iterate to the minimum; landmarks that are indeterminate are dropped."""
        graph = gtsam.NonlinearFactorGraph()
        for _, factor in self._factors:
            graph.add(factor)
        try:
            converged = self._iterate(graph)
        except RuntimeError as refusal:
            key = variable_named(refusal)
            if kind_of(key) != "l":
                raise EstimatorError(f"{gtsam.Symbol(key).string()} is indeterminate in the window") from refusal
            track_id = gtsam.Symbol(key).index()
            line = f"landmark {track_id} made the system indeterminate and was dropped"
            again = self.drop([track_id])
            return Recovery([line, *again.log], {track_id} | again.dropped)
        if converged or self._is_told:
            return Recovery([], set())
        self._is_told = True
        return Recovery([_UNSOLVED], set())

    def _iterate(self, graph: gtsam.NonlinearFactorGraph) -> bool:
        """Take Gauss-Newton steps, halved until the error falls, until one would gain little; say whether one did."""
        ordering, error = self._order(), self._error(graph, self._values)
        for _ in range(_MOST_STEPS):
            linear = self._linear(graph)
            self._tree = linear.eliminateMultifrontal(ordering)
            step = self._tree.optimize()
            if abs(linear.error(gtsam.VectorValues.Zero(step)) - linear.error(step)) <= _NEGLIGIBLE:
                self._values = self._values.retract(step)
                return True
            shortened = (self._values.retract(step.scale(0.5**halvings)) for halvings in range(_MOST_HALVINGS + 1))
            tried = ((values, self._error(graph, values)) for values in shortened)
            lower = next(((values, then) for values, then in tried if then < error), None)
            if lower is None:
                return False
            self._values, error = lower
        return False

    def _linear(self, graph: gtsam.NonlinearFactorGraph) -> gtsam.GaussianFactorGraph:
        linear = graph.linearize(self._values)
        if self._left is not None:
            linear.push_back(self._left.linear(self._values))
        # As in the incremental tree, so that the state before the newest has a clique of its own (``indeterminate``).
        for key in self._states[-1][1]:
            size = self._values.extract([key]).dim()
            linear.add(gtsam.JacobianFactor(LAST, np.eye(1), key, np.zeros((1, size)), np.zeros(1), _UNIT))
        return linear

    def _error(self, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> float:
        return graph.error(values) + (0.0 if self._left is None else self._left.error(values))

    def _order(self) -> gtsam.Ordering:
        """Return the elimination order: landmarks, those that the Gaussian connects last, then states in time.

        The oldest state stands beside the newest, whose covariances are read at every frame.
        """
        connected = set() if self._left is None else set(self._left.keys)
        landmarks = sorted(self._landmarks, key=lambda key: (key in connected, key))
        states = [*self._states[1:-1], *self._states[:1], *self._states[1:][-1:]]
        return ordering_of([*landmarks, *(key for _, keys in states for key in keys), LAST])


def _place(key: int) -> int:
    return "xvb".index(kind_of(key))
