"""Image coordinates in the wrong columns: left and right images exchanged, or rows and columns.

A point in front of a rectified pair is farther left in the right image, so in a sound recording nearly every disparity
uL - uR is positive. Where many are not, the five other orders of the three coordinates are tried; the right order is
the one under which the tracks follow the measured motion. Where rows and columns of both images are exchanged, uL and
uR hold the rows of the two images, which differ by noise alone. The depth is then lost, and there is no repair.

Rows and columns may be exchanged in some of the tracks only. The camera's own motion, estimated from the other tracks,
predicts on which part of its epipolar line a point of unknown depth is seen next (Hartley & Zisserman, "Multiple View
Geometry in Computer Vision", section 9.2). A track with exchanged rows and columns follows this line once they are
exchanged back.

A right image that is missing may stand as one value in uR, while uL and v are sound. No two tracks have the same uR to
the last digit but by chance, or by rounding, and then many values are as frequent.
"""

import itertools
from dataclasses import replace

import numpy as np

from toolkit.audit.fault import Evidence, Fault, Symptom
from toolkit.audit.parts.intervals import moved_by
from toolkit.geometry import Array, BoolArray, IntArray, se3_inverse
from toolkit.models.camera_motion import CameraMotion, neighbours
from toolkit.models.stereo import disparity_px
from toolkit.sequence import Sequence, StereoRig, is_left_only

# From this share of disparities that are not positive on, the order of the coordinates is tested: dropping so many
# sightings would block.
SUSPECT_SHARE = 0.2
# Under the right order at most this share is not positive: 1 % where it was measured.
SOUND_SHARE = 0.05
# Rows of a pair differ by noise alone: half of the differences are within so many standard deviations of a pixel.
ROW_SIGMAS = 5.0
# Least share of the sightings in tracks with exchanged rows, of which sound recordings at hand have none; and least
# share of these among the sightings in tracks without disparity, or else the camera's motion may be wrong.
LEAST_EXCHANGED, MOSTLY = 0.02, 0.5
# A track may have rows in the place of uL and uR if the mean of its disparities is within so many standard errors of
# zero. Its distance from the epipolar lines is judged from so many pairs of neighbouring sightings on.
TRACK_SIGMAS, LEAST_PAIRS = 4.0, 3
# Inverse depths (1/m) along an epipolar line, from infinity to half a metre.
_INVERSE_DEPTHS = np.concatenate([[0.0], np.geomspace(1e-3, 2.0, 23)])
# A uR that stands for a missing right image is in so many sightings at least, with so many values of uL, and is so many
# times as frequent as any other uR. In the sound recordings at hand, one with halves of a pixel among them, it is 2.4.
FEWEST_FILLED, FEWEST_PLACES, TIMES_AS_FREQUENT = 10, 5, 10
# Frames in which the orders are tried.
TRIED_FRAMES = 300
NAMES = ("uL", "uR", "v")


def check(evidence: Evidence) -> Symptom | None:
    """Find the order of the coordinates under which tracks and motion agree; exchange them where it is certain."""
    sequence = evidence.sequence
    if (partly := _filled_right(sequence) or _rows_in_some_tracks(evidence)) is not None:
        return partly
    disparity = disparity_px(sequence.observations.uv_px)
    suspect = np.isfinite(disparity) & (disparity <= 0.0)
    if suspect.sum() <= SUSPECT_SHARE * max(len(disparity), 1):
        return None
    if (flat := _flat(sequence, suspect)) is not None:
        return flat
    count, share = int(suspect.sum()), suspect.mean()
    detail = f"{count} of {len(disparity)} sightings have a disparity <= 0 ({share:.0%})"
    apart_px, noise_px = float(np.nanmedian(np.abs(disparity))), float(np.sqrt(sequence.rig.cov_uv_px2[0, 0]))
    if apart_px < ROW_SIGMAS * noise_px and share < 1.0 - SUSPECT_SHARE:
        detail += f" and uL differs from uR by {apart_px:.1f} px only, as the rows of a pair do: u and v are exchanged"
        why = "the depth is lost with the exchange: correct the file"
        return Symptom(count, detail, why, remedy=None, spoils_vision=True)
    explained = [remedy for remedy in _reordered(sequence) if _is_sound(remedy[1])]
    if len(explained) != 1:
        why = "no order of the coordinates makes the tracks agree with the measured motion: correct the file"
        detail += ": left and right, or u and v, are exchanged"
        return Symptom(count, detail, why, remedy=None, spoils_vision=True)
    order_name, remedy = explained[0]
    treatment = "exchanged back, and the tracks agree with the measured motion"
    return Symptom(count, f"{detail}: {order_name}", treatment, remedy, spoils_vision=True)


