"""Incremental smoother over the last two seconds; older states are marginalised (Kaess et al. 2012, iSAM2).

What it approximates: what has left the window stays linearised where it was and is never corrected again. Its
causal answer is the newest state, its final answer each state as it left the window.
"""

import gtsam

from filters.graph.growth import Growth
from toolkit.cutting import NS_PER_S
from toolkit.estimate import Estimate, Finished, Landmarks, Trajectory
from toolkit.estimator import Estimator, Setup
from toolkit.geometry import Array
from toolkit.models.factors import L
from toolkit.sequence import Packet

RUNG, CHANGE = 90, "+ relinearisation"
LAG_S = 2.0


def build(setup: Setup) -> Estimator:
    """Return the estimator for one sequence."""
    return FixedLag(setup, LAG_S)


class FixedLag:
    """Adds a packet to the window, lets GTSAM relinearise it, reads the states in it."""

    def __init__(self, setup: Setup, lag_s: float) -> None:
        params = gtsam.ISAM2Params()
        params.setRelinearizeThreshold(0.01)
        params.relinearizeSkip = 1
        params.findUnusedFactorSlots = True
        self._smoother = gtsam.IncrementalFixedLagSmoother(lag_s, params)
        self._growth = Growth(setup)
        self._lag_ns = int(lag_s * NS_PER_S)
        self._stamps_ns: list[int] = []
        self._states: list[Estimate] = []
        self._points: dict[int, Array] = {}
        self._last_seen_ns: dict[int, int] = {}

    def step(self, packet: Packet) -> Estimate:
        """Take in one packet and say where the IMU is."""
        grown = self._growth.by(packet)
        t_ns = packet.frame.t_ns
        self._stamps_ns.append(t_ns)
        elapsed_s = (t_ns - self._stamps_ns[0]) / NS_PER_S
        keys = grown.state_keys + [L(i) for i in grown.landmark_ids]
        self._smoother.update(grown.factors, grown.values, dict.fromkeys(keys, elapsed_s))
        self._last_seen_ns.update(dict.fromkeys(grown.landmark_ids, t_ns))
        self._read(self._smoother.calculateEstimate())
        return self._states[-1]

    def _read(self, values: gtsam.Values) -> None:
        """Take over every state and landmark of the window; those that leave it stay as last read."""
        newest_ns = self._stamps_ns[-1]
        first = next(k for k, t_ns in enumerate(self._stamps_ns) if t_ns >= newest_ns - self._lag_ns)
        motion = self._growth.motion
        self._states[first:] = [motion.read(values, k, self._stamps_ns[k]) for k in range(first, len(self._stamps_ns))]
        left = {i for i, t_ns in self._last_seen_ns.items() if t_ns < newest_ns - self._lag_ns}
        for track_id in left:
            del self._last_seen_ns[track_id]
        self._growth.forget(left)
        for track_id in self._last_seen_ns:
            self._points[track_id] = values.atPoint3(L(track_id))
        self._growth.belief = self._growth.belief.at(self._states[-1])

    def finish(self) -> Finished:
        """Return each state as it left the window, and every landmark as last known."""
        return Finished(Trajectory.of(self._states), Landmarks.of(self._points))
