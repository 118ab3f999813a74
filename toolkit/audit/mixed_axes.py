"""Motion samples and extrinsic that follow different conventions for the axes of the body, or for its direction.

The camera's own motion, taken through the extrinsic, must be the measured motion. Of the 24 right-handed ways
to name three axes, and the inverse of the extrinsic, the one that explains the samples best is found; if it is not
the recording's own, and the difference is beyond doubt, the extrinsic is turned to it, or inverted. A gyro bias does
not matter here: the median is off.

The rotations alone must not speak against it, over all ways to exchange and negate three channels: where they do, some
channels are wrong and not the extrinsic, and nothing is repaired. Velocities alone decide nothing: cars slip sideways,
against the signs of the small components.
"""

import itertools
import math
from dataclasses import replace

import numpy as np

from toolkit.audit.fault import Evidence, Fault, Symptom, Undecided
from toolkit.audit.parts.intervals import Intervals, median_one_step_px
from toolkit.audit.parts.robust import spread
from toolkit.geometry import Array, se3, se3_inverse

# Mean difference of two explanations in its own standard errors: a doubt about the file as given must be far
# beyond chance (intervals are correlated over about a second), a choice among repairs only beyond chance.
AGAINST_GIVEN = 8.0
AGAINST_SECOND = 4.0
# What the camera's own rotation (rad/s) and velocity (m/s) of one interval are good for.
LEAST_SPREAD_W = 0.003
LEAST_SPREAD_V = 0.05
_OWN = "x, y, z"


def check(evidence: Evidence) -> Symptom | Undecided | None:
    """Find the extrinsic with which samples and camera agree; take it where it is not the given one."""
    if evidence.intervals is None:
        return evidence.blind
    given, turns = evidence.sequence.rig.T_imu_cam, _right_handed_axes()
    candidates = np.concatenate([se3(turns, np.zeros(3)) @ given, se3_inverse(given)[None]])  # the first is the given
    costs = _costs(evidence.intervals, candidates)  # (25, M)
    first, second = np.argsort(costs.mean(axis=1))[:2]
    if _of_rotations(evidence.intervals, candidates[first]) != _OWN:
        alone = _of_rotations(evidence.intervals, given)
        return Symptom(
            count=1,
            detail=f"by the rotations alone the gyro's x, y, z are the extrinsic's {alone}, which no turn makes of all",
            treatment="channels of the samples are exchanged or have the wrong sign, and not all alike: set them right",
            remedy=None,
        )
    if first == 0 and (certainty := _sigmas(costs[second] - costs[0])) < AGAINST_SECOND:
        return Undecided(
            f"{_named(turns, second)} explains the motion as well as what is given ({certainty:.1f} sigma)"
        )
    if first == 0:
        return None
    if (certainty := _sigmas(costs[0] - costs[first])) < AGAINST_GIVEN:
        return Undecided(
            f"{_named(turns, first)} explains the motion better than what is given, by {certainty:.1f} sigma"
        )
    certain = _sigmas(costs[second] - costs[first]) > AGAINST_SECOND
    remedy = replace(evidence.sequence, rig=replace(evidence.sequence.rig, T_imu_cam=candidates[first]))
    return Symptom(
        count=1,
        detail=f"{_explained(turns, first)}: {_residuals(evidence, candidates[first])} {_done(turns, first)}",
        treatment=_treatment(turns, first) if certain else f"{_named(turns, second)} explains it as well: choose one",
        remedy=remedy if certain else None,
    )


def _right_handed_axes() -> Array:
    """Return the rotations (24, 3, 3) that map axes to axes, the identity first."""
    signed = _signed_axes()
    return np.asarray(signed[np.linalg.det(signed) > 0.0])


def _signed_axes() -> Array:
    """Return the matrices (48, 3, 3) that exchange and negate axes, the identity first."""
    return np.stack(
        [
            np.eye(3)[list(order)] * np.array(signs)[:, None]
            for order in itertools.permutations(range(3))
            for signs in itertools.product((1.0, -1.0), repeat=3)
        ]
    )


