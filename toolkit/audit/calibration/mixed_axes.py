"""Motion samples and extrinsic with different conventions of axes, or an extrinsic in the inverse direction.

The camera's own motion, transformed by the extrinsic, must equal the measured motion. Three axes have 24 right-handed
conventions. If the body's axes follow another one, the whole extrinsic is rotated; if the camera's do, the camera is
rotated at its position. All of these and the inverse of the extrinsic are compared. The one that explains the samples
best is taken if it is not the given one and is better beyond doubt. Turns of the vehicle decide between two possible
positions of the camera, or the finding says that they do not. Medians are subtracted, so a gyro bias has no effect.

A convention is taken only if the rotations alone do not contradict it, among all 48 ways to exchange and negate three
channels. Where they do, channels of the samples are wrong and not the extrinsic, and nothing is repaired. Velocities
alone decide nothing, because cars slip sideways, which changes the signs of the small components.
"""

from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np

from toolkit.audit.fault import Evidence, Fault, Symptom, Undecided
from toolkit.audit.parts.alignment import alignment
from toolkit.audit.parts.axes import MIRRORED, axes_named, right_handed_axes, signed_axes
from toolkit.audit.parts.extrinsic import is_excluded, is_there, metres, way_gone
from toolkit.audit.parts.intervals import Intervals
from toolkit.audit.parts.one_step import median_one_step_px
from toolkit.audit.parts.robust import LEAST_SPREAD_V, LEAST_SPREAD_W, cauchy, mean_in_sigmas
from toolkit.geometry import Array, se3, se3_inverse

# Least mean difference of the costs of two readings, in its own standard errors. To reject the file as given it must be
# far beyond chance (intervals are correlated over about a second), to choose among repairs only beyond chance.
AGAINST_GIVEN = 8.0
AGAINST_SECOND = 4.0
# Two readings look the same way if their cameras differ by less than this angle.
SAME_WAY_RAD = 0.2
# Positions nearer than this to each other are taken as one.
NEAR_M = 0.01
_OWN = "x, y, z"


class ExtrinsicConvention(NamedTuple):
    """An extrinsic (4, 4) under another convention than the given one.

    ``name`` is the convention, ``cause`` says what is wrong with the given extrinsic, and ``done`` what is done to it.
    ``other_m`` (3,) is the other possible position of the camera: a rotation of the body's axes also rotates the
    position, unless that was measured in the right axes; a rotation of the camera's axes does not.
    """

    T_imu_cam: Array
    name: str
    cause: str
    done: str
    other_m: Array


def check(evidence: Evidence) -> Symptom | Undecided | None:
    """Find the extrinsic under which samples and camera agree; take it where it is not the given one."""
    if evidence.intervals is None:
        return evidence.blind
    given = evidence.sequence.rig.T_imu_cam
    readings = _readings(given)  # the first is the given
    costs = _costs(evidence.intervals, np.stack([one.T_imu_cam for one in readings]))  # (R, M)
    first, second = _best_two(readings, costs)
    better, alone = mean_in_sigmas(costs[0] - costs[first]), _of_rotations(evidence.intervals, given)
    at_odds = _of_rotations(evidence.intervals, readings[first].T_imu_cam) != _OWN
    if at_odds and (alone != _OWN or better > AGAINST_GIVEN):
        return _exchanged(alone)
    if first == 0 and (certainty := mean_in_sigmas(costs[second] - costs[0])) < AGAINST_SECOND:
        return Undecided(
            f"{readings[second].name} explains the motion as well as what is given ({certainty:.1f} sigma)"
        )
    if first == 0:
        return None
    if better < AGAINST_GIVEN:
        return Undecided(f"{readings[first].name} explains the motion better than what is given, by {better:.1f} sigma")
    certain = mean_in_sigmas(costs[second] - costs[first]) > AGAINST_SECOND
    taken, doubt = _settled(evidence, evidence.intervals, [readings[k] for k in _twins(readings, first)])
    remedy = replace(evidence.sequence, rig=replace(evidence.sequence.rig, T_imu_cam=taken.T_imu_cam))
    return Symptom(
        count=1,
        detail=f"{taken.cause}: {_residuals(evidence, taken.T_imu_cam)} then{doubt}",
        treatment=taken.done if certain else f"{readings[second].name} explains it as well: choose one",
        remedy=remedy if certain else None,
        spoils_vision=not certain,
    )


def _exchanged(alone: str) -> Symptom:
    if alone == _OWN:
        return Symptom(
            count=1,
            detail="the gyro agrees with the camera and the velocities do not, so no rotation of both corrects them",
            treatment=f"the velocities' channels are exchanged or have the wrong sign: correct them{MIRRORED}",
            remedy=None,
        )
    return Symptom(
        count=1,
        detail=f"by the rotations alone the gyro's x, y, z are the extrinsic's {alone}, so no rotation corrects all",
        treatment=f"channels of the samples are exchanged or have the wrong sign: correct them{MIRRORED}",
        remedy=None,
        spoils_vision=True,
    )


def _readings(given: Array) -> tuple[ExtrinsicConvention, ...]:
    """Return the extrinsic in all conventions: as given, with other axes of the body, of the camera, and inverted."""
    place_m, turns = given[:3, 3], [se3(turn, np.zeros(3)) for turn in right_handed_axes()[1:]]
    as_given = ExtrinsicConvention(given, _OWN, "", "", place_m)
    return (as_given, *map(partial(_of_body, given), turns), *map(partial(_of_camera, given), turns), _inverse(given))


