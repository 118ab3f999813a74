"""Conventions that contradict the motion: the extrinsic's direction, axes and translation, channels of the IMU."""

import itertools
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from toolkit.audit.alignment import is_excluded, is_there, metres, way_gone
from toolkit.audit.fault import Evidence, Symptom, Undecided, beside_camera
from toolkit.audit.intervals import Intervals
from toolkit.audit.one_step import median_one_step_px, one_step_px_by_interval
from toolkit.audit.robust import LEAST_SPREAD_V, LEAST_SPREAD_W, Ranking, Scalar, cauchy, ranked, slope
from toolkit.geometry import Array, IntArray, se3, se3_inverse, so3_log
from toolkit.measurements import NS_PER_S
from toolkit.sequence import EXTRINSIC_UNCERTAIN

# A mirror image of the scene reverses the turns about two axes and the motion along the third.
MIRRORED = "; mirrored images have the same effect"


def signed_axes() -> Array:
    """Return the matrices (48, 3, 3) that exchange and negate axes, the identity first."""
    return np.stack(
        [
            np.eye(3)[list(order)] * np.array(signs)[:, None]
            for order in itertools.permutations(range(3))
            for signs in itertools.product((1.0, -1.0), repeat=3)
        ]
    )


def right_handed_axes() -> Array:
    """Return the rotations (24, 3, 3) that map axes to axes, the identity first."""
    signed = signed_axes()
    return np.asarray(signed[np.linalg.det(signed) > 0.0])


def axes_named(turn: Array) -> str:
    """Return in words which axes the rows of a matrix (3, 3) of `signed_axes` pick, for example "y, x, -z"."""
    largest = np.argmax(np.abs(turn), axis=1)
    return ", ".join(("-" if turn[row, axis] < 0 else "") + "xyz"[axis] for row, axis in enumerate(largest))


# Least mean difference of the costs of two candidates, in its own standard errors: to choose among those that a file
# allows, beyond chance (intervals are correlated over about a second), and far beyond to reject the file as given.
AGAINST_SECOND, AGAINST_GIVEN = 4.0, 8.0
# Two readings look the same way if their cameras differ by less than this angle. The noise of the samples, which the
# lever arm turns into motion of the camera, then changes the residuals more than the choice of the reading.
SAME_READING_RAD = 0.05
# Largest standard error of the share between two readings: two of them reach from either reading to the middle.
LARGEST_ERROR = 0.25
# From optical axes (right, down, forward) to regular ones (forward, left, up).
_T_REGULAR_OPTICAL = se3(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]), np.zeros(3))


def extrinsic_convention(evidence: Evidence) -> Symptom | Undecided | None:
    """Take the one of four readings of an extrinsic, which its format leaves open, that the tracks follow.

    It may be inverted, with camera axes right, down, forward (optical) or forward, left, up (regular). Points moved by
    the samples have the smallest residuals under the right one; of two that look the same way, turns decide.
    """
    sequence = evidence.sequence
    if EXTRINSIC_UNCERTAIN not in sequence.provenance.facts:
        return None
    if evidence.intervals is None:
        return evidence.blind
    readings, camera = _four_readings(sequence.rig.T_imu_cam), evidence.camera_motion
    misses_px = np.stack([one_step_px_by_interval(sequence, camera, T) for T in readings.values()])
    found, names = ranked(np.log(np.maximum(misses_px, 1e-9))), list(readings)
    first, *others = (names[k] for k in found.order)
    behind = dict(zip(names, found.behind, strict=True))
    as_good = [name for name in others if not behind[name] > AGAINST_SECOND]
    if len(as_good) == len(others):
        return Undecided(f"the tracks fit every reading of the extrinsic equally, best {first} and {as_good[0]}")
    doubt = "".join(f"; {name} explains the motion equally well ({behind[name]:.1f} sigma)" for name in as_good)
    for name in others:
        apart = readings[first][:3, :3].T @ readings[name][:3, :3]
        same_way = np.linalg.norm(so3_log(apart)) < SAME_READING_RAD
        if not (same_way or name in as_good):
            continue
        share = _share(evidence.intervals, readings[first], readings[name])
        if share is not None:
            way = f"{share.value:.2f} +- {share.error:.2f} of the way from {first} to {name}"
            doubt += f"; during rotation the camera's velocity is {way}"
            first = name if share.value > 0.5 else first
        elif same_way:
            unknown = "there is too little rotation to determine the camera's position"
            doubt += f"; {name} has the same orientation, and {unknown}"
    each_px = ", ".join(f"{median_one_step_px(sequence, camera, T):.2f} px {name}" for name, T in readings.items())
    detail, treatment = f"one-step reprojection is {each_px}{doubt}", f"the extrinsic is read {first}"
    facts = (fact for fact in sequence.provenance.facts if fact != EXTRINSIC_UNCERTAIN)
    provenance = replace(sequence.provenance, facts=(*facts, treatment))
    remedy = replace(sequence, rig=replace(sequence.rig, T_imu_cam=readings[first]), provenance=provenance)
    return Symptom(1, detail, treatment, remedy, harmful=first != next(iter(readings)))


