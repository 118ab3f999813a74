"""Faults of the tracks: lost, mismatched, exchanged or displaced sightings."""

from dataclasses import replace
from itertools import pairwise

import numpy as np

from toolkit.geometry import BoolArray
from toolkit.models.stereo import project, triangulate
from toolkit.sequence import Observations, Sequence
from toolkit.simulation.faults.parts import span_s, with_pixels


def dropped_sightings(sequence: Sequence, dose: float = 0.1, seed: int = 0) -> Sequence:
    """Lose a share of the sightings, each independently: a matcher that sometimes fails, or lost data packets."""
    kept = np.random.default_rng(seed).uniform(size=len(sequence.observations)) >= dose
    return replace(sequence, observations=sequence.observations.select(kept))


def missing_right(sequence: Sequence, dose: float = 0.33, seed: int = 0) -> Sequence:
    """Lose the right image of a share of the sightings, each independently: a stereo matcher that sometimes fails."""
    uv_px = sequence.observations.uv_px.copy()
    uv_px[np.random.default_rng(seed).uniform(size=len(uv_px)) < dose, 1] = np.nan
    return with_pixels(sequence, uv_px)


def blackout(sequence: Sequence, dose: float = 1.0, seed: int = 0) -> Sequence:
    """Lose all sightings for the dose (s), and start new tracks after that: a tunnel, glare, a covered lens."""
    seen, begin_s, end_s = sequence.observations, *span_s(sequence, dose, seed)
    time_s = sequence.frames_s[seen.frame]
    later = time_s >= end_s
    track_id = np.where(later, seen.track_id + seen.track_id.max(initial=-1) + 1, seen.track_id)
    rows = (time_s < begin_s) | later
    return replace(sequence, observations=Observations(seen.frame, track_id, seen.uv_px).select(rows))


def outlier_tracks(sequence: Sequence, dose: float = 0.3, seed: int = 0) -> Sequence:
    """Let a share of the tracks slide over the image by a steady few pixels a frame: points on moving vehicles."""
    rng, seen = np.random.default_rng(seed), sequence.observations
    track, first, row = np.unique(seen.track_id, return_index=True, return_inverse=True)
    slides = rng.uniform(size=track.size) < dose
    angle, speed_px = rng.uniform(0.0, 2.0 * np.pi, track.size), rng.uniform(1.0, 6.0, track.size)
    step_px = (slides * speed_px * np.stack([np.cos(angle), np.sin(angle)])).T
    age = seen.frame - seen.frame[first][row]
    return with_pixels(sequence, seen.uv_px + age[:, None] * step_px[row][:, [0, 0, 1]])


def moving_objects(sequence: Sequence, dose: float = 0.5, seed: int = 0) -> Sequence:
    """Let a share of the points move as one for a third of the recording: traffic that flows with the vehicle.

    They move in the camera's axes, level in the image, by a quarter of the scene's median depth a second. What comes
    closer than half a metre is lost.
    """
    seen, rig = sequence.observations, sequence.rig
    rng, (begin_s, end_s) = np.random.default_rng(seed), span_s(sequence, sequence.duration_s / 3.0, seed)
    seen_s = sequence.frames_s[seen.frame]
    moves = _struck_tracks(sequence, dose, seed) & (seen.uv_px[:, 0] > seen.uv_px[:, 1])
    moves &= (seen_s >= begin_s) & (seen_s < end_s)
    angle, points = rng.uniform(0.0, 2.0 * np.pi), triangulate(seen.uv_px[moves], rig)
    velocity_mps = 0.25 * np.median(points[:, 2]) * np.array([np.cos(angle), 0.0, np.sin(angle)])
    _, first, row = np.unique(seen.track_id[moves], return_index=True, return_inverse=True)
    moved = points + (seen_s[moves] - seen_s[moves][first][row])[:, None] * velocity_mps
    uv_px, kept = seen.uv_px.copy(), np.ones(len(seen), dtype=bool)
    kept[moves] = moved[:, 2] > 0.5
    uv_px[moves & kept] = project(moved[kept[moves]], rig)
    return replace(sequence, observations=Observations(seen.frame, seen.track_id, uv_px).select(kept))


def few_tracks(sequence: Sequence, dose: float = 3.0, seed: int = 0) -> Sequence:
    """Keep at most the dose in tracks a frame, each for as long as it lasts: fog, a bare wall, a cheap tracker."""
    seen = sequence.observations
    chance = np.random.default_rng(seed).permutation(int(seen.track_id.max(initial=-1)) + 1)
    followed, kept = np.empty(0, dtype=np.int64), np.zeros(len(seen), dtype=bool)
    first = np.searchsorted(seen.frame, np.arange(sequence.frame_count + 1))
    for begin, end in pairwise(first.tolist()):
        here = seen.track_id[begin:end]
        followed = followed[np.isin(followed, here)]
        others = np.setdiff1d(here, followed)
        free = max(int(dose) - followed.size, 0)
        followed = np.concatenate([followed, others[np.argsort(chance[others])][:free]])
        kept[begin:end] = np.isin(here, followed)
    return replace(sequence, observations=seen.select(kept))


