"""The factor on the motion's white noise, from how well the motion samples fit adjusted stretches.

It is the most likely one given the residuals (restricted likelihood: Patterson & Thompson 1971, "Recovery of
inter-block information when block sizes are unequal"). With |r|^2 the squared residuals of the motion at a solution, t
their expectation and s the squared norm of their covariance (:class:`~toolkit.noise.stretches.MotionFit`), a step of
Fisher's scoring multiplies the variance by ``1 + (|r|^2 - t) / s``; it has the relative variance 2 / s.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from toolkit.noise.stretches import MotionFit

# The stated noise is kept unless the residuals exceed it by this many standard deviations, and the factor found does
# too: chance does once in a thousand.
_STANDARD_ERRORS = 3.0
# A step changes the variance at most by this factor, because a linear step from far off overshoots. The scoring ends
# where a step is a small part of a standard error.
_LARGEST_STEP, _SMALL, _MOST_STEPS = 4.0, 0.3, 8
# Largest factor: a motion whose errors are a hundred times the stated ones has another fault, which the audit names.
_MOST = 100.0


@dataclass(frozen=True)
class MotionScale:
    """The factor on the standard deviations of the motion's white noise, with its standard error.

    ``ratio`` is that of the squared residuals to their expectation by the stated noise.
    """

    value: float = 1.0
    error: float = 0.0
    ratio: float = 1.0


def motion_scale(fit: Callable[[float], MotionFit]) -> MotionScale:
    """Return the factor by the fit of the motion samples under the stated noise times a factor.

    Where a step leaves no stretch that could be adjusted, the fit says nothing and the stated noise is kept.
    """
    squares, expected, spread = fit(1.0)
    ratio = squares / expected if expected > 0.0 else 1.0
    if spread <= 0.0 or squares - expected <= _STANDARD_ERRORS * np.sqrt(2.0 * spread):
        return MotionScale(ratio=ratio)
    variance = 1.0
    for _ in range(_MOST_STEPS):
        step = float(np.clip(1.0 + (squares - expected) / spread, 1.0 / _LARGEST_STEP, _LARGEST_STEP))
        variance = float(np.clip(variance * step, 1.0, _MOST**2))
        squares, expected, spread = fit(variance**0.5)
        if spread <= 0.0:
            return MotionScale(ratio=ratio)
        if abs(squares - expected) < _SMALL * np.sqrt(2.0 * spread):
            break
    error = variance * float(np.sqrt(2.0 / spread))
    if variance - 1.0 < _STANDARD_ERRORS * error:
        return MotionScale(ratio=ratio)
    value = float(np.sqrt(variance))
    return MotionScale(value, 0.5 * error / value, ratio)
