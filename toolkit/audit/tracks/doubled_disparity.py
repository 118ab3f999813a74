"""Tracks whose disparity doubles from their first sighting to their second, and stays doubled.

A tracker that adds the disparity to a guess that holds it already does that to every track it has just detected.
To an estimator such points are half as far away, so the camera moves half as fast. No motion does the same: it
would have to halve the depth of near and far points alike, in one interval, and then stop.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from toolkit.audit.fault import Evidence, Fault, Symptom
from toolkit.audit.parts.tracks import by_track
from toolkit.geometry import Array, BoolArray, IntArray
from toolkit.models.gating import LEAST_DISPARITY_PX
from toolkit.models.stereo import disparity_px
from toolkit.sequence import Observations

# What counts as doubled is nearer to twice than to once or four times; noise and the motion itself do the rest.
LEAST_RATIO, LARGEST_RATIO = np.sqrt(2.0), np.sqrt(8.0)
# Share of the tracks detected in a frame. Measured: 0.96 to 1 where they are doubled, at most 0.22 in any other
# frame of the real recordings and 0.40 in simulated ones, where few and far points begin a track.
LEAST_SHARE, LEAST_TRACKS = 0.8, 6


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
    """Tracks (T,), the frame of their first sighting, and the disparities' ratios, second to first and third to second.

    Only tracks whose first ratio is known; a second ratio that is not is NaN.
    """

    track_id: IntArray
    frame: IntArray
    first_ratio: Array
    second_ratio: Array

    def select(self, rows: BoolArray) -> "_Beginnings":
        """Return the tracks of a mask (T,)."""
        return _Beginnings(self.track_id[rows], self.frame[rows], self.first_ratio[rows], self.second_ratio[rows])


def _beginnings(observations: Observations) -> _Beginnings:
    order = by_track(observations)
    track_id, frame = observations.track_id[order], observations.frame[order]
    disparity = disparity_px(observations.uv_px)[order]
    follows = (np.diff(track_id) == 0) & (np.diff(frame) == 1) & (disparity[:-1] > LEAST_DISPARITY_PX)
    # From row n to row n + 1. Two rows more, for the last sighting may be a track's only one.
    ratio = np.full(track_id.size + 1, np.nan)
    np.divide(disparity[1:], disparity[:-1], out=ratio[: follows.size], where=follows)
    first = np.flatnonzero(np.diff(track_id, prepend=-1))
    begun = _Beginnings(track_id[first], frame[first], ratio[first], ratio[first + 1])
    return begun.select(np.isfinite(begun.first_ratio))


def _doubles(ratio: Array) -> BoolArray:
    return np.asarray((ratio > LEAST_RATIO) & (ratio < LARGEST_RATIO))


def _is_doubled(begun: _Beginnings) -> bool:
    """Say whether nearly all of the tracks double once and stay so."""
    doubled, goes_on = _doubles(begun.first_ratio), _doubles(begun.second_ratio)
    return bool(doubled.size >= LEAST_TRACKS and doubled.mean() >= LEAST_SHARE and goes_on.mean() < LEAST_SHARE)


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
    # A track through a stale frame, or one that was lost, is no longer the one that was detected.
    after=("time-order", "returning-tracks", "stale-frames", "swapped-coordinates"),
)
