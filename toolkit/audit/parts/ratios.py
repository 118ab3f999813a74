"""Ratios of one motion by two sources, and the factors of the units that such ratios show.

The ratios are those of the samples' speeds and rates of rotation to the camera's, and of specific force to gravity.
"""

import numpy as np

from toolkit.audit.parts.intervals import Intervals
from toolkit.audit.parts.robust import Scalar, median_error
from toolkit.geometry import Array, IntArray
from toolkit.measured_motion import ImuSamples
from toolkit.models.noise import white_sigma
from toolkit.resampling import NS_PER_S
from toolkit.sequence import Sequence

# Largest ratios, of speeds and rates of rotation and of specific force, that an error of a scale explains; beyond them
# there is a `disagreement`. Sound recordings have ratios of speeds of 0.96 to 1.02.
MOST_RATIO, MOST_FORCE_RATIO = 1.25, 1.5
# Factors of units. Those of mg and cm/s^2 differ by 2 %, too little to name one of them.
SPEEDS = {"km/h": 3.6, "ft/s": 3.281, "mph": 2.237, "cm/s": 100.0, "mm/s": 1000.0}
RATES = {"deg/s": 180.0 / np.pi}
FORCES = {"g": 1.0 / 9.80665, "mg": 1000.0 / 9.80665, "cm/s^2": 100.0, "mm/s^2": 1000.0}
# A stated noise of this share of the samples' own scatter, or more, was estimated from them and is in their unit.
FROM_SCATTER = 0.5


def rotation_ratio(intervals: Intervals) -> Scalar:
    """Return the ratio of the samples' rates of rotation to the camera's, independent of their axes.

    It is the scale of the similarity between the rates less their medians (Umeyama 1991, eqs. 39-42), which the noise
    of the samples does not bias.
    """
    measured, seen = (w - np.median(w, axis=0) for w in (intervals.w_radps, intervals.w_cam_radps))
    left, singular, right = np.linalg.svd(measured.T @ seen)
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(left @ right))])
    total = float(np.sum(seen**2))
    if not total > 0.0:
        return Scalar(1.0, np.inf)
    turned, scale = seen @ (left * signs @ right).T, float(singular @ signs) / total
    moment = np.sum(turned * (measured - scale * turned), axis=1)
    return Scalar(scale, float(np.sqrt(np.sum(moment**2))) / total)


def speed_ratio(intervals: Intervals | None) -> Scalar | None:
    """Return the ratio of the samples' speeds to the camera's; None where the samples have none."""
    if intervals is None or intervals.v_mps is None:
        return None
    return ratio_of_speeds(intervals.v_mps, intervals.v_cam_mps)


def ratio_of_speeds(one: Array, other: Array) -> Scalar | None:
    """Return the median ratio of the norms of velocities (M, 3), over the faster half, where noise matters least."""
    speed = np.linalg.norm(other, axis=1)
    fast = (speed > 0.0) & (speed >= np.median(speed)) if speed.size else np.zeros(0, dtype=bool)
    if fast.sum() < 2:
        return None
    ratio = (np.linalg.norm(one[fast], axis=1) / speed[fast])[:, None]
    return Scalar(float(np.median(ratio)), float(median_error(ratio)[0]))


def force_ratio(sequence: Sequence) -> Scalar | None:
    """Return the median ratio of the norm of the specific force to gravity; None for twists."""
    if not isinstance(sequence.motion, ImuSamples) or not sequence.motion.t_ns.size:
        return None
    ratio = np.linalg.norm(sequence.motion.accel_mps2, axis=1)[:, None] / np.linalg.norm(sequence.gravity_world)
    return Scalar(float(np.median(ratio)), float(median_error(ratio)[0]))


def is_from_scatter(density: Array, values: Array, t_ns: IntArray) -> bool:
    """Say whether a density (3,) of white noise looks as if estimated from the scatter of the samples (S, 3)."""
    root_dt = np.sqrt(np.median(np.diff(t_ns)) / NS_PER_S)
    return bool((density > FROM_SCATTER * white_sigma(values) * root_dt).all())
