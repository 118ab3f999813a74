"""By what factor the variance of an IMU's noise exceeds the stated one, estimated from the corrections by the tracks.

The correction of the present state should have the covariance by which the update reduces the state's covariance. The
gate cannot test this. Stamps that are some milliseconds off, an optimistic data sheet or a scale error of the camera
affect all tracks of a frame, each by so little that it passes the gate, and the NIS stays near one per degree of
freedom while the state jumps by many of its sigmas. Biases and tilt, which are otherwise unobserved, absorb most of the
correction, and the error in the direction of gravity then persists.

So the variance of the motion's noise is matched to the corrections ("covariance matching": Mehra 1972, "Approaches to
adaptive filtering"; for process noise Mohamed & Schwarz 1999, "Adaptive Kalman filtering for INS/GPS"), and is never
below the stated one. Matching begins where the corrections of a window add up to a value that has a probability of one
in a million under the stated noise: a consistent filter gives bit-identical answers with and without it.
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

# Probability that the corrections in a window of a consistent filter are beyond the bound.
BY_CHANCE = 1e-6
# Largest factor on the variance: an IMU whose errors are a hundred times the stated ones has another fault, which the
# run's status reports.
_MOST = 1e4
# A smaller factor rounds to 1.0 times the stated noise and is not logged.
_LEAST_REPORTED = 1.05


# Tests the correction of a belief by measurements.
Test = Callable[[Belief, Belief], CorrectionTest]


class MatchedNoise:
    """Matches the variance of an IMU's white noise to the corrections of the latest ``window_s`` seconds."""

    def __init__(self, window_s: float, matches: bool = True, test: Test = correction_test) -> None:
        self._window_ns, self._matches, self._test = round(window_s * NS_PER_S), matches, test
        self._scales, self._applied = [1.0], 1.0
        self._tests: list[tuple[int, CorrectionTest]] = []

    @classmethod
    def of(cls, setup: Setup, test: Test = correction_test) -> Self:
        """Return the matched noise of an estimator. That of twists stays: it is estimated from their own scatter."""
        kind, settings = setup.motion_kind, setup.settings
        return cls(settings.window.seconds(kind), settings.noise.match_imu and kind == "imu", test)

    @property
    def scale(self) -> float:
        """Return the present factor on the stated variance of the motion."""
        return self._scales[-1]

    @property
    def info(self) -> dict[str, float]:
        """Return the factor applied to the latest packet's motion, under its key in an Estimate's info."""
        return {"motion_noise_scale": self._applied}

    @property
    def messages(self) -> tuple[str, ...]:
        """Return a log line if the noise was scaled up, else nothing."""
        most, usual = np.sqrt([max(self._scales), np.median(self._scales)])
        if most < _LEAST_REPORTED:
            return ()
        return (
            f"the tracks contradict the IMU: its noise was assumed up to {most:.1f} times as large as stated "
            f"({usual:.1f} at the median); check stamps, calibration and the stated noise",
        )

    def applied(self, packet: Packet) -> Packet:
        """Return a packet whose motion has the matched noise."""
        self._applied = self.scale
        if self.scale == 1.0 or packet.motion is None:
            return packet
        return replace(packet, motion=with_noise_scaled(packet.motion, self.scale))

    def learn(self, t_ns: int, predicted: Belief, corrected: Belief) -> None:
        """Add the test of a frame's correction, from the predicted to the corrected belief."""
        if self._matches:
            self.take(t_ns, self._test(predicted, corrected))

    def take(self, t_ns: int, test: CorrectionTest) -> None:
        """Add the test of one more frame.

        Once it differs from 1, each frame multiplies the scale by ``1 + w (NIS / dof - 1)``, w being the weight of the
        latest value in an exponential mean over a window's frames; it stays between 1 and its largest value.
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