def _of_body(given: Array, turn: Array) -> ExtrinsicConvention:
    axes = axes_named(turn[:3, :3])
    cause = f"the motion samples' axes are the extrinsic's {axes}"
    return ExtrinsicConvention(turn @ given, axes, cause, "the extrinsic is rotated to the samples' axes", given[:3, 3])


def _of_camera(given: Array, turn: Array) -> ExtrinsicConvention:
    axes = axes_named(turn[:3, :3].T)
    cause, place_m = f"the camera's axes are the extrinsic's {axes}", given[:3, :3] @ turn[:3, :3] @ given[:3, :3].T
    done = "the camera's rotation is corrected, its position is kept"
    return ExtrinsicConvention(given @ turn, f"the camera's {axes}", cause, done, place_m @ given[:3, 3])


def _inverse(given: Array) -> ExtrinsicConvention:
    T_imu_cam, cause = se3_inverse(given), "T_imu_cam is inverted, from the IMU to the camera"
    return ExtrinsicConvention(
        T_imu_cam, "the inverse of the extrinsic", cause, "the extrinsic is inverted", T_imu_cam[:3, 3]
    )


def _best_two(readings: tuple[ExtrinsicConvention, ...], costs: Array) -> tuple[int, int]:
    """Return the best reading, and the best among those under which the camera looks another way."""
    order = [int(k) for k in np.argsort(costs.mean(axis=1))]
    twins = _twins(readings, order[0])
    return order[0], next(k for k in order if k not in twins)


def _twins(readings: tuple[ExtrinsicConvention, ...], one: int) -> list[int]:
    """Return the readings under which the camera looks the same way as under one, which is among them.

    A rotation of the camera's axes and one of the body's can be such a pair. The given extrinsic and its inverse have
    none.
    """
    R_imu_cam = np.stack([reading.T_imu_cam[:3, :3] for reading in readings])
    apart_rad = np.linalg.norm(R_imu_cam - R_imu_cam[one], axis=(1, 2)) / np.sqrt(2.0)  # of small angles
    alone = (0, len(readings) - 1)
    return [k for k in range(len(readings)) if k == one or (apart_rad[k] < SAME_WAY_RAD and not {k, one} & {*alone})]


def _settled(
    evidence: Evidence, intervals: Intervals, twins: list[ExtrinsicConvention]
) -> tuple[ExtrinsicConvention, str]:
    """Return the best of readings that look the same way, at the position that turns show, and any doubt in words."""
    costs = _costs(intervals, np.stack([one.T_imu_cam for one in twins])).mean(axis=1)
    place_m, doubt = _placed(evidence, intervals, twins[int(np.argmin(costs))])
    placed = [one._replace(T_imu_cam=se3(one.T_imu_cam[:3, :3], place_m)) for one in twins]
    costs = _costs(intervals, np.stack([one.T_imu_cam for one in placed])).mean(axis=1)
    return placed[int(np.argmin(costs))], doubt


def _placed(evidence: Evidence, intervals: Intervals, reading: ExtrinsicConvention) -> tuple[Array, str]:
    """Return the position (3,) m of a reading's camera, or its other one where turns show that, and doubt in words."""
    here, other = reading.T_imu_cam[:3, 3], reading.other_m
    turned = replace(evidence.sequence, rig=replace(evidence.sequence.rig, T_imu_cam=reading.T_imu_cam))
    found = alignment(turned, evidence.camera_motion, intervals)
    if found is None or np.linalg.norm(other - here) < NEAR_M:
        return here, ""
    share = way_gone(turned, intervals, found, other - here)
    if is_there(share):
        return other, f"; by rotations the camera is at {metres(other)} and not at {metres(here)}"
    if is_excluded(share):
        return here, ""
    return here, (
        f"; too little rotation to decide whether the camera is at {metres(here)}, as assumed, or at {metres(other)}"
    )


def _of_rotations(intervals: Intervals, T_imu_cam: Array) -> str:
    """Name the axes of an extrinsic that the gyro's channels measure: x, y, z unless others are better beyond doubt."""
    signed, w_imu = signed_axes(), intervals.w_cam_radps @ T_imu_cam[:3, :3].T
    costs = cauchy(intervals.w_radps - w_imu @ signed.swapaxes(1, 2), LEAST_SPREAD_W)
    best = int(np.argmin(costs.mean(axis=1)))
    return axes_named(signed[best]) if mean_in_sigmas(costs[0] - costs[best]) > AGAINST_SECOND else _OWN


def _costs(intervals: Intervals, candidates: Array) -> Array:
    """Return the negative Cauchy log-likelihood (C, M) of each interval under each extrinsic (C, 4, 4)."""
    R_cam_imu = np.swapaxes(candidates[:, :3, :3], 1, 2)
    w_imu = intervals.w_cam_radps @ R_cam_imu  # (C, M, 3)
    costs = cauchy(intervals.w_radps - w_imu, LEAST_SPREAD_W)
    if intervals.v_mps is not None:
        v_imu = intervals.v_cam_mps @ R_cam_imu - np.cross(w_imu, candidates[:, None, :3, 3])
        costs = costs + cauchy(intervals.v_mps - v_imu, LEAST_SPREAD_V)
    return costs


def _residuals(evidence: Evidence, T_imu_cam: Array) -> str:
    """Return the change of the one-step stereo reprojection as text."""
    sequence, camera = evidence.sequence, evidence.camera_motion
    given_px, now_px = (median_one_step_px(sequence, camera, T) for T in (sequence.rig.T_imu_cam, T_imu_cam))
    return f"median one-step reprojection {given_px:.2f} px as given, {now_px:.2f} px"


FAULT = Fault(
    "mixed-axes",
    "motion samples and camera extrinsic in different axes, or an inverted extrinsic",
    check,
    after=("extrinsic-convention", "sparse-motion"),
)