def _four_readings(T_imu_cam: Array) -> dict[str, Array]:
    """Return T_imu_cam (4, 4), with optical camera axes, in the four readings of the given one, which is the first."""
    inverse = se3_inverse(T_imu_cam)
    return {
        "as given, camera axes optical": T_imu_cam,
        "as given, camera axes regular": T_imu_cam @ _T_REGULAR_OPTICAL,
        "inverted, camera axes optical": inverse,
        "inverted, camera axes regular": inverse @ _T_REGULAR_OPTICAL,
    }


def _share(intervals: Intervals, T_imu_first: Array, T_imu_other: Array) -> Scalar | None:
    """Return where the measured velocity lies between those that two extrinsics predict: 0 is the first, 1 the other.

    Slip and an error of the rotation are constant and removed; the gyro's rate, whose errors are independent of the
    camera's, is the instrument. None where no velocity is measured, or there is too little rotation.
    """
    if intervals.v_mps is None:
        return None
    readings = [intervals._replace(T_imu_cam=T) for T in (T_imu_first, T_imu_other)]
    one, other = (read.v_seen_mps - np.cross(read.w_seen_radps, read.T_imu_cam[:3, 3]) for read in readings)
    in_turns = -np.cross(intervals.w_radps, T_imu_other[:3, 3] - T_imu_first[:3, 3])
    share = slope(*(x - np.median(x, axis=0) for x in (in_turns, other - one, intervals.v_mps - one)))
    return share if share.error < LARGEST_ERROR else None


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


@beside_camera
def mixed_axes(evidence: Evidence, intervals: Intervals) -> Symptom | Undecided | None:
    """Find the extrinsic under which samples and camera agree, and take it where it is not the given one.

    With other axes of the body the whole extrinsic is rotated, with other axes of the camera that alone. All 24
    conventions of each and the inverse are compared; turns decide between two possible positions. One is taken only if
    the rotations alone, among 48 orders and signs of channels, do not contradict it: else channels are wrong.
    """
    given = evidence.sequence.rig.T_imu_cam
    readings = _readings(given)  # the first is the given
    found = _ranked(intervals, readings)
    first, twins = found.best, _twins(readings, found.best)
    second = next(k for k in found.order if k not in twins)  # the best under which the camera looks another way
    better, alone = found.behind[0], _of_rotations(intervals, given)
    certain = found.behind[second] > AGAINST_SECOND
    at_odds = _of_rotations(intervals, readings[first].T_imu_cam) != _OWN
    if at_odds and (alone != _OWN or better > AGAINST_GIVEN):
        return _exchanged(alone)
    if first == 0 and not certain:
        as_well = f"{readings[second].name} explains the motion as well as what is given"
        return Undecided(f"{as_well} ({found.behind[second]:.1f} sigma)")
    if first == 0:
        return None
    if better < AGAINST_GIVEN:
        return Undecided(f"{readings[first].name} explains the motion better than what is given, by {better:.1f} sigma")
    alike = [readings[k] for k in twins]
    place_m, doubt = _placed(evidence, intervals, alike[_ranked(intervals, alike).best])
    placed = [one._replace(T_imu_cam=se3(one.T_imu_cam[:3, :3], place_m)) for one in alike]
    taken = placed[_ranked(intervals, placed).best]
    remedy = replace(evidence.sequence, rig=replace(evidence.sequence.rig, T_imu_cam=taken.T_imu_cam))
    both = given, taken.T_imu_cam
    given_px, now_px = (median_one_step_px(evidence.sequence, evidence.camera_motion, T) for T in both)
    residuals = f"median one-step reprojection {given_px:.2f} px as given, {now_px:.2f} px corrected"
    treatment = taken.done if certain else f"{readings[second].name} explains it as well: choose one"
    detail = f"{taken.cause}: {residuals}{doubt}"
    return Symptom(1, detail, treatment, remedy if certain else None, spoils_vision=not certain)


def _exchanged(alone: str) -> Symptom:
    wrong = f"channels are exchanged or have the wrong sign: correct them{MIRRORED}"
    if alone == _OWN:
        detail = "the gyro agrees with the camera and the velocities do not, so no rotation of both corrects them"
        return Symptom(1, detail, f"the velocities' {wrong}", remedy=None)
    detail = f"by the rotations alone the gyro's x, y, z are the extrinsic's {alone}, so no rotation corrects all"
    return Symptom(1, detail, f"the samples' {wrong}", remedy=None, spoils_vision=True)


