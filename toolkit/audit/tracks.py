"""Faults of the tracks: sightings that repeat, lack an image, have exchanged coordinates or fit no motion."""

from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np

from toolkit.audit.fault import Evidence, Symptom, Undecided
from toolkit.audit.intervals import LEAST_INTERVALS, interval_means, is_comparable
from toolkit.audit.one_step import errors_are_independent
from toolkit.geometry import Array, BoolArray, IntArray
from toolkit.jackknife import jackknife_error
from toolkit.measurements import NS_PER_S, is_left_only
from toolkit.models.camera_motion import Neighbours, neighbours
from toolkit.models.gating import CHI2_3_MEDIAN, LEAST_DISPARITY_PX, mahalanobis_squared
from toolkit.models.noise import TRACKED_PIXEL_SIGMA_PX
from toolkit.models.stereo import disparity_px
from toolkit.sequence import NO_FEATURES, ONE_ROW_FOR_BOTH, Observations, Sequence


def no_sightings(evidence: Evidence) -> Symptom | None:
    sequence = evidence.sequence
    if len(sequence.observations) or not sequence.frame_count or NO_FEATURES in sequence.provenance.facts:
        return None
    detail = f"none of {sequence.frame_count} frames has a stereo sighting"
    why = "only dead reckoning can be compared: check the tracker that made the recording"
    return Symptom(sequence.frame_count, detail, why, remedy=None)


def unknown_rows(evidence: Evidence) -> Undecided | None:
    """Report that the rows of both images cannot be compared where the file has one row for both.

    In a pair that is not rectified they differ, and the effect looks like a wrong principal point.
    """
    sequence = evidence.sequence
    if ONE_ROW_FOR_BOTH not in sequence.provenance.facts or is_left_only(sequence.observations.uv_px).all():
        return None
    return Undecided(
        f"{ONE_ROW_FOR_BOTH}: whether left and right agree in rows, as rectified pairs do, cannot be checked"
    )


def returning_tracks(evidence: Evidence) -> Symptom | None:
    """Count the track ids that are absent for some frames and return; each return starts a new track.

    An estimator would close a loop without knowing it or, of an id used again, take two points for one.
    """
    observations = evidence.sequence.observations
    order = observations.by_track
    absent = np.diff(observations.frame[order]) - 1
    returns = (np.diff(observations.track_id[order]) == 0) & (absent > 0)
    if not (count := int(returns.sum())):
        return None
    gaps = absent[returns]
    detail = f"{count} return(s) of a track after an absence of {gaps.min()} to {gaps.max()} frames"
    treatment = "the track ends before its absence and a new one starts after it"
    new = observations.split(np.isin(np.arange(len(observations)), order[1:][returns]))
    split = Observations.sorted(observations.frame, new, observations.uv_px)
    return Symptom(count, detail, treatment, replace(evidence.sequence, observations=split))


# Share of a frame's surviving tracks that must repeat: 1 in a stale frame of a moving vehicle, 0 in any other.
LEAST_STALE_SHARE = 0.9
# Tracks that must survive into the frame: fewer could repeat by chance where pixels are rounded.
LEAST_STALE_TRACKS = 4
# Upper quartile of the pixel steps of a moving camera: 0.96 px at least beside a stale frame, 0.05 px at most parked.
MOVING_PX = 0.5
# The samples show motion where they rotate the image by this (px) from frame to frame, or drive faster (m/s).
TURNING_PX, DRIVING_MPS = 2.0, 1.0


