"""Frames whose tracks repeat the previous frame's pixels exactly while the vehicle moves.

From such a frame on, each track follows a different scene point: its steps before and after agree with the motion,
while the step into the stale frame is zero. A standing camera also repeats pixels, which is no fault. Therefore the
image must move just before and just after or, at the ends of a recording, the samples must show motion.
"""

from dataclasses import replace

import numpy as np

from toolkit.audit.fault import Evidence, Fault, Symptom
from toolkit.audit.parts.edits import by_track, split
from toolkit.audit.parts.intervals import interval_means, is_comparable
from toolkit.geometry import Array, BoolArray
from toolkit.models.camera_motion import Neighbours, neighbours
from toolkit.resampling import NS_PER_S
from toolkit.sequence import Observations, Sequence

# Share of a frame's surviving tracks that must repeat. Measured: in the recordings at hand it is 1 in a stale
# frame of a moving vehicle and 0 in any other.
LEAST_SHARE = 0.9
# Tracks that must survive into the frame: fewer could repeat by chance where pixels are rounded.
LEAST_TRACKS = 4
# Upper quartile of the pixel steps above which the camera moves (far points hardly move). Measured: at least 0.96 px
# beside a stale frame, at most 0.05 px with the vehicle parked.
MOVING_PX = 0.5
# The samples show motion where they rotate the image by more than this (px) from frame to frame, which no gyro bias
# does, or where odometry is faster than this (m/s).
TURNING_PX, DRIVING_MPS = 2.0, 1.0


def check(evidence: Evidence) -> Symptom | None:
    """Count the stale frames; every repeated track ends there and a new one starts at the next frame."""
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
    return Symptom(
        count=count,
        detail=(
            f"{count} of {sequence.frame_count} frames repeat the pixels of the frame before them exactly while the "
            f"vehicle moves ({repeated.sum()} sightings)"
        ),
        treatment="every repeated track ends there, the repeats are dropped, and a new track starts at the next frame",
        remedy=_cut_tracks(sequence, repeated),
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
    frozen = (repeats >= LEAST_SHARE * survivors) & (survivors >= LEAST_TRACKS)
    moving = _typical_step_px(intervals, pairs, step_px) > MOVING_PX
    # The nearest interval on either side that is not frozen; beyond the ends there is none. Intervals with hardly any
    # surviving track, as at the end of a long freeze, are passed over as well.
    index, shows_nothing = np.arange(intervals), frozen | (survivors < LEAST_TRACKS)
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
    order = by_track(observations)
    starts = np.zeros(len(observations), dtype=bool)
    starts[order[1:]] = repeated[order[:-1]]
    track_id, kept = split(observations, starts), ~repeated
    cut = Observations.sorted(observations.frame[kept], track_id[kept], observations.uv_px[kept])
    return replace(sequence, observations=cut)


FAULT = Fault(
    "stale-frames",
    "frames whose tracks repeat the previous frame's pixels exactly while the vehicle moves",
    check,
    # Dropped sightings would hide that a track passes through a stale frame.
    after=("time-order", "returning-tracks"),
)
