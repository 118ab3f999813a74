"""Tracks whose disparity doubles from their first sighting to their second, and stays doubled.

A tracker that adds the disparity to an initial guess which already contains it doubles the disparity of every newly
detected track. Such points appear at half of their depth, so the camera seems to move at half of its speed. No motion
causes this: it would have to halve the depths of near and far points alike in one interval, and then stop.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from toolkit.audit.fault import Evidence, Fault, Symptom
from toolkit.audit.parts.edits import by_track
from toolkit.geometry import Array, BoolArray, IntArray
from toolkit.models.gating import LEAST_DISPARITY_PX
from toolkit.models.stereo import disparity_px
from toolkit.sequence import Observations

# A disparity is doubled if its ratio is nearer to two than to one or four, to allow for noise and for the motion.
LEAST_RATIO, LARGEST_RATIO = np.sqrt(2.0), np.sqrt(8.0)
# Least share and number of doubled tracks among those detected in a frame. Measured: 0.96 to 1 where they are doubled,
# at most 0.22 in any other frame of the real recordings and 0.40 in simulated ones, where few and far points begin a
# track.
LEAST_SHARE, LEAST_TRACKS = 0.8, 6
# Largest inverse of the ratio at infinite depth: halfway between that of doubled tracks, a half, and of any motion,
# one.
MOST_AT_INFINITY = 0.75
# Least share of them that is seen a third time, to know that the disparity stays doubled.
LEAST_SEEN_AGAIN = 0.5


def check(evidence: Evidence) -> Symptom | None:
    """Count the doubled tracks; halve the disparity of every sighting of theirs but the first."""
    observations = evidence.sequence.observations
    begun = _beginnings(observations)
    bad_frames = [k for k in np.unique(begun.frame).tolist() if _is_doubled(begun.select(begun.frame == k))]
    if not bad_frames:
        return None
    tracks = begun.track_id[np.isin(begun.frame, bad_frames) & (begun.first_ratio > LEAST_RATIO)]
    where = f"frame {bad_frames[0]}" if len(bad_frames) == 1 else f"{len(bad_frames)} frames"
    return Symptom(
        count=tracks.size,
        detail=(
            f"the disparity of {tracks.size} tracks, of nearly all detected in {where}, doubles from their first "
            "sighting to the second and stays so"
        ),
        treatment="halved in every sighting but the first",
        remedy=replace(evidence.sequence, observations=_halved(observations, tracks)),
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
        """Return the tracks of a mask (T,)."""
        return _Beginnings(
            self.track_id[rows], self.frame[rows], self.first_px[rows], self.first_ratio[rows], self.second_ratio[rows]
        )


def _beginnings(observations: Observations) -> _Beginnings:
    order = by_track(observations)
    track_id, frame = observations.track_id[order], observations.frame[order]
    disparity = disparity_px(observations.uv_px)[order]
    follows = (np.diff(track_id) == 0) & (np.diff(frame) == 1) & (disparity[:-1] > LEAST_DISPARITY_PX)
    # From row n to row n + 1; two more rows, because the last sighting may be the only one of its track.
    ratio = np.full(track_id.size + 1, np.nan)
    np.divide(disparity[1:], disparity[:-1], out=ratio[: follows.size], where=follows)
    first = np.flatnonzero(np.diff(track_id, prepend=-1))
    begun = _Beginnings(track_id[first], frame[first], disparity[first], ratio[first], ratio[first + 1])
    return begun.select(np.isfinite(begun.first_ratio))


def _doubles(ratio: Array) -> BoolArray:
    return np.asarray((ratio > LEAST_RATIO) & (ratio < LARGEST_RATIO))


def _is_doubled(begun: _Beginnings) -> bool:
    """Say whether nearly all of the tracks double once and keep the doubled disparity."""
    doubled, again = _doubles(begun.first_ratio), np.isfinite(begun.second_ratio)
    if doubled.size < LEAST_TRACKS or doubled.mean() < LEAST_SHARE or again.mean() < LEAST_SEEN_AGAIN:
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


FAULT = Fault(
    "doubled-disparity",
    "tracks whose disparity doubles from their first sighting to the second",
    check,
    # A track through a stale frame or an absence may continue at another point, and must have been split before.
    after=("time-order", "returning-tracks", "stale-frames", "swapped-coordinates"),
)
