"""Fixed-lag smoother over a window of seconds whose landmarks are eliminated: smart stereo factors.

What it approximates: a track is a factor on the poses that saw it, relinearised at every iteration; its landmark is
never a variable (Carlone et al. 2014; Forster et al. 2017, section VI). When the oldest state leaves, its tracks are
marginalised with it at their current linearisation; a track that is still seen starts again, so no landmark is
remembered beyond the window. The causal answer is the newest state. The final answer is each state as it left the
window, with the covariance it had in the window.
"""

from collections.abc import Iterable
from dataclasses import replace

import gtsam
import numpy as np

from filters.kalman.thinning import Thinned
from filters.smoothing.outlier_check import KnownLandmarks, OutlierCheck, relative_to_its_map
from toolkit.errors import EstimatorError
from toolkit.estimate import Estimate, Finished, Landmarks, Trajectory
from toolkit.estimator import Estimator, Setup
from toolkit.geometry import Array
from toolkit.measurements import NS_PER_S, Packet, StereoFrame
from toolkit.models.motion import motion_model
from toolkit.models.stereo_adjustment import (
    Ending,
    RobustCamera,
    SolvedWindow,
    StereoWindow,
    solve_window,
    without_oldest,
)

CITES = ("carlone2014eliminating", "forster2017manifold", "gtsam")
RUNG, CHANGE = 100, "+ landmarks eliminated at each of several iterations, none kept"
INGREDIENTS = (
    "landmark uncertainty",
    "biases",
    "cross-covariances",
    "consistent linearisation",
    "past poses",
    "relinearisation",
)
WITHOUT = {"biases": {"noise.biases": "fixed"}}

_ENDING = Ending()


def build(setup: Setup) -> Estimator:
    return Thinned(setup, Smart(setup, setup.settings.window.seconds(setup.motion_kind)))


class Smart:
    """Adds a packet to the window, solves it, and removes the oldest states."""

    def __init__(self, setup: Setup, lag_s: float) -> None:
        outliers = setup.settings.outliers
        self._rig, self._lag_ns = setup.rig, round(lag_s * NS_PER_S)
        self._camera = RobustCamera(setup.rig, outliers.smoother_huber)
        self._outlier_check, self._landmarks = OutlierCheck(setup.rig, outliers), KnownLandmarks(setup.rig)
        self._motion = motion_model(setup.noise, setup.gravity_world)
        self._belief = self._motion.initial_belief(setup.prior)
        self._window = StereoWindow.empty()
        self._solution = SolvedWindow(self._window, np.empty((0, 0)))
        self._states: list[Estimate] = []
        self._points: dict[int, Array] = {}
        self._log: list[str] = []

    def step(self, packet: Packet) -> Estimate:
        try:
            self._solution = solve_window(self._extended(packet), self._camera, _ENDING)
        except EstimatorError as refusal:
            self._log.append(f"frame {packet.index}: {refusal}; the window starts again at this frame")
            self._complete_all()
            self._solution = solve_window(self._started(packet), self._camera, _ENDING)
        self._window = self._solution.window
        self._read(packet)
        self._shorten(packet)
        return self._states[-1]

    def finish(self) -> Finished:
        self._complete_all()
        return Finished(Trajectory.of(self._states), Landmarks.of(self._points), log=tuple(self._log))

    def _extended(self, packet: Packet) -> StereoWindow:
        if packet.motion is None:
            return self._started(packet)
        increment = self._motion.integrate(packet.motion, self._belief.bias)
        prediction = increment.predict(self._belief)
        expected = relative_to_its_map(self._belief).predicted(prediction)
        # The predicted state is the initial value; the solver iterates from it.
        _, sound = self._outlier_check.placed(expected, packet.frame, self._landmarks)
        self._belief = self._belief.predicted(prediction)
        return self._with_state(self._window, packet.index, sound, increment.factors(packet.index))

    def _started(self, packet: Packet) -> StereoWindow:
        """Return a window that begins here, its state tied to the prediction."""
        hold = self._motion.hold(self._belief, packet.index)
        return self._with_state(StereoWindow.empty(), packet.index, packet.frame, hold)

    def _with_state(
        self, window: StereoWindow, k: int, frame: StereoFrame, factors: gtsam.NonlinearFactorGraph
    ) -> StereoWindow:
        estimate = self._belief.estimate(frame.t_ns)
        return window.extended(self._motion, estimate, factors, frame, k, self._rig)

    def _read(self, packet: Packet) -> None:
        """Read every state and landmark of the window; drop the landmarks that fell behind a camera."""
        self._window, behind = self._window.in_front(self._rig)
        self._log += [f"frame {packet.index}: landmark {i} fell behind a camera and was dropped" for i in behind]
        window, first = self._window, packet.index + 1 - len(self._window.keys)
        stamps_ns = [s.t_ns for s in self._states[first:]] + [packet.frame.t_ns]
        self._states[first:] = [self._motion.read(window.values, first + i, t_ns) for i, t_ns in enumerate(stamps_ns)]
        self._complete([len(window.keys) - 1])
        points = window.points_by_id()
        self._points |= points
        self._belief = self._belief.at(self._states[-1])
        self._landmarks.keep(points)
        self._landmarks.see(window.newest(packet.frame), points, self._belief.T_world_imu)

    def _complete(self, places: Iterable[int]) -> None:
        """Give states of the window, by their indices in it, their covariance there."""
        first = len(self._states) - len(self._solution.window.keys)
        for i in places:
            state = self._states[first + i]
            cov = self._motion.estimate_cov(self._solution.cov(i), state.T_world_imu[:3, :3])
            self._states[first + i] = replace(state, cov=cov)

    def _complete_all(self) -> None:
        self._complete(range(len(self._solution.window.keys)))

    def _shorten(self, packet: Packet) -> None:
        """Remove the states that are older than the lag, all at once."""
        oldest_ns, in_window = packet.frame.t_ns - self._lag_ns, len(self._window.keys)
        leaving = sum(state.t_ns < oldest_ns for state in self._states[-in_window:])
        if leaving:
            self._complete(range(leaving))
            self._window = without_oldest(self._window, leaving, self._camera)
