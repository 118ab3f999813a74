"""How many times its stated noise the measured motion has, by what the tracks have to correct from frame to frame.

The correction of the state now has the covariance it takes away. A gate cannot test this: what stamps that are some
milliseconds off, an optimistic data sheet or a scale error of the camera do to all tracks of a frame, each track has so
little of that it passes, and the NIS of all rows stays near one while the state jumps by many of its sigmas. Biases and
tilt take most of it, which nothing else measures: gravity is then turned for good.

So the variance of the motion's noise is matched to the corrections ("covariance matching": Mehra 1972, "Approaches to
adaptive filtering"; for process noise Mohamed & Schwarz 1999, "Adaptive Kalman filtering for INS/GPS"), never below
what is stated. It begins where the corrections of a window add up to what chance does once in a million: a sound filter
stays, to the bit, what it is without.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Self

import numpy as np
from scipy.special import chdtri

from toolkit.estimator import Setup
from toolkit.measured_motion import with_noise_scaled
from toolkit.models.corrections import CorrectionTest, correction_test
from toolkit.models.state import Belief
from toolkit.resampling import NS_PER_S
from toolkit.sequence import Packet

# The corrections of a sound filter's window are beyond this quantile once in a million.
BY_CHANCE = 1e-6
# Of the variance: an IMU that errs a hundred times as much as it states has another fault, of which the status tells.
_MOST = 1e4
# Less rounds to 1.0 times the stated noise and is not logged.
_LEAST_REPORTED = 1.05


# Tests what measurements made of a belief.
Test = Callable[[Belief, Belief], CorrectionTest]


class MatchedNoise:
    """Matches the variance of an IMU's white noise to the corrections of so many latest seconds as a window has."""

    def __init__(self, window_s: float, matches: bool = True, test: Test = correction_test) -> None:
        self._window_ns, self._matches, self._test = round(window_s * NS_PER_S), matches, test
        self._scales, self._applied = [1.0], 1.0
        self._tests: list[tuple[int, CorrectionTest]] = []

    @classmethod
    def of(cls, setup: Setup, test: Test = correction_test) -> Self:
        """Return the matched noise of an estimator; twists, whose noise is measured from their own scatter, keep it."""
        kind, settings = setup.motion_kind, setup.settings
        return cls(settings.window.seconds(kind), settings.noise.match_imu and kind == "imu", test)

    @property
    def scale(self) -> float:
        """Return how many times the stated variance that of the motion is taken for."""
        return self._scales[-1]

    @property
    def info(self) -> dict[str, float]:
        """Return the scale of the latest packet's motion, by the name an Estimate's info has."""
        return {"motion_noise_scale": self._applied}

    @property
    def messages(self) -> tuple[str, ...]:
        """Return a line for the log where the stated noise did not hold, else nothing."""
        most, usual = np.sqrt([max(self._scales), np.median(self._scales)])
        if most < _LEAST_REPORTED:
            return ()
        return (
            f"the tracks contradict the IMU: its noise was taken for up to {most:.1f} times what is stated "
            f"({usual:.1f} at the median); check stamps, calibration and the stated noise",
        )

    def applied(self, packet: Packet) -> Packet:
        """Return a packet whose motion has the noise that it is taken for now."""
        self._applied = self.scale
        if self.scale == 1.0 or packet.motion is None:
            return packet
        return replace(packet, motion=with_noise_scaled(packet.motion, self.scale))

    def learn(self, t_ns: int, predicted: Belief, corrected: Belief) -> None:
        """Take in what a frame's tracks made of the state that was predicted for it."""
        if self._matches:
            self.take(t_ns, self._test(predicted, corrected))

    def take(self, t_ns: int, test: CorrectionTest) -> None:
        """Take in the test of one more frame.

        The scale follows the ratio of NIS to degrees of freedom as an exponential mean over a window's frames does.
        """
        self._tests = [(t, each) for t, each in self._tests if t >= t_ns - self._window_ns] + [(t_ns, test)]
        scale = self.scale
        if scale > 1.0 or self._beyond_chance():
            share = 2.0 / (len(self._tests) + 1.0)
            scale *= 1.0 + share * (test.nis / max(test.dof, 1) - 1.0)
            scale = min(max(scale, 1.0), _MOST)
        self._scales.append(scale)

    def _beyond_chance(self) -> bool:
        nis, dof = sum(test.nis for _, test in self._tests), sum(test.dof for _, test in self._tests)
        return bool(dof > 0 and nis > chdtri(dof, BY_CHANCE))