def stale_frames(evidence: Evidence) -> Symptom | None:
    """Count the frames that repeat the pixels before them while the vehicle moves; repeated tracks end there.

    From then on, each track follows a different scene point. A standing camera repeats pixels too: the image must move
    just before and just after or, at the ends of a recording, the samples must show motion.
    """
    sequence = evidence.sequence
    pairs = neighbours(sequence.observations)
    moved_px = np.abs(sequence.observations.uv_px[pairs.after] - sequence.observations.uv_px[pairs.before])
    step_px = np.where(np.isnan(moved_px[:, 1]), moved_px[:, [0, 2]].max(axis=1), moved_px.max(axis=1))
    stale = _stale_intervals(max(sequence.frame_count - 1, 0), pairs, step_px, _moving_by_samples(sequence))
    count = int(stale.sum())
    if count == 0:
        return None
    repeated = np.zeros(len(sequence.observations), dtype=bool)
    repeated[pairs.after] = stale[pairs.interval] & (step_px == 0.0)
    exactly = f"exactly while the vehicle moves ({repeated.sum()} sightings)"
    return Symptom(
        count,
        f"{count} of {sequence.frame_count} frames repeat the pixels of the frame before them {exactly}",
        "every repeated track ends there, the repeats are dropped, and a new track starts at the next frame",
        _cut_tracks(sequence, repeated),
    )


def _moving_by_samples(sequence: Sequence) -> BoolArray:
    """Say for each interval (K - 1,) whether, by the samples, the image rotates by pixels or the vehicle drives."""
    if sequence.motion_kind == "none" or not is_comparable(sequence):
        return np.zeros(max(sequence.frame_count - 1, 0), dtype=bool)
    mean = interval_means(sequence.motion.t_ns, sequence.motion.values, sequence.frames_t_ns)
    step_s = np.diff(sequence.frames_t_ns) / NS_PER_S
    with np.errstate(over="ignore"):  # by a sample that `implausible` will drop
        speed_mps, rate_radps = np.linalg.norm(mean[:, :3], axis=1), np.linalg.norm(mean[:, 3:], axis=1)
    turning = sequence.rig.fx_px * rate_radps * step_s > TURNING_PX
    return np.asarray(turning | ((sequence.motion_kind == "twist") & (speed_mps > DRIVING_MPS)))


def _stale_intervals(intervals: int, pairs: Neighbours, step_px: Array, moving_by_samples: BoolArray) -> BoolArray:
    """Say for each interval whether its tracks repeat while those around it, or at an end the samples, show motion."""
    survivors = np.bincount(pairs.interval, minlength=intervals)
    repeats = np.bincount(pairs.interval[step_px == 0.0], minlength=intervals)
    frozen = (repeats >= LEAST_STALE_SHARE * survivors) & (survivors >= LEAST_STALE_TRACKS)
    moving = _typical_step_px(intervals, pairs, step_px) > MOVING_PX
    # The nearest interval on either side that is not frozen; beyond the ends there is none. Intervals with hardly any
    # surviving track, as at the end of a long freeze, are passed over as well.
    index, shows_nothing = np.arange(intervals), frozen | (survivors < LEAST_STALE_TRACKS)
    before = np.maximum.accumulate(np.where(shows_nothing, -1, index))
    after = np.minimum.accumulate(np.where(shows_nothing, intervals, index)[::-1])[::-1]
    stays = np.concatenate([moving, [False]])  # index -1 and index `intervals` both read False
    moves_before = np.where(before < 0, moving_by_samples, stays[before])
    moves_after = np.where(after == intervals, moving_by_samples, stays[after])
    stale: BoolArray = frozen & moves_before & moves_after
    return stale


