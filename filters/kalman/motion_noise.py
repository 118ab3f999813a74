"""How many times its stated noise the measured motion has, by what the tracks have to correct from frame to frame.

The correction of the state now has the covariance it takes away. A gate cannot test this: what stamps that are some
milliseconds off, an optimistic data sheet or a scale error of the camera do to all tracks of a frame, each track has so
little of that it passes, and the NIS of all rows stays near one while the state jumps by many of its sigmas. Biases and
tilt take most of it, which nothing else measures: gravity is then turned for good.

So the variance of the motion's noise is matched to the corrections ("covariance matching": Mehra 1972, "Approaches to
adaptive filtering"; for process noise Mohamed & Schwarz 1999, "Adaptive Kalman filtering for INS/GPS"), never below
what is stated. It begins where a correction is one that chance makes once in a million: a sound filter stays, to the
bit, what it is without.
"""

from typing import NamedTuple

import numpy as np
from scipy.special import chdtri

from toolkit.geometry import Array, se3_inverse, se3_log
from toolkit.models.state import POSE, Belief

# A correction beyond this quantile happens once in a million of a sound filter's frames.
BY_CHANCE = 1e-6
# Directions in which a correction takes away less of the variance than this are told by rounding.
_LEAST_TAKEN = 1e-6


class CorrectionTest(NamedTuple):
    """The squared Mahalanobis length of a correction and its degrees of freedom: of what was corrected at all."""

    nis: float
    dof: int


def correction_test(before: Belief, after: Belief) -> CorrectionTest:
    """Test what measurements made of a belief against the covariance that they took away."""
    sigma = np.sqrt(np.diag(before.cov))
    per_sigma = 1.0 / np.where(sigma > 0.0, sigma, np.inf)
    taken = per_sigma[:, None] * (before.cov - after.cov) * per_sigma
    shares, axes = np.linalg.eigh(taken)
    told = shares > _LEAST_TAKEN
    moved = axes[:, told].T @ (per_sigma * _change(before, after))
    return CorrectionTest(float((moved**2 / shares[told]).sum()), int(told.sum()))


class MatchedNoise:
    """Matches the scale of the motion's variance to the corrections of so many latest frames as a window has."""

    def __init__(self) -> None:
        self._scales = [1.0]
        self._tests: list[CorrectionTest] = []

    @property
    def scale(self) -> float:
        """Return how many times the stated variance that of the motion is taken for."""
        return self._scales[-1]

    @property
    def told(self) -> tuple[str, ...]:
        """Return what a user should know, a line, where the stated noise did not hold."""
        if max(self._scales) == 1.0:
            return ()
        most, usual = np.sqrt([max(self._scales), np.median(self._scales)])
        return (
            f"the tracks contradict the IMU by more than chance allows: its noise was taken for up to {most:.1f} times "
            f"what is stated ({usual:.1f} at the median); stamps, calibration or the stated noise may not hold",
        )

    def learn(self, test: CorrectionTest, frames: int) -> None:
        """Take in the correction of one more frame by tracks of so many.

        The scale follows the ratio of NIS to degrees of freedom as an exponential mean over so many frames does.
        """
        self._tests = [*self._tests, test][-frames:]
        scale = self.scale
        if scale > 1.0 or self._beyond_chance():
            scale = max(1.0, scale * (1.0 + 2.0 / (frames + 1.0) * (test.nis / max(test.dof, 1) - 1.0)))
        self._scales.append(scale)

    def _beyond_chance(self) -> bool:
        nis, dof = np.sum(self._tests, axis=0)
        return bool(dof > 0 and nis > chdtri(dof, BY_CHANCE))


def _change(before: Belief, after: Belief) -> Array:
    """Return the error (d,) by which a belief was moved."""
    change, layout = np.empty(before.layout.size), before.layout
    change[POSE] = se3_log(se3_inverse(before.T_world_imu) @ after.T_world_imu)
    if layout.velocity is not None:
        change[layout.velocity] = before.T_world_imu[:3, :3].T @ (after.v_world - before.v_world)
    if layout.accel_bias is not None:
        change[layout.accel_bias] = after.bias[:3] - before.bias[:3]
    change[layout.gyro_bias] = after.bias[3:] - before.bias[3:]
    return change