def _filled_right(sequence: Sequence) -> Symptom | None:
    """Report right images that are missing and written as one value of uR; these sightings have uL and v alone."""
    observations = sequence.observations
    uv_px = observations.uv_px
    values, counts = np.unique(uv_px[np.isfinite(uv_px[:, 1]), 1], return_counts=True)
    if not values.size:
        return None
    *_, second = [0, *np.sort(counts)[:-1]]
    filler = float(values[np.argmax(counts)])
    filled = (uv_px[:, 1] == filler) & (uv_px[:, 0] != filler)  # else the left image is missing as well
    count, places = int(filled.sum()), np.unique(uv_px[filled, 0]).size
    if count < max(FEWEST_FILLED, TIMES_AS_FREQUENT * second) or places < FEWEST_PLACES:
        return None
    without = uv_px.copy()
    without[filled, 1] = np.nan
    return Symptom(
        count=count,
        detail=f"{count} of {len(uv_px)} sightings have a uR of {filler:g} at {places} values of uL: no right image",
        treatment="taken as sightings by the left image alone; leave uR empty where there is none",
        remedy=_with_pixels(sequence, without),
        harmful=False,
    )


def _rows_in_some_tracks(evidence: Evidence) -> Symptom | None:
    """Report tracks that follow the camera's own motion, known from the others, only with u and v exchanged."""
    sequence = evidence.sequence
    candidates = _like_rows(sequence)
    if (
        candidates.sum() < max(LEAST_EXCHANGED * candidates.size, 1)
        or not np.isfinite(sequence.observations.uv_px[:, [0, 2]]).all()
    ):
        return None
    exchanged = _exchanged_rows(sequence, evidence.camera_motion)
    count = int(exchanged.sum())
    if count < max(LEAST_EXCHANGED * len(exchanged), MOSTLY * candidates.sum()):
        return None
    return Symptom(
        count=count,
        detail=(
            f"{count} of {len(exchanged)} sightings ({count / len(exchanged):.0%}), whole tracks, have a uL that "
            "differs from uR as the rows of a pair do, and agree with the camera's own motion only if u and v are "
            "exchanged"
        ),
        treatment=(
            "the depth is lost with the exchange: these and all others that look like rows dropped "
            f"({candidates.sum()})"
        ),
        remedy=replace(sequence, observations=sequence.observations.select(~candidates)),
    )


def _exchanged_rows(sequence: Sequence, camera: CameraMotion) -> BoolArray:
    """Say for each sighting (N,) whether its track, without disparity, follows the camera's motion only if exchanged.

    Its median distance from the epipolar lines is then less than half of that as given.
    """
    candidates = _like_rows(sequence)
    pairs = neighbours(sequence.observations)
    pairs = pairs.select(camera.known[pairs.interval] & candidates[pairs.before])
    exchanged = np.zeros(len(sequence.observations), dtype=bool)
    if not pairs.before.size:
        return exchanged
    T_after_before = se3_inverse(moved_by(camera, sequence))[pairs.interval]
    uv_px, track_id = sequence.observations.uv_px, sequence.observations.track_id[pairs.before]
    rows_px = uv_px[:, :2].mean(axis=1)
    as_given, turned = np.stack([rows_px, uv_px[:, 2]], axis=1), np.stack([uv_px[:, 2], rows_px], axis=1)
    off_px = [
        _median_of_each(track_id, _off_line_px(pixels[pairs.before], pixels[pairs.after], T_after_before, sequence.rig))
        for pixels in (as_given, turned)
    ]
    enough = np.unique(track_id, return_counts=True)[1] >= LEAST_PAIRS
    struck = np.unique(track_id)[enough & (off_px[1] < 0.5 * off_px[0])]
    return np.asarray(np.isin(sequence.observations.track_id, struck) & candidates)


def _like_rows(sequence: Sequence) -> BoolArray:
    """Say for each sighting (N,) whether the disparities of its track are zero except for the noise of rows."""
    disparity = disparity_px(sequence.observations.uv_px)
    _, member, counts = np.unique(sequence.observations.track_id, return_inverse=True, return_counts=True)
    mean = np.bincount(member, weights=disparity) / counts
    spread = np.sqrt(np.maximum(np.bincount(member, weights=(disparity - mean[member]) ** 2) / counts, 0.0))
    sigma = np.minimum(spread, np.sqrt(2.0 * sequence.rig.cov_uv_px2[2, 2]))
    near = np.abs(mean) <= TRACK_SIGMAS * sigma / np.sqrt(counts)
    return np.asarray((near & (counts > LEAST_PAIRS))[member])


def _off_line_px(before_px: Array, after_px: Array, T_after_before: Array, rig: StereoRig) -> Array:
    """Return the distances (P,) px of pixels (P, 2) from the epipolar lines of those in the frame before."""
    focal_px, centre_px = np.array([rig.fx_px, rig.fy_px]), np.array([rig.cx_px, rig.cy_px])
    ray = np.concatenate([(before_px - centre_px) / focal_px, np.ones((len(before_px), 1))], axis=1)
    turned = (T_after_before[:, :3, :3] @ ray[:, :, None])[..., 0]
    seen = turned[:, None] + _INVERSE_DEPTHS[:, None] * T_after_before[:, None, :3, 3]
    in_front = seen[..., 2] > 0.01
    at_px = focal_px * seen[..., :2] / np.where(in_front, seen[..., 2], 1.0)[..., None] + centre_px
    distance = np.where(in_front, np.linalg.norm(at_px - after_px[:, None], axis=2), np.inf)
    return np.asarray(distance.min(axis=1))


