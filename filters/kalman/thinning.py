"""Where a window may not hold the states of all frames, it holds those of frames evenly spaced in time.

Filters and smoothers are thinned alike: the estimator gets only the frames of its states, with the whole motion between
them. The states of the other frames are predicted, and their sightings are not used. Where the cap on the number of
states does not bind, the estimator gets every frame.
"""

from dataclasses import replace
from typing import Any

import numpy as np

from toolkit.estimate import Estimate, Finished, Trajectory
from toolkit.estimator import Estimator, Setup
from toolkit.measurements import Motion, Packet, UnmeasuredMotion, noise_scale_of
from toolkit.models.state import predicted


class Thinned:
    """Passes on to an estimator the first frame of each of the window's intervals, renumbered from 0."""

    def __init__(self, setup: Setup, estimator: Estimator) -> None:
        self._estimator = estimator
        self._window, self._motion_kind = setup.settings.window, setup.motion_kind
        self._motion = setup.motion
        self._prior = self._motion.initial_belief(setup.prior)
        self._kept_ns: list[int] = []
        self._kept_interval = 0
        self._left_out: list[tuple[int, int, Motion]] = []
        self._since: Motion | None = None
        self._newest: Estimate | None = None

    def step(self, packet: Packet) -> Estimate:
        t_ns = packet.frame.t_ns
        self._since = _concatenated(self._since, packet.motion)
        interval = self._window.interval(t_ns - (self._kept_ns or [t_ns])[0], self._motion_kind)
        if self._newest is not None and interval == self._kept_interval:
            assert self._since is not None
            self._left_out.append((len(self._kept_ns) - 1, t_ns, self._since))
            return self._carried(self._newest, t_ns, self._since)
        answer = self._estimator.step(Packet(len(self._kept_ns), self._since, packet.frame))
        assert answer is not None
        self._kept_ns.append(t_ns)
        self._kept_interval, self._newest, self._since = interval, answer, None
        return answer

    def finish(self) -> Finished:
        """Return the estimator's result, with the omitted frames predicted from the states before them."""
        finished = self._estimator.finish()
        if not self._left_out:
            return finished
        states = finished.trajectory.states()
        carried = [self._carried(states[k], t_ns, motion) for k, t_ns, motion in self._left_out]
        return replace(finished, trajectory=Trajectory.of(sorted([*states, *carried], key=lambda state: state.t_ns)))

    def _carried(self, state: Estimate, t_ns: int, motion: Motion) -> Estimate:
        answer = predicted(self._prior.at(state), self._motion, motion).estimate(t_ns)
        return answer if state.cov is not None else replace(answer, cov=None)


def _concatenated(first: Motion | None, second: Motion | None) -> Motion | None:
    """Concatenate two successive motions of one kind; where one is None, return the other."""
    if first is None or second is None:
        return second if first is None else first
    if isinstance(first, UnmeasuredMotion) or isinstance(second, UnmeasuredMotion):
        return UnmeasuredMotion(np.concatenate([first.dt_s, second.dt_s]).sum(keepdims=True))
    scale = None
    if first.noise_scale is not None or second.noise_scale is not None:
        scale = np.concatenate([noise_scale_of(first), noise_scale_of(second)])
    sampled = [name for name in vars(first) if name != "noise_scale"]
    joined: dict[str, Any] = {name: np.concatenate([getattr(first, name), getattr(second, name)]) for name in sampled}
    return replace(first, **joined, noise_scale=scale)
