"""Sliding-window smoother that solves its window anew at every frame, what left it included (Sibley et al. 2010).

What it approximates: what leaves becomes a Gaussian on the oldest state of the window and on the landmarks seen before
it. Its mean and its covariance are never computed again, but it is linearised at the estimates of every frame, as the
past is in a Kalman filter; `fixed-lag` keeps the linearisation points instead. States leave before a frame corrects,
and a frame is iterated to convergence, so that the window of the newest state alone is the iterated filter (Bell &
Cathey 1993). Two options say what that Gaussian is: the coordinates in which it is one, and whether its covariances
between the state and the landmarks are kept. Answers are read as in `fixed-lag`. Landmarks that are not in the Gaussian
are eliminated as in `smart`; the rest of the system is dense.
"""

from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple, cast

import gtsam
import numpy as np
from scipy.linalg import cho_solve, solve_triangular

from filters.fixed_lag import FixedLag
from filters.kalman.coordinates import inverse_depth, inverse_depth_jacobian
from filters.kalman.thinning import Thinned
from filters.smoothing.graph_builder import GraphExtension
from filters.smoothing.indeterminate import Recovery
from toolkit.errors import EstimatorError
from toolkit.estimator import Estimator, Setup
from toolkit.geometry import Array, BoolArray, IntArray, se3_inverse, se3_right_jacobian, skew, transform
from toolkit.measurements import NS_PER_S
from toolkit.models.factors import kind_of
from toolkit.models.motion import motion_model
from toolkit.models.stereo_adjustment import (
    Eliminated,
    Ending,
    Evaluated,
    ReducedVision,
    RobustCamera,
    StereoWindow,
    check_error,
    lower_factor,
    without,
)
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

# A step that lowers the error by no more than this is the last: it is as short as the last one of every window of the
# house, in sigmas of all states together. Answers are then half a per cent of a sigma from the minimum; the weights of
# a robust loss change with every step, so that shorter steps are many.
_NEGLIGIBLE = 0.5 * Ending.step_sigmas**2
_MOST_STEPS, _MOST_HALVINGS = 10, 6
_UNSOLVED = "the last step in the window was longer than two standard deviations; further such windows are not listed"


def build(setup: Setup) -> Estimator:
    """Return the estimator for one sequence."""
    lag_s = setup.settings.window.seconds(setup.motion_kind)
    coordinates: dict[Scalar, Coordinates] = {"invariant": InBody(setup.rig.T_imu_cam), "latest": Coordinates()}
    kept: dict[Scalar, Kept] = {True: whole, False: without_cross_covariances}
    chosen = setup.choice("marginals", coordinates), setup.choice("cross_covariances", kept)
    return Thinned(setup, FixedLag(setup, lag_s, SlidingWindow(setup, round(lag_s * NS_PER_S), *chosen)))


class Blocks(NamedTuple):
    """The Jacobian (n, n) of errors of a state and M landmarks, in which a landmark's error involves no other landmark.

    ``state`` (n, d) are the columns of the state, ``points`` (M, 3, 3) the blocks of the landmarks; n = d + 3M.
    """

    state: Array
    points: Array

    def after(self, matrix: Array) -> Array:
        """Return the product (m, n) of a matrix (m, n) and this one."""
        d = self.state.shape[1]
        of_points = matrix[:, d:].reshape(len(matrix), -1, 3).swapaxes(0, 1) @ self.points
        return np.hstack([matrix @ self.state, of_points.swapaxes(0, 1).reshape(len(matrix), -1)])

    def carry(self, information: Array, vector: Array) -> tuple[Array, Array]:
        """Return an information matrix (n, n) and vector (n,) of the errors as those of what they are errors of."""
        return self.after(self.after(information).T), self.after(vector[None])[0]

    def inverse(self) -> "Blocks":
        """Return the inverse."""
        d, points = self.state.shape[1], np.asarray(np.linalg.inv(self.points))
        of_state = np.linalg.inv(self.state[:d])
        below = points @ self.state[d:].reshape(-1, 3, d)
        return Blocks(np.vstack([of_state, -below.reshape(-1, d) @ of_state]), points)