def one_sided_view(sequence: Sequence, dose: float = 0.5, seed: int = 0) -> Sequence:
    """Lose a share of the image, starting at its left or its right edge: a dirty lens, a wall on one side only."""
    seen, side = sequence.observations, np.random.default_rng(seed).choice([-1.0, 1.0])
    across = side * seen.uv_px[:, 0]
    hidden = across < np.quantile(across, dose) if len(seen) else np.zeros(0, dtype=bool)
    return replace(sequence, observations=seen.select(~hidden))


def swapped_images(sequence: Sequence, dose: float = 1.0, seed: int = 0) -> Sequence:
    """Exchange left and right in a share of the tracks; in all of them if the cameras' cables are exchanged."""
    seen, struck = sequence.observations, _struck_tracks(sequence, dose, seed)
    return with_pixels(sequence, np.where(struck[:, None], seen.uv_px[:, [1, 0, 2]], seen.uv_px))


def swapped_coordinates(sequence: Sequence, dose: float = 1.0, seed: int = 0) -> Sequence:
    """Exchange u and v in a share of the tracks: row and column mixed up by who wrote the file.

    uL and uR become the two rows, which differ by their noise alone, and v the mean of the two columns.
    """
    seen, struck = sequence.observations, _struck_tracks(sequence, dose, seed)
    sigma_px = np.sqrt(sequence.rig.cov_uv_px2[2, 2])
    apart_px = sigma_px * np.random.default_rng(seed).standard_normal(len(seen))
    v_px = seen.uv_px[:, 2]
    swapped = np.stack([v_px + apart_px, v_px - apart_px, seen.uv_px[:, :2].mean(axis=1)], axis=1)
    return with_pixels(sequence, np.where(struck[:, None], swapped, seen.uv_px))


def shifted_pixels(sequence: Sequence, dose: float = 5000.0, seed: int = 0) -> Sequence:
    """Add the dose (px) to every image coordinate: pixels of a crop or a mosaic, or of another origin."""
    return with_pixels(sequence, sequence.observations.uv_px + dose)


def misaligned_rows(sequence: Sequence, dose: float = 12.0, seed: int = 0) -> Sequence:
    """Shift vR by the dose (px) against vL: a pair that is not rectified. v, their mean, shifts by half of it."""
    return with_pixels(sequence, sequence.observations.uv_px + np.array([0.0, 0.0, 0.5 * dose]))


def rolled_right(sequence: Sequence, dose: float = 0.01, seed: int = 0) -> Sequence:
    """Roll the right camera by the dose (rad) about its optical axis: a mount that was bent after the calibration.

    Columns and rows of the right image rotate about the principal point; v, the mean of both rows, by half of it.
    """
    rig, uv_px = sequence.rig, sequence.observations.uv_px.copy()
    across, down = (uv_px[:, 1] - rig.cx_px) / rig.fx_px, (uv_px[:, 2] - rig.cy_px) / rig.fy_px
    row_px = rig.cy_px + rig.fy_px * (np.cos(dose) * down - np.sin(dose) * across)
    uv_px[:, 1] = rig.cx_px + rig.fx_px * (np.cos(dose) * across + np.sin(dose) * down)
    uv_px[:, 2] = np.where(np.isnan(row_px), uv_px[:, 2], 0.5 * (uv_px[:, 2] + row_px))
    return with_pixels(sequence, uv_px)


def shifted_right(sequence: Sequence, dose: float = 0.5, seed: int = 0) -> Sequence:
    """Add the dose (px) to the columns of the right image: cameras that turned apart, two principal points."""
    return with_pixels(sequence, sequence.observations.uv_px + dose * np.array([0.0, 1.0, 0.0]))


def stretched_disparity(sequence: Sequence, dose: float = 1.05, seed: int = 0) -> Sequence:
    """Multiply all disparities by the dose: images scaled after the matching, a matcher that is biased."""
    uv_px = sequence.observations.uv_px.copy()
    uv_px[:, 1] = uv_px[:, 0] - dose * (uv_px[:, 0] - uv_px[:, 1])
    return with_pixels(sequence, uv_px)


def jumped_image(sequence: Sequence, dose: float = 15.0, seed: int = 0) -> Sequence:
    """Shift every image of the second half by the dose (px): a camera that is knocked, a crop that changes."""
    later = sequence.observations.frame >= sequence.frame_count // 2
    return with_pixels(sequence, sequence.observations.uv_px + dose * later[:, None])


def exchanged_tracks(sequence: Sequence, dose: float = 0.1, seed: int = 0) -> Sequence:
    """Exchange the ids of a share of the sightings with others of their frame: a matcher that takes the wrong point."""
    rng, seen = np.random.default_rng(seed), sequence.observations
    track_id, struck = seen.track_id.copy(), rng.uniform(size=len(seen)) < dose
    for begin, end in pairwise(np.searchsorted(seen.frame, np.arange(sequence.frame_count + 1)).tolist()):
        rows = begin + np.flatnonzero(struck[begin:end])
        track_id[rows] = track_id[rng.permutation(rows)]
    return replace(sequence, observations=Observations.sorted(seen.frame, track_id, seen.uv_px))


def _struck_tracks(sequence: Sequence, share: float, seed: int) -> BoolArray:
    """Say of each sighting (N,) whether its track is in the share that is affected."""
    track, row = np.unique(sequence.observations.track_id, return_inverse=True)
    return np.asarray((np.random.default_rng(seed).uniform(size=track.size) < share)[row])
