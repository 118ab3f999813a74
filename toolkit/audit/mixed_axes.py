"""Motion samples and extrinsic that follow different conventions for the axes of the body.

The camera's own motion, taken through the extrinsic, must be the measured motion. Of the 24 right-handed ways
to name three axes, the one that explains the samples best is found; if it is not the recording's own, and the
difference is beyond doubt, the extrinsic is turned to it. A gyro bias does not matter here: the median is off.
"""

import itertools
import math
from dataclasses import replace

import numpy as np

from toolkit.audit.fault import Evidence, Fault, Symptom
from toolkit.audit.parts.intervals import Intervals, median_one_step_px
from toolkit.audit.parts.robust import spread
from toolkit.geometry import Array, se3
from toolkit.sequence import Sequence

# Mean difference of two explanations in its own standard errors: a doubt about the file as given must be far
# beyond chance (intervals are correlated over about a second), a choice among repairs only beyond chance.
AGAINST_GIVEN = 8.0
AGAINST_SECOND = 4.0
# What the camera's own rotation (rad/s) and velocity (m/s) of one interval are good for.
LEAST_SPREAD_W = 0.003
LEAST_SPREAD_V = 0.05


def check(evidence: Evidence) -> Symptom | None:
    """Find the axes in which samples and camera agree; turn the extrinsic where they are not the given ones."""
    if evidence.intervals is None:
        return None
    sequence, turns = evidence.sequence, _right_handed_axes()
    costs = _costs(evidence.intervals, sequence.rig.T_imu_cam, turns)  # (24, M); the first turn is none
    first, second = np.argsort(costs.mean(axis=1))[:2]
    if first == 0 or _sigmas(costs[0] - costs[first]) < AGAINST_GIVEN:
        return None
    T_imu_cam = se3(turns[first], np.zeros(3)) @ sequence.rig.T_imu_cam
    axes = _named(turns[first])
    certain = _sigmas(costs[second] - costs[first]) > AGAINST_SECOND
    return Symptom(
        count=1,
        detail=f"the motion samples' axes are the extrinsic's {axes}{_reprojections(sequence, T_imu_cam)}",
        treatment="the extrinsic is turned to the samples' axes" if certain else "two turns explain it: choose one",
        remedy=replace(sequence, rig=replace(sequence.rig, T_imu_cam=T_imu_cam)) if certain else None,
    )


def _right_handed_axes() -> Array:
    """Return the rotations (24, 3, 3) that map axes to axes, the identity first."""
    signed = (
        np.eye(3)[list(order)] * np.array(signs)[:, None]
        for order in itertools.permutations(range(3))
        for signs in itertools.product((1.0, -1.0), repeat=3)
    )
    return np.stack([turn for turn in signed if np.linalg.det(turn) > 0.0])


def _costs(intervals: Intervals, T_imu_cam: Array, turns: Array) -> Array:
    """Return how badly each turn explains each interval (24, M): a Cauchy log-likelihood of its residuals."""
    w_imu = intervals.w_cam_radps @ T_imu_cam[:3, :3].T
    v_imu = intervals.v_cam_mps @ T_imu_cam[:3, :3].T - np.cross(w_imu, T_imu_cam[:3, 3])
    costs = _cauchy(intervals.w_radps - w_imu @ np.swapaxes(turns, 1, 2), LEAST_SPREAD_W)
    if intervals.v_mps is not None:
        costs = costs + _cauchy(intervals.v_mps - v_imu @ np.swapaxes(turns, 1, 2), LEAST_SPREAD_V)
    return costs


def _cauchy(residuals: Array, least_spread: float) -> Array:
    """Return log(1 + r^2) (24, M) of residuals (24, M, 3) about their medians, in spreads of the best turn."""
    centred = residuals - np.median(residuals, axis=1, keepdims=True)
    spreads = np.stack([spread(r) for r in residuals])
    best = spreads[np.argmin(np.sum(spreads**2, axis=1))]
    costs: Array = np.log1p(np.sum((centred / np.maximum(best, least_spread)) ** 2, axis=2))
    return costs


def _sigmas(difference: Array) -> float:
    """Return the mean of differences (M,) in standard errors of that mean."""
    error = float(np.std(difference)) / math.sqrt(difference.size)
    return float(np.mean(difference)) / max(error, 1e-12)


def _named(turn: Array) -> str:
    """Write a turn as the axes the new x, y and z are, for example "x, -y, -z"."""
    largest = np.argmax(np.abs(turn), axis=1)
    return ", ".join(("-" if turn[row, axis] < 0 else "") + "xyz"[axis] for row, axis in enumerate(largest))


def _reprojections(sequence: Sequence, T_imu_cam: Array) -> str:
    """Return the change of the one-step stereo reprojection as text, or "" without velocities to compute it."""
    if sequence.motion_kind == "imu":
        return ""
    given_px, turned_px = (median_one_step_px(sequence, T) for T in (sequence.rig.T_imu_cam, T_imu_cam))
    return f": median one-step reprojection {given_px:.2f} px as given, {turned_px:.2f} px turned"


FAULT = Fault(
    "mixed-axes",
    "motion samples and camera extrinsic in different axes",
    check,
    after=("stale-frames", "doubled-disparity", "no-disparity", "not-finite", "time-gap"),
)