class Place(NamedTuple):
    """A state, its keys in the order pose, (velocity,) bias, and landmarks (M, 3) m in the world."""

    keys: tuple[int, ...]
    state: gtsam.Values
    points: Array

    @classmethod
    def of(cls, window: StereoWindow, points: Array) -> "Place":
        """Return the oldest state of a window, and points."""
        return cls(window.keys[0], window.values.extract(list(window.keys[0])), points)


class Coordinates:
    """What the errors of a Gaussian on one state and some landmarks are measured in: here GTSAM's own tangent spaces.

    Velocities and landmarks are in the axes of the world.
    """

    def errors(self, at: Place, now: Place) -> tuple[Array, Blocks]:
        """Return the errors (n,) of a place against another, and their Jacobian in GTSAM's tangent spaces.

        Here the identity, which it is to first order.
        """
        of_state = np.asarray(at.state.localCoordinates(now.state).vector(list(now.keys)))
        error = np.concatenate([of_state, (now.points - at.points).ravel()])
        return error, Blocks(np.eye(error.size, of_state.size), np.tile(np.eye(3), (len(at.points), 1, 1)))

    def pass_on(self, T_new_old: Array, track_ids: IntArray) -> None:
        """Take note that the Gaussian is on another state from now on; ``track_ids`` are all landmarks in it then."""


@dataclass
class InBody(Coordinates):
    """Velocity and landmarks in the axes of the state, which a turned or displaced world leaves as they are.

    Heading and position of the whole therefore stay unobservable at changing estimates, as in the right-invariant error
    (Barrau & Bonnabel 2017), from which these differ by a constant matrix. Landmarks are (x / z, y / z, 1 / z) of the
    camera that saw them first, which moves with the state (Civera, Davison & Montiel 2008), as in `iekf`.
    """

    T_imu_cam: Array
    _anchors: dict[int, Array] = field(default_factory=dict)
    _to_anchors: Array = field(default_factory=lambda: np.empty((0, 4, 4)))

    def errors(self, at: Place, now: Place) -> tuple[Array, Blocks]:
        """Return the errors (n,) and their exact Jacobian."""
        pose, velocity, *_ = now.keys
        error, H = super().errors(at, now)
        before, after = at.state.atPose3(pose).matrix(), now.state.atPose3(pose).matrix()
        d, to_body = H.state.shape[1], after[:3, :3].T
        H.state[:6, :6] = np.linalg.inv(se3_right_jacobian(error[:6]))
        if kind_of(velocity) == "v":
            v_body = to_body @ now.state.atVector(velocity)
            error[6:9] = v_body - before[:3, :3].T @ at.state.atVector(velocity)
            H.state[6:9, :3], H.state[6:9, 6:9] = skew(v_body), to_body
        seen, old = transform(se3_inverse(after), now.points), transform(se3_inverse(before), at.points)
        seen_there = transform(self._to_anchors, seen)
        error[d:] = (inverse_depth(seen_there) - inverse_depth(transform(self._to_anchors, old))).ravel()
        by_seen = inverse_depth_jacobian(seen_there) @ self._to_anchors[:, :3, :3]
        H.state[d:, :3], H.state[d:, 3:6] = (by_seen @ skew(seen)).reshape(-1, 3), -by_seen.reshape(-1, 3)
        return error, Blocks(H.state, by_seen @ to_body)

    def pass_on(self, T_new_old: Array, track_ids: IntArray) -> None:
        """Leave the cameras where they are in the world; landmarks that are new were seen first from the old state."""
        cameras = [self._anchors.get(i, self.T_imu_cam) for i in track_ids.tolist()]
        anchors = T_new_old @ np.array(cameras).reshape(-1, 4, 4)
        self._anchors, self._to_anchors = dict(zip(track_ids.tolist(), anchors, strict=True)), se3_inverse(anchors)


class Gaussian(NamedTuple):
    """A Gaussian of errors e (n,) in some coordinates about a place: ``e^T information e / 2 - vector^T e``."""

    track_ids: IntArray
    at: Place
    information: Array
    vector: Array
    coordinates: Coordinates

    def error(self, errors: Array) -> float:
        """Return half the sum of squares of errors (n,), up to a constant."""
        return float((0.5 * self.information @ errors - self.vector) @ errors)


Kept = Callable[[Array, Array, int], tuple[Array, Array]]
"""Changes a Gaussian, given by its information (n, n) and vector (n,); the first ``size`` errors are the state's."""