def _of_rotations(intervals: Intervals, T_imu_cam: Array) -> str:
    """Name the axes of an extrinsic that the gyro's channels are: its own ones, but where others are beyond doubt."""
    signed, w_imu = _signed_axes(), intervals.w_cam_radps @ T_imu_cam[:3, :3].T
    costs = _cauchy(intervals.w_radps - w_imu @ signed.swapaxes(1, 2), LEAST_SPREAD_W)
    best = int(np.argmin(costs.mean(axis=1)))
    return _axes_named(signed[best]) if _sigmas(costs[0] - costs[best]) > AGAINST_SECOND else _OWN


def _costs(intervals: Intervals, candidates: Array) -> Array:
    """Return how badly each extrinsic (C, 4, 4) explains each interval (C, M): a Cauchy log-likelihood."""
    R_cam_imu = np.swapaxes(candidates[:, :3, :3], 1, 2)
    w_imu = intervals.w_cam_radps @ R_cam_imu  # (C, M, 3)
    costs = _cauchy(intervals.w_radps - w_imu, LEAST_SPREAD_W)
    if intervals.v_mps is not None:
        v_imu = intervals.v_cam_mps @ R_cam_imu - np.cross(w_imu, candidates[:, None, :3, 3])
        costs = costs + _cauchy(intervals.v_mps - v_imu, LEAST_SPREAD_V)
    return costs


def _cauchy(residuals: Array, least_spread: float) -> Array:
    """Return log(1 + r^2) (C, M) of residuals (C, M, 3) about their medians, in spreads of the best candidate."""
    centred = residuals - np.median(residuals, axis=1, keepdims=True)
    spreads = np.stack([spread(r) for r in residuals])
    best = spreads[np.argmin(np.sum(spreads**2, axis=1))]
    costs: Array = np.log1p(np.sum((centred / np.maximum(best, least_spread)) ** 2, axis=2))
    return costs


def _sigmas(difference: Array) -> float:
    """Return the mean of differences (M,) in standard errors of that mean."""
    error = float(np.std(difference)) / math.sqrt(difference.size)
    return float(np.mean(difference)) / max(error, 1e-12)


def _named(turns: Array, candidate: int) -> str:
    """Name a candidate: the axes that the new x, y and z are, for example "x, -y, -z", or the inverse."""
    if candidate == len(turns):
        return "the inverse of the extrinsic"
    return _axes_named(turns[candidate])


def _axes_named(turn: Array) -> str:
    largest = np.argmax(np.abs(turn), axis=1)
    return ", ".join(("-" if turn[row, axis] < 0 else "") + "xyz"[axis] for row, axis in enumerate(largest))


def _explained(turns: Array, candidate: int) -> str:
    if candidate == len(turns):
        return "T_imu_cam is inverted, from the IMU to the camera"
    return f"the motion samples' axes are the extrinsic's {_named(turns, candidate)}"


def _treatment(turns: Array, candidate: int) -> str:
    done = f"the extrinsic is {_done(turns, candidate)}"
    return done if candidate == len(turns) else f"{done} to the samples' axes"


def _done(turns: Array, candidate: int) -> str:
    return "inverted" if candidate == len(turns) else "turned"


def _residuals(evidence: Evidence, T_imu_cam: Array) -> str:
    """Return the change of the one-step stereo reprojection as text."""
    sequence, camera = evidence.sequence, evidence.camera_motion
    given_px, now_px = (median_one_step_px(sequence, camera, T) for T in (sequence.rig.T_imu_cam, T_imu_cam))
    return f"median one-step reprojection {given_px:.2f} px as given, {now_px:.2f} px"


FAULT = Fault(
    "mixed-axes",
    "motion samples and camera extrinsic in different axes, or an inverted extrinsic",
    check,
    after=("extrinsic-convention",),
)