def _median_of_each(group: IntArray, values: Array) -> Array:
    """Return the median of the values (P,) of each group, in the order of the groups' numbers."""
    order = np.lexsort((values, group))
    _, first, counts = np.unique(group[order], return_index=True, return_counts=True)
    return np.asarray(values[order][first + (counts - 1) // 2])


def _flat(sequence: Sequence, suspect: BoolArray) -> Symptom | None:
    """Report sightings without disparity: missing ones written as zeros, or one image in the columns of both."""
    observations = sequence.observations
    uv_px = observations.uv_px
    filler, missing = _filler(uv_px)
    same = uv_px[:, 0] == uv_px[:, 1]
    of_all = f"of {len(observations)} sightings"
    if missing.sum() > 0.5 * suspect.sum():
        count = int(missing.sum())
        return Symptom(
            count=count,
            detail=f"{count} {of_all} are {filler:g} in every coordinate: missing ones, written as {filler:g}",
            treatment="dropped; a course file has -1 for them, a table no row",
            remedy=replace(sequence, observations=observations.select(~missing)),
            harmful=False,
        )
    if same.sum() > 0.5 * suspect.sum():
        return Symptom(
            count=int(same.sum()),
            detail=f"{int(same.sum())} {of_all} have a uR that equals uL: one camera's columns stand for both",
            treatment="without the right image there is no depth: correct the file, or leave uR empty",
            remedy=None,
            spoils_vision=True,
        )
    return None


def _filler(uv_px: Array) -> tuple[float, BoolArray]:
    """Return the most frequent value among sightings (N, 3) with equal coordinates, and which of them (N,) have it."""
    alike = (uv_px == uv_px[:, :1]).all(axis=1)
    if not alike.any():
        return np.nan, alike
    values, counts = np.unique(uv_px[alike, 0], return_counts=True)
    filler = float(values[np.argmax(counts)])
    return filler, np.asarray(alike & (uv_px[:, 0] == filler))


def _reordered(sequence: Sequence) -> list[tuple[str, Sequence]]:
    """Return the recording in every other order of coordinates, and with left and right exchanged behind the camera."""
    uv_px = sequence.observations.uv_px
    orders = [order for order in itertools.permutations(range(3)) if order != (0, 1, 2)]
    # A sighting without the right image has nothing to be exchanged with.
    sequence = replace(sequence, observations=sequence.observations.select(~is_left_only(uv_px)))
    uv_px = sequence.observations.uv_px
    whole = [(_order_name(order), uv_px[:, list(order)]) for order in orders]
    observations = sequence.observations
    parts = {"whole tracks": _behind(uv_px, observations.track_id), "whole frames": _behind(uv_px, observations.frame)}
    # Of tracks and frames, the grouping is taken under which the exchange leaves the fewest points behind the camera.
    kind = min(parts, key=lambda kind: int(np.sum(parts[kind] != (disparity_px(uv_px) <= 0.0))))
    behind = parts[kind]
    if behind.mean() < 1.0 - SUSPECT_SHARE:
        turned = np.where(behind[:, None], uv_px[:, [1, 0, 2]], uv_px)
        whole.append((f"left and right are exchanged in {behind.mean():.0%} of them, {kind}", turned))
    return [(order_name, _with_pixels(sequence, pixels)) for order_name, pixels in whole]


def _behind(uv_px: Array, group: IntArray) -> BoolArray:
    """Say for each sighting (N,) whether most of its group, a track or a frame, has a disparity <= 0."""
    _, member = np.unique(group, return_inverse=True)
    behind = np.bincount(member, weights=disparity_px(uv_px) <= 0.0) / np.bincount(member)
    return np.asarray(behind[member] > 0.5)


def _is_sound(sequence: Sequence) -> bool:
    if (disparity_px(sequence.observations.uv_px) <= 0.0).mean() > SOUND_SHARE:
        return False
    evidence = Evidence(sequence.truncated(TRIED_FRAMES))
    if evidence.intervals is None:
        return False
    found = evidence.agreement
    return found.residual_px <= found.limit_px


def _order_name(order: tuple[int, ...]) -> str:
    if order == (1, 0, 2):
        return "left and right are exchanged"
    return f"they are in the order {', '.join(NAMES[order.index(column)] for column in range(3))}"


def _with_pixels(sequence: Sequence, uv_px: Array) -> Sequence:
    return replace(sequence, observations=replace(sequence.observations, uv_px=uv_px))


FAULT = Fault(
    "swapped-coordinates",
    "left and right images, or rows and columns, exchanged",
    check,
    after=("time-order", "returning-tracks", "not-finite", "implausible", "outside-motion"),
)