def whole(information: Array, vector: Array, size: int) -> tuple[Array, Array]:
    """Return the Gaussian as it is."""
    return information, vector


def without_cross_covariances(information: Array, vector: Array, size: int) -> tuple[Array, Array]:
    """Return the Gaussian as if state and landmarks were independent; raise EstimatorError if it is singular."""
    try:
        root = lower_factor(information)
    except np.linalg.LinAlgError as refusal:
        raise EstimatorError(
            "what left the window does not determine its state and landmarks, so their cross-covariances cannot be "
            "left out: set cross_covariances to true, or a larger noise"
        ) from refusal
    solved = cho_solve((root, True), np.column_stack([np.eye(len(vector)), vector]), check_finite=False)
    result, mean = np.zeros_like(information), solved[:, -1]
    for part in (slice(size), slice(size, len(vector))):
        result[part, part] = np.linalg.inv(solved[part, part])
    return result, result @ mean


class Tried(NamedTuple):
    """A window evaluated, its error with that of a Gaussian on its oldest state, and these errors with Jacobian."""

    here: Evaluated
    error: float
    off: Array
    H: Blocks | None

    @classmethod
    def of(cls, window: StereoWindow, camera: RobustCamera, left: Gaussian | None, tied: IntArray) -> "Tried":
        """Evaluate a window; ``tied`` are the rows of the Gaussian's landmarks in it."""
        here = Evaluated.of(window, camera)
        if left is None:
            return cls(here, here.error, np.zeros(0), None)
        off, H = left.coordinates.errors(left.at, Place.of(window, window.points[tied]))
        return cls(here, here.error + left.error(off), off, H)


@dataclass(frozen=True, eq=False)
class Equations:
    """The normal equations (n, n), (n,) of a window of K states with d errors each.

    The unknowns are all poses, the velocities and biases of the oldest and of the newest state, and the landmarks
    ``tied`` to more than sightings. Velocities and biases between, which the motion alone involves, were eliminated
    (``between``), and so were all other landmarks. ``places`` (K d,) are, before the landmarks, the unknowns' places in
    the order of time, eliminated ones first.
    """

    information: Array
    vector: Array
    places: IntArray
    between: Eliminated
    vision: ReducedVision
    tied: IntArray

    @classmethod
    def of(cls, tried: Tried, left: Gaussian | None, tied: IntArray) -> "Equations":
        """Linearise a window and a Gaussian on its oldest state and on the first of the landmarks that are tied."""
        here, keys, d = tried.here, tried.here.window.keys, tried.here.window.size
        count, vision = len(keys), here.vision.reduced(tied)
        order = [*(key for of_one in keys[1:-1] for key in of_one[1:]), *(of_one[0] for of_one in keys)]
        order += [key for of_one in keys[:1] + keys[1:][-1:] for key in of_one[1:]]
        place = np.arange(count * d).reshape(count, d)
        ends = place[[0, -1] if count > 1 else [0], 6:]
        places = np.concatenate([place[1:-1, 6:].ravel(), place[:, :6].ravel(), ends.ravel()])
        of_states, vector, between = without(*here.of_motion(order), place[1:-1, 6:].size)
        poses, first = 6 * count, len(vector)
        across = vision.coupling.reshape(poses, -1, 3)[:, tied].reshape(poses, -1)
        information = np.zeros((first + across.shape[1], first + across.shape[1]))
        information[:first, :first] = of_states
        information[:poses, :poses] += vision.information
        information[:poses, first:], information[first:, :poses] = across, across.T
        diagonal = first + np.arange(across.shape[1]).reshape(-1, 3)
        information[diagonal[:, :, None], diagonal[:, None]] = vision.of_points[tied]
        vector = np.concatenate([vector, vision.point_vector[tied].ravel()])
        vector[:poses] += vision.vector
        if left is not None and tried.H is not None:
            of_left, vector_left = tried.H.carry(left.information, left.vector - left.information @ tried.off)
            size = len(vector_left)
            parts = (0, 0, 6), (poses, 6, d), (first, d, size)
            spans = [(slice(start, start + end - begin), slice(begin, end)) for start, begin, end in parts]
            for rows, of_rows in spans:
                vector[rows] += vector_left[of_rows]
                for columns, of_columns in spans:
                    information[rows, columns] += of_left[of_rows, of_columns]
        return cls(information, vector, places, between, vision, tied)

    @cached_property
    def root(self) -> Array:
        """The lower Cholesky factor (n, n) of the information; raises LinAlgError where there is none."""
        return lower_factor(self.information)

    def solved(self) -> tuple[Array, Array, float]:
        """Return the steps of the states (K d,) and of all landmarks (M, 3), and by how much they lower the error."""
        steps = cho_solve((self.root, True), self.vector, check_finite=False)
        known, states = steps[: -3 * len(self.tied) or None], np.empty(len(self.places))
        states[self.places] = np.concatenate([self.between.steps(known), known])
        points = self.vision.point_steps(known[: len(self.vision.vector)])
        points[self.tied] = steps[len(known) :].reshape(-1, 3)
        others = np.delete(self.vision.point_vector, self.tied, axis=0)
        gain = self.vector @ steps + np.square(self.between.vector).sum() + np.square(others).sum()
        return states, points, 0.5 * float(gain)

    def cov(self, i: int, d: int) -> Array:
        """Return the covariance (d, d) of state i, in GTSAM's tangent spaces."""
        chosen, count = np.eye(len(self.places), d, -i * d)[self.places], len(self.between.vector)
        eliminated = solve_triangular(self.between.root, chosen[:count], lower=True, check_finite=False)
        rest = np.zeros((len(self.vector), d))
        rest[: len(self.places) - count] = chosen[count:] - self.between.across.T @ eliminated
        known = solve_triangular(self.root, rest, lower=True, check_finite=False)
        return np.asarray(eliminated.T @ eliminated + known.T @ known)