def _readings(given: Array) -> list[ExtrinsicConvention]:
    place_m, turns, inverse = given[:3, 3], right_handed_axes()[1:], se3_inverse(given)
    found = [ExtrinsicConvention(given, _OWN, "", "", place_m)]
    for turn in turns:
        axes, done = axes_named(turn), "the extrinsic is rotated to the samples' axes"
        cause, T_imu_cam = f"the motion samples' axes are the extrinsic's {axes}", se3(turn, np.zeros(3)) @ given
        found.append(ExtrinsicConvention(T_imu_cam, axes, cause, done, place_m))
    for turn in turns:
        axes, done = axes_named(turn.T), "the camera's rotation is corrected, its position is kept"
        cause, T_imu_cam = f"the camera's axes are the extrinsic's {axes}", given @ se3(turn, np.zeros(3))
        elsewhere_m = T_imu_cam[:3, :3] @ given[:3, :3].T @ place_m
        found.append(ExtrinsicConvention(T_imu_cam, f"the camera's {axes}", cause, done, elsewhere_m))
    name, cause = "the inverse of the extrinsic", "T_imu_cam is inverted, from the IMU to the camera"
    return [*found, ExtrinsicConvention(inverse, name, cause, "the extrinsic is inverted", inverse[:3, 3])]


def _twins(readings: list[ExtrinsicConvention], one: int) -> list[int]:
    """Return the readings under which the camera looks the same way as under one: two rotations, of body and camera."""
    R_imu_cam = np.stack([reading.T_imu_cam[:3, :3] for reading in readings])
    apart_rad = np.linalg.norm(R_imu_cam - R_imu_cam[one], axis=(1, 2)) / np.sqrt(2.0)  # of small angles
    alone = (0, len(readings) - 1)
    return [k for k in range(len(readings)) if k == one or (apart_rad[k] < SAME_WAY_RAD and not {k, one} & {*alone})]


def _placed(evidence: Evidence, intervals: Intervals, reading: ExtrinsicConvention) -> tuple[Array, str]:
    """Return the position (3,) m of a reading's camera, or its other one where turns show that, and doubt in words."""
    here, other = reading.T_imu_cam[:3, 3], reading.other_m
    turned = replace(evidence.sequence, rig=replace(evidence.sequence.rig, T_imu_cam=reading.T_imu_cam))
    found = evidence.after(turned).position
    if found is None or np.linalg.norm(other - here) < NEAR_M:
        return here, ""
    share = way_gone(intervals._replace(T_imu_cam=reading.T_imu_cam), found, other - here)
    if is_there(share):
        return other, f"; by rotations the camera is at {metres(other)} and not at {metres(here)}"
    if is_excluded(share):
        return here, ""
    return here, (
        f"; too little rotation to decide whether the camera is at {metres(here)}, as assumed, or at {metres(other)}"
    )


def _of_rotations(intervals: Intervals, T_imu_cam: Array) -> str:
    """Name the axes of an extrinsic that the gyro's channels measure: x, y, z unless others are better beyond doubt."""
    signed, w_imu = signed_axes(), intervals._replace(T_imu_cam=T_imu_cam).w_seen_radps
    found = ranked(cauchy(intervals.w_radps - w_imu @ signed.swapaxes(1, 2), LEAST_SPREAD_W))
    return axes_named(signed[found.best]) if found.behind[0] > AGAINST_SECOND else _OWN


def _ranked(intervals: Intervals, readings: list[ExtrinsicConvention]) -> Ranking:
    candidates = np.stack([reading.T_imu_cam for reading in readings])
    R_cam_imu = np.swapaxes(candidates[:, :3, :3], 1, 2)
    w_imu = intervals.w_cam_radps @ R_cam_imu  # (C, M, 3)
    costs = cauchy(intervals.w_radps - w_imu, LEAST_SPREAD_W)
    if intervals.v_mps is not None:
        v_imu = intervals.v_cam_mps @ R_cam_imu - np.cross(w_imu, candidates[:, None, :3, 3])
        costs = costs + cauchy(intervals.v_mps - v_imu, LEAST_SPREAD_V)
    return ranked(costs)