def _typical_step_px(intervals: int, pairs: Neighbours, step_px: Array) -> Array:
    """Return the upper quartile of the pixel steps (K - 1,) of each interval, zero where no track survives."""
    order = np.lexsort((step_px, pairs.interval))
    first = np.searchsorted(pairs.interval, np.arange(intervals + 1))
    count = np.diff(first)
    quartile = np.minimum(first[:-1] + (3 * count) // 4, max(order.size - 1, 0))
    return np.where(count > 0, step_px[order][quartile], 0.0) if order.size else np.zeros(intervals)


def _cut_tracks(sequence: Sequence, repeated: BoolArray) -> Sequence:
    """Drop the repeated sightings (N,) and give their tracks a new id from the next frame on."""
    observations = sequence.observations
    order = observations.by_track
    starts = np.zeros(len(observations), dtype=bool)
    starts[order[1:]] = repeated[order[:-1]]
    track_id, kept = observations.split(starts), ~repeated
    cut = Observations.sorted(observations.frame[kept], track_id[kept], observations.uv_px[kept])
    return replace(sequence, observations=cut)


# Steps (px) that are tried. Smaller ones are not reported, because they add errors of less than 0.03 px.
STEPS_PX = (1.0, 0.5, 0.25, 0.2, 0.125, 0.1)
# Least number of sightings, and least share of rounded ones among the first of these and among all.
LEAST_SIGHTINGS, SOME, NEARLY_ALL = 100, 0.9, 0.999
# Rounding is a warning from this share of the stated standard deviation on.
MOST_ROUNDING = 0.5


def coarse_pixels(evidence: Evidence) -> Symptom | None:
    """Report sightings rounded to whole pixels, or to a simple part of one.

    Rounding to steps of s adds errors of s / sqrt(12) to each coordinate (Bennett, "Spectra of quantized signals",
    1948).
    """
    rig, uv_px = evidence.sequence.rig, evidence.sequence.observations.uv_px
    seen_px = uv_px[np.isfinite(uv_px).all(axis=1), :2]  # v may be the mean of two rows, with finer steps
    if len(seen_px) < LEAST_SIGHTINGS:
        return None
    if (step_px := _step_px(seen_px)) is None:
        return None
    rounding_px, stated_px = step_px / np.sqrt(12.0), float(np.sqrt(rig.cov_uv_px2[0, 0]))
    adds = f"rounding adds errors of {rounding_px:.2g} px to the {stated_px:.2g} px stated for uL"
    detail = f"uL and uR are multiples of {step_px:g} px: {adds}"
    treatment = "write them with all the digits that the tracker has; depths of far points suffer most"
    found = Symptom.information(len(seen_px), detail, treatment)
    return replace(found, warns=bool(rounding_px > MOST_ROUNDING * stated_px))


def _step_px(uv_px: Array) -> float | None:
    some_px = uv_px[:LEAST_SIGHTINGS]  # enough to exclude it in most recordings
    for step_px in STEPS_PX:
        if _share_round(some_px, step_px) > SOME and _share_round(uv_px, step_px) > NEARLY_ALL:
            return step_px
    return None


def _share_round(uv_px: Array, step_px: float) -> float:
    steps = uv_px / step_px
    return float(np.mean(np.abs(steps - np.round(steps)) < 1e-4))


# From this share of disparities that are not positive on, the order of the coordinates is tested.
SUSPECT_SHARE = 0.2
# Under the right order at most this share is not positive: 1 % where it was measured.
SOUND_SHARE = 0.05
# Rows of a pair differ by noise alone: half of the differences are within this many standard deviations of a pixel.
ROW_SIGMAS = 5.0
# A uR that stands for a missing right image is in this many sightings, with this many values of uL, and this many times
# as frequent as any other uR (2.4 in sound recordings).
FEWEST_FILLED, FEWEST_PLACES, TIMES_AS_FREQUENT = 10, 5, 10
# Frames in which the orders are tried.
TRIED_FRAMES = 300


def swapped_coordinates(evidence: Evidence) -> Symptom | None:
    """Find coordinates in the wrong columns: left and right images exchanged, or rows and columns.

    Nearly every disparity uL - uR is positive. Where many are not, left and right are exchanged back if the tracks then
    follow the measured motion. Of exchanged rows and columns the depth is lost.
    """
    sequence = evidence.sequence
    if (filled := _filled_right(sequence)) is not None:
        return filled
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
    # A sighting without the right image has nothing to be exchanged with.
    both = sequence.observations.select(~is_left_only(sequence.observations.uv_px))
    remedy = replace(sequence, observations=replace(both, uv_px=both.uv_px[:, [1, 0, 2]]))
    if not _is_sound(remedy):
        why = "exchanged back, the tracks do not agree with the measured motion: correct the file"
        detail += ": left and right, or u and v, are exchanged"
        return Symptom(count, detail, why, remedy=None, spoils_vision=True)
    treatment = "exchanged back, and the tracks agree with the measured motion"
    return Symptom(count, f"{detail}: left and right are exchanged", treatment, remedy, spoils_vision=True)


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
    detail = f"{count} of {len(uv_px)} sightings have a uR of {filler:g} at {places} values of uL: no right image"
    treatment = "taken as sightings by the left image alone; leave uR empty where there is none"
    remedy = replace(sequence, observations=replace(observations, uv_px=without))
    return Symptom(count, detail, treatment, remedy, harmful=False)


def _flat(sequence: Sequence, suspect: BoolArray) -> Symptom | None:
    """Report sightings without disparity: missing ones written as zeros, or one image in the columns of both."""
    observations, uv_px = sequence.observations, sequence.observations.uv_px
    same, of_all = uv_px[:, 0] == uv_px[:, 1], f"of {len(observations)} sightings"
    values, counts = np.unique(uv_px[(uv_px == uv_px[:, :1]).all(axis=1), 0], return_counts=True)
    filler = float(values[np.argmax(counts)]) if values.size else np.nan
    missing = (uv_px == filler).all(axis=1)
    if (count := int(missing.sum())) > 0.5 * suspect.sum():
        detail = f"{count} {of_all} are {filler:g} in every coordinate: missing ones, written as {filler:g}"
        treatment = "dropped; write -1 for them in a course file, and leave their rows out of a table"
        remedy = replace(sequence, observations=observations.select(~missing))
        return Symptom(count, detail, treatment, remedy, harmful=False)
    if (count := int(same.sum())) > 0.5 * suspect.sum():
        detail = f"{count} {of_all} have a uR that equals uL: one camera's columns stand for both"
        why = "without the right image there is no depth: correct the file, or leave uR empty"
        return Symptom(count, detail, why, remedy=None, spoils_vision=True)
    return None


def _is_sound(sequence: Sequence) -> bool:
    if (disparity_px(sequence.observations.uv_px) <= 0.0).mean() > SOUND_SHARE:
        return False
    evidence = Evidence(sequence.truncated(TRIED_FRAMES))
    if evidence.intervals is None:
        return False
    found = evidence.agreement
    return found.residual_px <= found.limit_px


# A disparity is doubled if its ratio is nearer to two than to one or four, to allow for noise and for the motion.
LEAST_RATIO, LARGEST_RATIO = np.sqrt(2.0), np.sqrt(8.0)
# Least share and number of doubled tracks among those detected in a frame: 0.96 to 1 where they are doubled, at most
# 0.22 in any other real frame and 0.40 in simulated ones.
LEAST_DOUBLED_SHARE, LEAST_DOUBLED_TRACKS = 0.8, 6
# Largest inverse of the ratio at infinite depth: halfway between a half, of doubled tracks, and one, of any motion.
MOST_AT_INFINITY = 0.75
# Least share of them that is seen a third time, to know that the disparity stays doubled.
LEAST_SEEN_AGAIN = 0.5


def doubled_disparity(evidence: Evidence) -> Symptom | None:
    """Find tracks whose disparity doubles from the first sighting to the second, and halve it from there on.

    A tracker does so that adds the disparity to a guess which contains it; no motion halves all depths just once.
    """
    observations = evidence.sequence.observations
    begun = _beginnings(observations)
    bad_frames = [k for k in np.unique(begun.frame).tolist() if _is_doubled(begun.select(begun.frame == k))]
    if not bad_frames:
        return None
    tracks = begun.track_id[np.isin(begun.frame, bad_frames) & (begun.first_ratio > LEAST_RATIO)]
    where = f"frame {bad_frames[0]}" if len(bad_frames) == 1 else f"{len(bad_frames)} frames"
    doubles = "doubles from their first sighting to the second and stays so"
    return Symptom(
        tracks.size,
        f"the disparity of {tracks.size} tracks, of nearly all detected in {where}, {doubles}",
        "halved in every sighting but the first",
        replace(evidence.sequence, observations=_halved(observations, tracks)),
    )


class _Beginnings(NamedTuple):
    """Tracks (T,), frame and disparity (px) of their first sighting, and ratios, second to first and third to second.

    Only tracks whose first ratio is known are contained; an unknown second ratio is NaN.
    """

    track_id: IntArray
    frame: IntArray
    first_px: Array
    first_ratio: Array
    second_ratio: Array

    def select(self, rows: BoolArray) -> "_Beginnings":
        numbers, (first_px, *ratios) = self[:2], (values[rows] for values in self[2:])
        return _Beginnings(numbers[0][rows], numbers[1][rows], first_px, *ratios)


def _beginnings(observations: Observations) -> _Beginnings:
    order = observations.by_track
    track_id, frame = observations.track_id[order], observations.frame[order]
    disparity = disparity_px(observations.uv_px)[order]
    follows = (np.diff(track_id) == 0) & (np.diff(frame) == 1) & (disparity[:-1] > LEAST_DISPARITY_PX)
    # From row n to row n + 1; two more rows, because the last sighting may be the only one of its track.
    ratio = np.full(track_id.size + 1, np.nan)
    np.divide(disparity[1:], disparity[:-1], out=ratio[: follows.size], where=follows)
    first = np.flatnonzero(np.diff(track_id, prepend=-1))
    begun = _Beginnings(track_id[first], frame[first], disparity[first], ratio[first], ratio[first + 1])
    return begun.select(np.isfinite(begun.first_ratio))


def _is_doubled(begun: _Beginnings) -> bool:
    doubled = (begun.first_ratio > LEAST_RATIO) & (begun.first_ratio < LARGEST_RATIO)
    again = np.isfinite(begun.second_ratio)
    if doubled.size < LEAST_DOUBLED_TRACKS or doubled.mean() < LEAST_DOUBLED_SHARE or again.mean() < LEAST_SEEN_AGAIN:
        return False
    stays = float(np.median(begun.second_ratio[again])) < LEAST_RATIO
    return stays and _far_ones_double(begun)


def _far_ones_double(begun: _Beginnings) -> bool:
    """Say whether the disparity of far tracks doubles as well; a motion does not change it at infinity.

    If the camera moves forward by t, the inverse of the ratio is 1 - t d / (f b), a straight line in the disparity d.
    The line through the medians of the farther and the nearer half of the tracks is extrapolated to d = 0.
    """
    order = np.argsort(begun.first_px)
    (far_px, far), (near_px, near) = (
        (float(np.median(begun.first_px[half])), float(np.median(1.0 / begun.first_ratio[half])))
        for half in np.array_split(order, 2)
    )
    slope = min((near - far) / (near_px - far_px), 0.0) if near_px > far_px else 0.0
    return far - slope * far_px < MOST_AT_INFINITY


def _halved(observations: Observations, tracks: IntArray) -> Observations:
    later = np.isin(observations.track_id, tracks)
    later[np.unique(observations.track_id, return_index=True)[1]] = False  # rows are in the order of frames
    uv_px = observations.uv_px.copy()
    uv_px[later, 1] += 0.5 * disparity_px(observations.uv_px[later])
    return Observations(observations.frame, observations.track_id, uv_px)


def no_disparity(evidence: Evidence) -> Symptom | None:
    observations = evidence.sequence.observations
    bad = disparity_px(observations.uv_px) <= 0.0
    if not (count := int(bad.sum())):
        return None
    detail = f"{count} of {len(observations)} sightings have a disparity <= 0 ({count / len(observations):.2%})"
    return Symptom(count, detail, "dropped", replace(evidence.sequence, observations=observations.select(~bad)))


def left_only(evidence: Evidence) -> Symptom | None:
    uv_px = evidence.sequence.observations.uv_px
    if not (count := int(is_left_only(uv_px).sum())):
        return None
    detail = f"{count} of {len(uv_px)} sightings ({count / len(uv_px):.0%}) lack the right image"
    if count == len(uv_px):
        return Symptom.warning(detail, "without any disparity, depths depend on the motion alone", count)
    return Symptom.information(count, detail, "used for uL and v")


# Least length (s) of a span: every estimator bridges shorter ones by the motion samples.
LEAST_THIN_S = 0.5


def thin_vision(evidence: Evidence) -> Symptom | None:
    sequence = evidence.sequence
    if evidence.spoilt_by or not len(sequence.observations) or not is_comparable(sequence):
        return None
    known = evidence.camera_motion.known
    frame_s = (sequence.frames_t_ns - sequence.frames_t_ns[0]) / NS_PER_S
    # A single interval of that length is a gap in the frames, which time-gap reports.
    spans = [run for run in _runs(~known) if run[1] - run[0] > 1 and frame_s[run[1]] - frame_s[run[0]] >= LEAST_THIN_S]
    if not spans:
        return None
    longest = max(spans, key=lambda span: frame_s[span[1]] - frame_s[span[0]])
    share = sum(end - begin for begin, end in spans) / known.size
    seen = len(sequence.observations) / sequence.frame_count
    return Symptom.warning(
        f"the tracks do not determine the camera's motion for {share:.0%} of the time, the longest at "
        f"{frame_s[longest[0]]:.1f}-{frame_s[longest[1]]:.1f} s ({seen:.1f} sightings a frame over all)",
        "there every estimate rests on the motion samples, or on a few tracks that may be wrong",
        len(spans),
        tuple((int(sequence.frames_t_ns[begin]), int(sequence.frames_t_ns[end])) for begin, end in spans),
    )


def _runs(marked: BoolArray) -> list[tuple[int, int]]:
    """Return begin and end (exclusive) of every run of marked entries (n,)."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], marked, [False]])))
    return list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))


# Limit of the ratio of the standard deviation to the stated one: 0.98 to 1.00 in sound simulations, 0.62 at most in
# real recordings, 1.04 to 1.07 with a tenth of mismatches.
MOST_SCATTER, SCATTER_SIGMAS = 1.05, 5.0
# Squared distances that a quarter of the sightings exceed, and one in a thousand (chi-square, 3 degrees of freedom).
UPPER_QUARTILE, FAR_CHI2 = 4.108, 16.27
# Beyond this squared distance, 32 sigma, a sighting is of another point; sound recordings have 0.6 % of these at most.
GROSS_CHI2, MOST_GROSS = 1000.0, 0.02
# Ratios of the median to its expectation that agree with the stated noise, also with a fifth of mismatches; the tail
# must then agree too: a tenth of sliding tracks gives 2.1 to 5.6 % of far distances, sound ones 0.06 to 0.12 %.
USUAL_SCATTER = (0.95, 1.12)
MOST_FAR, FAR_SIGMAS = 0.008, 3.0
# Independent errors contradict a noise stated this many times too large: less is often stated on purpose.
MOST_OVERSTATED = 1.5
# The same for correlated errors, whose steps scatter less: 7 times for the toolkit's own tracker on EuRoC's images.
MOST_OVERSTATED_CORRELATED = 10.0
# Ratio of standard deviations below which tracks are exact, as in a simulation without noise.
_NO_ERROR = 1e-5
# If the stated noise alone is wrong, the ratios by the median and by the upper quartile agree to within these factors.
SAME_RATIO = (0.9, 1.1)


def track_scatter(evidence: Evidence) -> Symptom | Undecided | None:
    """Compare the scatter of the tracks about the camera's own motion with the stated noise.

    One-step residuals have the covariance J R J^T + R if the noise R of a sighting is right, and squared Mahalanobis
    distances the upper quartile of the chi-square distribution, which few gross errors change. Where R is assumed and
    too large, mismatches are found by their number; a scatter far below R contradicts it if errors are independent.
    """
    if evidence.spoilt_by or evidence.camera_motion.known.sum() < LEAST_INTERVALS:
        return evidence.blind
    steps = evidence.one_step
    chi2 = mahalanobis_squared(steps.residual_px, steps.cov_px2)
    scatter, error = _scatter_ratio(chi2), jackknife_error(_scatter_ratio, chi2)
    if not np.isfinite(scatter):
        return evidence.blind
    if scatter < MOST_SCATTER + SCATTER_SIGMAS * error:
        return _tail(chi2) or _overstated(evidence, scatter, error)
    cause = "mismatches, points that move, or noise stated too small"
    if SAME_RATIO[0] < _nearer_scatter(chi2) / scatter < SAME_RATIO[1]:
        cause = f"near and far ones equally, so the noise is stated {scatter:.3g} times too small"
    return Symptom.warning(
        f"{_scatters(evidence, scatter, error)}; {np.mean(chi2 > FAR_CHI2):.0%} are beyond chance",
        f"{cause}: estimators give such tracks too much weight",
    )


def _overstated(evidence: Evidence, scatter: float, error: float) -> Symptom | None:
    """Report tracks that scatter far less than the stated noise, and whether that noise alone explains it.

    Six parameters of the camera's motion are fitted to the 3 n residuals of an interval, which lowers their scatter.
    """
    _, interval, pairs = np.unique(
        evidence.sequence.observations.frame[evidence.one_step.after], return_inverse=True, return_counts=True
    )
    left = float(np.mean(np.maximum(1.0 - 2.0 / pairs, 0.0)[interval]))
    correlation = evidence.step_correlation
    if left <= 0.0 or scatter < _NO_ERROR or correlation is None:
        return None
    scatter, error = scatter / np.sqrt(left), error / np.sqrt(left)
    independent = errors_are_independent(correlation)
    least = 1.0 / (MOST_OVERSTATED if independent else MOST_OVERSTATED_CORRELATED)
    if scatter + SCATTER_SIGMAS * error > least:
        return None
    times = f"{1.0 / scatter:.2g}" if scatter > 0.1 else f"{1.0 / scatter:.0f}"
    cause = f"the noise is stated {times} times too large, or the errors are constant along tracks"
    if not independent:
        cause = f"the noise is stated too large, by less than {times} times as the errors are correlated between frames"
    symptom = Symptom.warning(
        _scatters(evidence, scatter, error), f"{cause}: estimators give such tracks too little weight"
    )
    if np.sqrt(evidence.sequence.rig.cov_uv_px2[0, 0]) != TRACKED_PIXEL_SIGMA_PX:
        return symptom
    # This noise was not stated: it is the one assumed where a recording states none.
    assumed = f"{symptom.treatment}; half a pixel is assumed where nothing is stated, and noise.pixel_sigma_px sets it"
    return replace(symptom, treatment=assumed, warns=False)


def _scatters(evidence: Evidence, scatter: float, error: float) -> str:
    sigma_px = " ".join(f"{sigma:.2g}" for sigma in np.sqrt(np.diag(evidence.sequence.rig.cov_uv_px2)))
    figures = f"{scatter:.2f} +- {error:.2f}" if scatter >= 1.0 else f"{scatter:.2g} +- {error:.1g}"
    return (
        f"from frame to frame the tracks scatter {figures} times as much as the stated noise of a sighting explains "
        f"(uL uR v: {sigma_px} px)"
    )


def _tail(chi2: Array) -> Symptom | None:
    """Report too many gross distances (P,), or too many far ones where the median agrees with the noise."""
    gross, error = _share_beyond(chi2, GROSS_CHI2), jackknife_error(partial(_share_beyond, bound=GROSS_CHI2), chi2)
    if gross > MOST_GROSS + SCATTER_SIGMAS * error:
        return _mismatched(f"{gross:.1%} +- {error:.1%}", f"{np.sqrt(GROSS_CHI2):.0f} times what the noise explains")
    far, error = _share_beyond(chi2, FAR_CHI2), jackknife_error(partial(_share_beyond, bound=FAR_CHI2), chi2)
    least, most = USUAL_SCATTER
    if least < _nearer_scatter(chi2) < most and far > MOST_FAR + FAR_SIGMAS * error:
        return _mismatched(f"{far:.1%} +- {error:.1%}", "the stated noise explains (0.1% do by chance)")
    return None


def _share_beyond(chi2: Array, bound: float) -> float:
    return float(np.mean(chi2 > bound))


def _mismatched(share: str, than: str) -> Symptom:
    return Symptom.warning(
        f"from frame to frame {share} of the sightings have residuals of more than {than}",
        "mismatches, exchanged ids, or points that move: estimators must reject as many",
    )


def _scatter_ratio(chi2: Array) -> float:
    """Return the ratio of the standard deviation to the stated one, by the upper quartile of squared distances (P,)."""
    return float(np.sqrt(np.quantile(chi2, 0.75) / UPPER_QUARTILE))


def _nearer_scatter(chi2: Array) -> float:
    """Return the same ratio by the median of the squared distances (P,)."""
    return float(np.sqrt(np.median(chi2) / CHI2_3_MEDIAN))