class SlidingWindow:
    """Adds packets with their stamps to a window; variables older than the lag are marginalised."""

    def __init__(self, setup: Setup, lag_ns: int, coordinates: Coordinates, kept: Kept) -> None:
        self._lag_ns, self._coordinates, self._kept = lag_ns, coordinates, kept
        self._motion = motion_model(setup.noise, setup.gravity_world)
        self._camera = RobustCamera(setup.rig, setup.settings.outliers.smoother_huber)
        self._window, self._left = StereoWindow.empty(), cast(Gaussian | None, None)
        self._stamps_ns, self._last_seen_ns = list[int](), dict[int, int]()
        self._read: tuple[tuple[tuple[int, ...], ...], Equations] | None = None
        self._is_told = False

    def add(self, extension: GraphExtension, t_ns: int) -> Recovery:
        """Add a packet's state and sightings at a time, and solve.

        Raises EstimatorError where the system does not determine a state.
        """
        assert extension.seen is not None
        k = gtsam.Symbol(extension.state_keys[0]).index()
        estimate = self._motion.read(extension.values, k, t_ns)
        new = self._motion, estimate, extension.motion, extension.seen, k, self._camera.rig
        self._window = self._window.extended(*new)
        self._stamps_ns.append(t_ns)
        self._last_seen_ns |= dict.fromkeys(extension.landmark_ids, t_ns)
        oldest_ns = t_ns - self._lag_ns
        unseen = [i for i, seen_ns in self._last_seen_ns.items() if seen_ns < oldest_ns]
        while self._stamps_ns[0] < oldest_ns:
            self._stamps_ns.pop(0)
            self._without_oldest(unseen if self._stamps_ns[0] >= oldest_ns else [])
        return self._solved()

    def drop(self, track_ids: Collection[int]) -> Recovery:
        """Remove landmarks and their sightings in the window; the others keep what older sightings told of them."""
        if self._left is not None:
            known, at, information, vector, _ = self._left
            gone = np.isin(known, list(track_ids))
            leave = np.concatenate([np.zeros(self._window.size, dtype=bool), np.repeat(gone, 3)])
            information, vector = _without(information, vector, leave)
            self._coordinates.pass_on(np.eye(4), known[~gone])
            at = at._replace(points=at.points[~gone])
            self._left = Gaussian(known[~gone], at, information, vector, self._coordinates)
        self._forget(track_ids)
        return self._solved()

    def values(self) -> gtsam.Values:
        """Return the latest values of the states."""
        return self._window.values

    def points(self, track_ids: Iterable[int]) -> dict[int, Array]:
        """Return the latest points (3,) of landmarks of the window."""
        known = self._window.points_by_id()
        return {i: known[i] for i in track_ids}

    def cov(self, keys: list[int]) -> Array:
        """Return the joint covariance of the variables of a state, in GTSAM's tangent spaces."""
        assert self._read is not None
        states, equations = self._read
        return equations.cov(states.index(tuple(keys)), self._window.size)

    def rebuilt_by_qr(self, refusal: RuntimeError) -> Recovery:
        """Raise the refusal of a covariance again: every frame is solved anew, nothing is left to rebuild."""
        raise refusal

    def _tied(self) -> IntArray:
        """Return the rows (M,) of the Gaussian's landmarks in the window."""
        row_of = {i: row for row, i in enumerate(self._window.track_ids.tolist())}
        known = [] if self._left is None else self._left.track_ids.tolist()
        return np.array([row_of[i] for i in known], dtype=np.int64)

    def _without_oldest(self, unseen: Collection[int]) -> None:
        """Marginalise the oldest state, and landmarks that no other state sees; what they told stays."""
        window, tied = self._window, self._tied()
        seen, by_oldest = window.sightings, window.sightings.pose == 0
        rows = np.concatenate([tied, np.setdiff1d(seen.point[by_oldest], tied)])
        leaving = replace(window.with_points(rows, by_oldest), keys=window.keys[:2], motion=window.motion[:2])
        tried = Tried.of(leaving, self._camera, self._left, np.arange(len(tied)))
        equations = Equations.of(tried, self._left, np.arange(len(rows)))
        d, gone = window.size, np.isin(leaving.track_ids, list(unseen))
        leave = np.concatenate([equations.places < d, np.repeat(gone, 3)])
        information, vector = self._kept(*_without(equations.information, equations.vector, leave), d)
        old, new = leaving.poses
        self._coordinates.pass_on(se3_inverse(new) @ old, leaving.track_ids[~gone])
        self._window = window.later(1)
        at = Place.of(self._window, leaving.points[~gone])
        _, H = self._coordinates.errors(at, at)
        self._left = Gaussian(leaving.track_ids[~gone], at, *H.inverse().carry(information, vector), self._coordinates)
        self._forget(unseen)

    def _forget(self, track_ids: Collection[int]) -> None:
        """Remove landmarks and their sightings."""
        kept = ~np.isin(self._window.track_ids, list(track_ids))
        self._window = self._window.with_points(np.flatnonzero(kept), kept[self._window.sightings.point])
        for i in track_ids:
            self._last_seen_ns.pop(i, None)

    def _solved(self) -> Recovery:
        """Iterate to the minimum."""
        try:
            converged = self._iterate()
        except np.linalg.LinAlgError as refusal:
            raise EstimatorError(f"the window does not determine its states ({refusal})") from refusal
        if converged or self._is_told:
            return Recovery([], set())
        self._is_told = True
        return Recovery([_UNSOLVED], set())

    def _iterate(self) -> bool:
        """Take Gauss-Newton steps, halved until the error falls, until one would gain little; say whether one did."""
        tied = self._tied()
        tried = Tried.of(self._window, self._camera, self._left, tied)
        check_error(tried.error)
        for _ in range(_MOST_STEPS):
            equations, window = Equations.of(tried, self._left, tied), self._window
            states, points, gain = equations.solved()
            self._read = window.keys, equations
            if gain <= _NEGLIGIBLE:
                self._window = window.moved(states, points)
                return True
            shares = (0.5**halvings for halvings in range(_MOST_HALVINGS + 1))
            shortened = (window.moved(share * states, share * points) for share in shares)
            tries = (Tried.of(moved, self._camera, self._left, tied) for moved in shortened)
            lower = next((one for one in tries if one.error < tried.error), None)
            if lower is None:
                return False
            tried, self._window = lower, lower.here.window
        return False


def _without(information: Array, vector: Array, gone: BoolArray) -> tuple[Array, Array]:
    """Return a Gaussian's information (n, n) and vector (n,) without the errors of a mask."""
    order = np.argsort(~gone, kind="stable")
    information, vector, _ = without(information[np.ix_(order, order)], vector[order], int(np.count_nonzero(gone)))
    return information, vector
