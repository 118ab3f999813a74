"""Incremental smoother over a window of seconds; older states are marginalised (Kaess et al. 2012, iSAM2).

What it approximates: a factor that has left the window stays linearised where it was and is never relinearised. The
causal answer is the newest state. The final answer is each state as it left the window, with the covariance it had in
the window. Three faults are recovered from, and the log lists them:

- a landmark that has fallen behind the camera is dropped and started again from its next sighting;
- a variable that makes the window's system indeterminate is held at its value;
- a landmark whose gate has rejected more sightings than it was built from is started again, if the rejected ones agree.
"""

from collections.abc import Collection, Iterable
from dataclasses import replace
from typing import Protocol

import gtsam

from filters.kalman.thinning import Thinned
from filters.smoothing.fixed_lag_tree import FixedLagTree
from filters.smoothing.graph_builder import GraphBuilder, GraphExtension
from filters.smoothing.indeterminate import Recovery
from toolkit.estimate import Estimate, Finished, Landmarks, Trajectory
from toolkit.estimator import Estimator, Setup
from toolkit.geometry import Array
from toolkit.measurements import NS_PER_S, Packet

CITES = ("kaess2012isam2", "gtsam")
RUNG, CHANGE = 90, "+ relinearisation; sightings used at once; all landmarks; gate once frame is solved"
INGREDIENTS = (
    "landmark uncertainty",
    "biases",
    "cross-covariances",
    "consistent linearisation",
    "past poses",
    "long-lived landmarks",
    "relinearisation",
)
WITHOUT = {"biases": {"noise.biases": "fixed"}}


class LagWindow(Protocol):
    """The graph of a window, solved at every packet; variables older than its lag are marginalised."""

    def add(self, extension: GraphExtension, t_ns: int) -> Recovery:
        """Add a packet's factors and values at a time, and solve; return the recoveries."""

    def drop(self, track_ids: Collection[int]) -> Recovery:
        """Remove landmarks and their sightings in the window."""

    def values(self) -> gtsam.Values:
        """Return the latest values, those of the states at least."""

    def points(self, track_ids: Iterable[int]) -> dict[int, Array]:
        """Return the latest points (3,) of landmarks of the window."""

    def cov(self, keys: list[int]) -> Array:
        """Return the joint covariance of the variables of a state of the window, in GTSAM's tangent spaces."""

    def rebuilt_by_qr(self, refusal: RuntimeError) -> Recovery:
        """Recover from the refusal of a covariance; raise it again where nothing helps."""


def build(setup: Setup) -> Estimator:
    lag_s = setup.settings.window.seconds(setup.motion_kind)
    return Thinned(setup, FixedLag(setup, lag_s))


class FixedLag:
    """Adds a packet to the window, has it solved, and reads the states in it; the window is GTSAM's by default."""

    def __init__(self, setup: Setup, lag_s: float, window: LagWindow | None = None) -> None:
        self._lag_ns = round(lag_s * NS_PER_S)
        self._tree = window or FixedLagTree(self._lag_ns)
        self._builder = GraphBuilder(setup)
        self._stamps_ns: list[int] = []
        # The window when it was last read: the values of its variables, and its landmarks (3,) m.
        self._values, self._in_window = gtsam.Values(), dict[int, Array]()
        # States and landmarks that have left the window, with their last values in it.
        self._states, self._points = list[Estimate](), dict[int, Array]()
        self._last_seen_ns: dict[int, int] = {}
        self._log: list[str] = []
        self._frame = 0

    def step(self, packet: Packet) -> Estimate:
        self._frame, t_ns = packet.index, packet.frame.t_ns
        # Before the packet's sightings are chosen: to read a covariance may cost landmarks.
        self._states += [self._state(k) for k in self._window() if self._stamps_ns[k] < t_ns - self._lag_ns]
        extension = self._builder.extend(packet)
        recovery = self._tree.add(extension, t_ns)
        self._stamps_ns.append(t_ns)
        self._last_seen_ns.update(dict.fromkeys(extension.landmark_ids, t_ns))
        self._note(recovery)
        newest = self._read(packet)
        self._drop_landmarks(t_ns)
        return newest

    def finish(self) -> Finished:
        states = [*self._states, *map(self._state, self._window())]
        landmarks = Landmarks.of(self._points | self._in_window)
        return Finished(Trajectory.of(states), landmarks, log=tuple(self._log))

    def _window(self) -> range:
        return range(len(self._states), len(self._stamps_ns))

    def _state(self, k: int) -> Estimate:
        """Return a state of the window as it was last read, with the covariance the window has for it."""
        state = self._builder.motion.read(self._values, k, self._stamps_ns[k])
        motion = self._builder.motion
        try:
            cov = self._tree.cov(motion.keys(k))
        except RuntimeError as refusal:
            self._note(self._tree.rebuilt_by_qr(refusal))
            cov = self._tree.cov(motion.keys(k))
        return replace(state, cov=motion.estimate_cov(cov, state.T_world_imu[:3, :3]))

    def _read(self, packet: Packet) -> Estimate:
        """Read the window's landmarks and return its newest state; states that have left keep their last values."""
        self._values = self._tree.values()
        newest = self._state(packet.index)
        left = {i for i, t_ns in self._last_seen_ns.items() if t_ns < packet.frame.t_ns - self._lag_ns}
        # Copied, because each is a row of one array: a view would keep the whole array alive.
        self._points |= {i: self._in_window[i].copy() for i in left}
        self._forget(left)
        self._in_window = self._tree.points(self._last_seen_ns)
        self._builder.update(newest, self._in_window)
        return newest

    def _drop_landmarks(self, newest_ns: int) -> None:
        seen = {i: self._in_window[i] for i, t_ns in self._last_seen_ns.items() if t_ns == newest_ns}
        why = {i: reason for i, reason in self._builder.to_drop(seen).items() if i in self._last_seen_ns}
        if why:
            self._note(self._tree.drop(why.keys()).after(why))

    def _note(self, recovery: Recovery) -> None:
        """Log a recovery, and forget the points of the landmarks that it dropped."""
        self._log += [f"frame {self._frame}: {line}" for line in recovery.log]
        self._forget(recovery.dropped)
        for i in recovery.dropped:
            self._points.pop(i, None)
            self._in_window.pop(i, None)

    def _forget(self, landmark_ids: set[int]) -> None:
        self._builder.forget(landmark_ids)
        for i in landmark_ids:
            self._last_seen_ns.pop(i, None)
