"""Incremental smoother over the last two seconds; older states are marginalised (Kaess et al. 2012, iSAM2).

What it approximates: what has left the window stays linearised where it was and is never corrected again. Its
causal answer is the newest state, its final answer each state as it left the window, with the covariance the window
had for it. A variable that makes the window's system indeterminate, such as a landmark that fell behind the camera, is
held where it is, and the log says so.
"""

from dataclasses import replace

import gtsam

from filters.smoothing.graph_builder import Growth
from filters.smoothing.lag_window import LagWindow
from toolkit.estimate import Estimate, Finished, Landmarks, Trajectory
from toolkit.estimator import Estimator, Setup
from toolkit.geometry import Array
from toolkit.models.factors import L
from toolkit.resampling import NS_PER_S
from toolkit.sequence import Packet

RUNG, CHANGE = 90, "+ relinearisation"
LAG_S = 2.0


def build(setup: Setup) -> Estimator:
    """Return the estimator for one sequence."""
    return FixedLag(setup, LAG_S)


class FixedLag:
    """Adds a packet to the window, lets GTSAM relinearise it, reads the states in it."""

    def __init__(self, setup: Setup, lag_s: float) -> None:
        self._lag_ns = round(lag_s * NS_PER_S)
        self._window = LagWindow(self._lag_ns)
        self._growth = Growth(setup)
        self._first_in_window = 0
        self._states: list[Estimate] = []
        self._points: dict[int, Array] = {}
        self._last_seen_ns: dict[int, int] = {}
        self._log: list[str] = []

    def step(self, packet: Packet) -> Estimate:
        """Take in one packet and say where the IMU is."""
        grown, t_ns = self._growth.by(packet), packet.frame.t_ns
        while self._first_in_window < packet.index and self._states[self._first_in_window].t_ns < t_ns - self._lag_ns:
            self._complete(self._first_in_window)
            self._first_in_window += 1
        recovered = self._window.add(grown, t_ns)
        self._log += [f"frame {packet.index}: {line}" for line in recovered]
        self._last_seen_ns.update(dict.fromkeys(grown.landmark_ids, t_ns))
        self._read(self._window.values(), packet)
        return self._states[-1]

    def finish(self) -> Finished:
        """Return each state as it left the window, and every landmark as last known."""
        for k in range(self._first_in_window, len(self._states)):
            self._complete(k)
        return Finished(Trajectory.of(self._states), Landmarks.of(self._points), log=tuple(self._log))

    def _complete(self, k: int) -> None:
        """Give a state of the window the covariance it has there."""
        state = self._states[k]
        cov = self._window.state_cov(self._growth.motion.keys(k), state.T_world_imu[:3, :3])
        self._states[k] = replace(state, cov=cov)

    def _read(self, values: gtsam.Values, packet: Packet) -> None:
        """Take over every state and landmark of the window; what leaves it stays as last read."""
        motion, window = self._growth.motion, range(self._first_in_window, packet.index + 1)
        stamps_ns = [s.t_ns for s in self._states[self._first_in_window :]] + [packet.frame.t_ns]
        self._states[self._first_in_window :] = [motion.read(values, k, stamps_ns[k - window[0]]) for k in window]
        self._complete(packet.index)
        self._forget_before(packet.frame.t_ns - self._lag_ns)
        in_window = {i: values.atPoint3(L(i)) for i in self._last_seen_ns}
        self._points |= in_window
        self._growth.solved(self._states[-1], in_window)

    def _forget_before(self, oldest_ns: int) -> None:
        """Let the landmarks go that were last seen before the window."""
        left = {i for i, t_ns in self._last_seen_ns.items() if t_ns < oldest_ns}
        self._growth.forget(left)
        self._last_seen_ns = {i: t_ns for i, t_ns in self._last_seen_ns.items() if i not in left}