@beside_camera
def extrinsic_translation(evidence: Evidence, intervals: Intervals) -> Symptom | Undecided | None:
    """Compare the extrinsic's translation with that of its inverse; take the latter where it is far more likely.

    A file can hold the rotation IMU -> camera beside the camera's position t in the IMU frame: inverted, the camera is
    at -R_imu_cam t. Turns distinguish both, because the camera's velocity differs from the IMU's by w x p.
    """
    if evidence.velocity_fit is None:
        return None  # without velocities lever-arm estimates the position
    rig = evidence.sequence.rig
    rotation, given = rig.T_imu_cam[:3, :3], rig.T_imu_cam[:3, 3]
    candidate = -rotation.T @ given
    apart_m = float(np.linalg.norm(candidate - given))
    if apart_m == 0.0:
        return None
    share = way_gone(intervals, evidence.velocity_fit.position, candidate - given)
    if is_excluded(share):
        return None
    way = f"{share.value:.2f} +- {share.error:.2f} of the way (of {apart_m:.2f} m)"
    where, other = f"by the tracks during rotation it is {way} to", metres(candidate)
    if not is_there(share):
        summary = f"the camera is at {metres(given)}, or at {other} if that is the translation of the inverse"
        return Undecided(f"{summary}: {where} there, and there is too little rotation to decide")
    detail = f"the camera at {metres(given)} in the IMU frame is the translation of the inverse: {where} {other}"
    remedy = replace(evidence.sequence, rig=replace(rig, T_imu_cam=se3(rotation, candidate)))
    return Symptom(1, detail, "the camera's position is set to it", remedy)


# Durations (s): over a stride velocity changes by more than its noise, over a window the gyro drifts little.
STRIDE_S, WINDOW_S = 0.5, 10.0
# So many strides begin within the length of one.
OVERLAP = 2
LEAST_STRIDES = 20
# Accuracy of such a change of velocity (m/s^2).
LEAST_SPREAD = 0.1
# Another order must be better by this many standard errors and leave at most this share, because an order can also
# explain a part of other faults.
AGAINST_GIVEN_ORDER, MOST_LEFT = 5.0, 0.7


def accelerometer_axes(evidence: Evidence) -> Symptom | None:
    """Report the order and signs of the accelerometer's channels that fit the camera's motion, if not the given.

    In the axes of one frame, by the gyro, the camera's change of velocity less the specific force is gravity, constant.
    """
    if evidence.intervals is None or evidence.sequence.motion_kind != "imu":
        return None
    found = evidence.agreement
    if found.residual_px > found.limit_px:
        return None  # gyro and camera differ, which `disagreement` reports
    changes = _changes(evidence)
    if len(changes[0]) < LEAST_STRIDES:
        return None
    orders = signed_axes()
    left = np.stack([_left(*changes, order) for order in orders])
    best, _, behind = ranked(cauchy(left, LEAST_SPREAD))
    given_mps2, best_mps2 = (float(np.median(np.linalg.norm(left[k], axis=1))) for k in (0, best))
    if best == 0 or behind[0] < AGAINST_GIVEN_ORDER or best_mps2 > MOST_LEFT * given_mps2:
        return None
    return Symptom(
        1,
        f"the accelerometer's x, y, z are the gyro's {axes_named(orders[best])}: the residual against the camera's "
        f"change of velocity is {given_mps2:.2f} m/s^2 as given, {best_mps2:.2f} m/s^2 in that order (median)",
        f"its channels are exchanged or have the wrong sign: correct them{MIRRORED}",
        remedy=None,
        spoils_vision=True,
    )


def _changes(evidence: Evidence) -> tuple[Array, Array, IntArray]:
    """Return over M strides the change of velocity (M, 3) m/s^2, that by channels (M, 3, 3, 3), and the window (M,).

    The second is the mean of each channel if it measured each axis: [stride, axis of the IMU, channel, axis of the
    first frame].
    """
    found, known = evidence.force_beside_camera, evidence.camera_motion.known
    t_s = (found.middle_ns - found.middle_ns[0]) / NS_PER_S
    stride = max(OVERLAP, round(STRIDE_S / float(np.median(np.diff(t_s)))))
    a = np.arange(0, t_s.size - stride, stride // OVERLAP)
    unknown = np.concatenate([[0], np.cumsum(~known)])
    a = a[unknown[a + stride + 1] == unknown[a]]
    velocity, along = (
        (one[a + stride] - one[a]) / (t_s[a + stride] - t_s[a]).reshape(-1, *[1] * (one.ndim - 1))
        for one in (found.v_mps, found.along_mps)
    )
    return velocity, along, (t_s[a] // WINDOW_S).astype(np.int64)


def _left(velocity: Array, along: Array, window: IntArray, order: Array) -> Array:
    """Return the changes (M, 3) less the specific force in an order (3, 3) of channels, about the window's median."""
    left = velocity - np.einsum("kaci,ac->ki", along, order.T)
    for here in (window == one for one in np.unique(window)):
        left[here] -= np.median(left[here], axis=0)
    return np.asarray(left)
