"""Faults to plant in a recording: what goes wrong with trackers, motion sensors, clocks, calibrations and units.

Every injector is ``fault(sequence, dose, seed) -> Sequence``: it leaves what it is given as it is, draws where and
whom it strikes from the seed, and can be followed by another. The dose is in the unit its docstring names. The truth
stays that of the motion, unless the fault is one of the truth.
"""

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np

from toolkit.errors import DataError
from toolkit.geometry import Array, BoolArray, se3, se3_inverse, so3_exp
from toolkit.models.stereo import project, triangulate
from toolkit.sequence import Observations, Sequence, Truth
from toolkit.simulation.clock_faults import alternate_frames_late as alternate_frames_late  # noqa: PLC0414 - injectors
from toolkit.simulation.clock_faults import camera_clock as camera_clock  # noqa: PLC0414 - like those below
from toolkit.simulation.clock_faults import camera_clock_drift as camera_clock_drift  # noqa: PLC0414
from toolkit.simulation.clock_faults import camera_clock_step as camera_clock_step  # noqa: PLC0414
from toolkit.simulation.clock_faults import clock_jump as clock_jump  # noqa: PLC0414
from toolkit.simulation.clock_faults import frame_jitter as frame_jitter  # noqa: PLC0414
from toolkit.simulation.spans import span_s
from toolkit.simulation.standstill import standstill as standstill  # noqa: PLC0414 - an injector like those below

Fault = Callable[[Sequence, float, int], Sequence]

# The tracks ---------------------------------------------------------------------------------------------------------


def dropped_sightings(sequence: Sequence, dose: float = 0.1, seed: int = 0) -> Sequence:
    """Lose a share of the sightings, each by itself: a matcher that fails now and then, or packets lost on the way."""
    kept = np.random.default_rng(seed).uniform(size=len(sequence.observations)) >= dose
    return replace(sequence, observations=sequence.observations.select(kept))


def missing_right(sequence: Sequence, dose: float = 0.33, seed: int = 0) -> Sequence:
    """Lose the right image of a share of the sightings, each by itself: a stereo matcher that fails now and then."""
    uv_px = sequence.observations.uv_px.copy()
    uv_px[np.random.default_rng(seed).uniform(size=len(uv_px)) < dose, 1] = np.nan
    return _with_pixels(sequence, uv_px)


def blackout(sequence: Sequence, dose: float = 1.0, seed: int = 0) -> Sequence:
    """See nothing for so many seconds, and new tracks after that: a tunnel, glare, a covered lens."""
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
    return _with_pixels(sequence, seen.uv_px + age[:, None] * step_px[row][:, [0, 0, 1]])


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
    """Keep so many tracks a frame at most, each for as long as it lasts: fog, a bare wall, a cheap tracker."""
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
    """Lose a share of the image, from its left or its right edge on: a dirty lens, a wall on one side only."""
    seen, side = sequence.observations, np.random.default_rng(seed).choice([-1.0, 1.0])
    across = side * seen.uv_px[:, 0]
    hidden = across < np.quantile(across, dose) if len(seen) else np.zeros(0, dtype=bool)
    return replace(sequence, observations=seen.select(~hidden))


def swapped_images(sequence: Sequence, dose: float = 1.0, seed: int = 0) -> Sequence:
    """Exchange left and right in a share of the tracks; all of them where the cameras' cables are exchanged."""
    seen, struck = sequence.observations, _struck_tracks(sequence, dose, seed)
    return _with_pixels(sequence, np.where(struck[:, None], seen.uv_px[:, [1, 0, 2]], seen.uv_px))


def swapped_coordinates(sequence: Sequence, dose: float = 1.0, seed: int = 0) -> Sequence:
    """Exchange u and v in a share of the tracks: row and column mixed up by who wrote the file.

    uL and uR become the two rows, which differ by their noise alone, and v the mean of the two columns.
    """
    seen, struck = sequence.observations, _struck_tracks(sequence, dose, seed)
    sigma_px = np.sqrt(sequence.rig.cov_uv_px2[2, 2])
    apart_px = sigma_px * np.random.default_rng(seed).standard_normal(len(seen))
    v_px = seen.uv_px[:, 2]
    swapped = np.stack([v_px + apart_px, v_px - apart_px, seen.uv_px[:, :2].mean(axis=1)], axis=1)
    return _with_pixels(sequence, np.where(struck[:, None], swapped, seen.uv_px))


def shifted_pixels(sequence: Sequence, dose: float = 5000.0, seed: int = 0) -> Sequence:
    """Add so many pixels to every image coordinate: pixels of a crop, of a mosaic, or counted from elsewhere."""
    return _with_pixels(sequence, sequence.observations.uv_px + dose)


def misaligned_rows(sequence: Sequence, dose: float = 12.0, seed: int = 0) -> Sequence:
    """Put vR so many pixels off vL: a pair that is not rectified, or no longer. v, their mean, is off by half of it."""
    return _with_pixels(sequence, sequence.observations.uv_px + np.array([0.0, 0.0, 0.5 * dose]))


def rolled_right(sequence: Sequence, dose: float = 0.01, seed: int = 0) -> Sequence:
    """Roll the right camera by the dose (rad) about its optical axis: a mount that was bent after the calibration.

    Columns and rows of the right image turn about the principal point; v, the mean of both rows, by half of it.
    """
    rig, uv_px = sequence.rig, sequence.observations.uv_px.copy()
    across, down = (uv_px[:, 1] - rig.cx_px) / rig.fx_px, (uv_px[:, 2] - rig.cy_px) / rig.fy_px
    row_px = rig.cy_px + rig.fy_px * (np.cos(dose) * down - np.sin(dose) * across)
    uv_px[:, 1] = rig.cx_px + rig.fx_px * (np.cos(dose) * across + np.sin(dose) * down)
    uv_px[:, 2] = np.where(np.isnan(row_px), uv_px[:, 2], 0.5 * (uv_px[:, 2] + row_px))
    return _with_pixels(sequence, uv_px)


def shifted_right(sequence: Sequence, dose: float = 0.5, seed: int = 0) -> Sequence:
    """Add so many pixels to the columns of the right image: cameras that turned apart, two principal points."""
    return _with_pixels(sequence, sequence.observations.uv_px + dose * np.array([0.0, 1.0, 0.0]))


def stretched_disparity(sequence: Sequence, dose: float = 1.05, seed: int = 0) -> Sequence:
    """Multiply all disparities by the dose: images scaled after the matching, a matcher that is biased."""
    uv_px = sequence.observations.uv_px.copy()
    uv_px[:, 1] = uv_px[:, 0] - dose * (uv_px[:, 0] - uv_px[:, 1])
    return _with_pixels(sequence, uv_px)


def jumped_image(sequence: Sequence, dose: float = 15.0, seed: int = 0) -> Sequence:
    """Shift every image of the second half by so many pixels: a camera that is knocked, a crop that changes."""
    later = sequence.observations.frame >= sequence.frame_count // 2
    return _with_pixels(sequence, sequence.observations.uv_px + dose * later[:, None])


def exchanged_tracks(sequence: Sequence, dose: float = 0.1, seed: int = 0) -> Sequence:
    """Exchange the ids of a share of the sightings with others of their frame: a matcher that takes the wrong point."""
    rng, seen = np.random.default_rng(seed), sequence.observations
    track_id, struck = seen.track_id.copy(), rng.uniform(size=len(seen)) < dose
    for begin, end in pairwise(np.searchsorted(seen.frame, np.arange(sequence.frame_count + 1)).tolist()):
        rows = begin + np.flatnonzero(struck[begin:end])
        track_id[rows] = track_id[rng.permutation(rows)]
    return replace(sequence, observations=Observations.sorted(seen.frame, track_id, seen.uv_px))


# The motion samples -------------------------------------------------------------------------------------------------


def motion_gap(sequence: Sequence, dose: float = 0.5, seed: int = 0) -> Sequence:
    """Lose the motion samples of so many seconds: a full buffer, a loose cable."""
    begin_s, end_s = span_s(sequence, dose, seed)
    t_s = sequence.elapsed_s(sequence.motion.t_ns)
    return _with_samples(sequence, (t_s <= begin_s) | (t_s >= end_s))


def stuck_motion(sequence: Sequence, dose: float = 0.5, seed: int = 0) -> Sequence:
    """Repeat the last motion sample for so many seconds: a driver that hangs."""
    begin_s, end_s = span_s(sequence, dose, seed)
    t_s, values = sequence.elapsed_s(sequence.motion.t_ns), sequence.motion.values.copy()
    stuck = (t_s > begin_s) & (t_s < end_s)
    values[stuck] = values[max(int(np.argmax(stuck)) - 1, 0)]
    return _with_values(sequence, values)


def saturated_motion(sequence: Sequence, dose: float = 0.5, seed: int = 0) -> Sequence:
    """Cut the motion samples off at this share of the largest on each axis: a sensor of too small a range."""
    values = sequence.motion.values
    largest = dose * np.abs(values).max(axis=0, initial=0.0)
    return _with_values(sequence, np.clip(values, -largest, largest))


def spike(sequence: Sequence, dose: float = 1e300, seed: int = 0) -> Sequence:
    """Give one motion sample the value of the dose on one axis: a flipped bit, a failed parse."""
    rng, values = np.random.default_rng(seed), sequence.motion.values.copy()
    values[rng.integers(len(values) // 4, 3 * len(values) // 4), rng.integers(6)] = dose
    return _with_values(sequence, values)


def disturbed_motion(sequence: Sequence, dose: float = 1.0, seed: int = 0) -> Sequence:
    """Add so many m/s, or m/s^2, along an axis drawn to a third of the motion samples: wheels that slip, vibration."""
    begin_s, end_s = span_s(sequence, sequence.duration_s / 3.0, seed)
    axis, t_s = np.random.default_rng(seed).standard_normal(3), sequence.elapsed_s(sequence.motion.t_ns)
    added = np.concatenate([dose * axis / np.linalg.norm(axis), np.zeros(3)])
    return _with_values(sequence, sequence.motion.values + ((t_s >= begin_s) & (t_s < end_s))[:, None] * added)


def nan_span(sequence: Sequence, dose: float = 0.25, seed: int = 0) -> Sequence:
    """Write NaN for all motion samples and sightings of so many seconds: a driver that gives up and comes back."""
    begin_s, end_s = span_s(sequence, dose, seed)
    values, uv_px = sequence.motion.values.copy(), sequence.observations.uv_px.copy()
    t_s, seen_s = sequence.elapsed_s(sequence.motion.t_ns), sequence.frames_s[sequence.observations.frame]
    values[(t_s > begin_s) & (t_s < end_s)] = np.nan
    uv_px[(seen_s > begin_s) & (seen_s < end_s)] = np.nan
    return _with_values(_with_pixels(sequence, uv_px), values)


def linear_unit(sequence: Sequence, dose: float = 3.6, seed: int = 0) -> Sequence:
    """Multiply velocities, or accelerations, by the dose: 3.6 for km/h, 100 for cm/s, 0.102 for g."""
    return _with_values(sequence, sequence.motion.values * np.repeat([dose, 1.0], 3))


def changed_speed(sequence: Sequence, dose: float = 1.08, seed: int = 0) -> Sequence:
    """Multiply the velocities, or accelerations, of the second half by the dose: a tyre that loses air."""
    later = sequence.motion.t_ns > sequence.frames_t_ns[sequence.frame_count // 2]
    factor = np.where(later[:, None], np.repeat([dose, 1.0], 3), 1.0)
    return _with_values(sequence, factor * sequence.motion.values)


def thinned_motion(sequence: Sequence, dose: float = 10.0, seed: int = 0) -> Sequence:
    """Keep every so many-th motion sample: a log that was thinned out, a bus that is busy."""
    return _with_samples(sequence, np.arange(sequence.motion.t_ns.size) % int(dose) == 0)


def angular_unit(sequence: Sequence, dose: float = 180.0 / np.pi, seed: int = 0) -> Sequence:
    """Multiply angular velocities by the dose: 57.3 for degrees."""
    return _with_values(sequence, sequence.motion.values * np.repeat([1.0, dose], 3))


def gyro_axis_scale(sequence: Sequence, dose: float = 0.9, seed: int = 0) -> Sequence:
    """Multiply the rates about the axis that turns most by the dose: a channel of another sensitivity."""
    scale = np.ones(6)
    scale[3 + int(np.argmax(np.std(sequence.motion.values[:, 3:], axis=0)))] = dose
    return _with_values(sequence, sequence.motion.values * scale)


def coarse_samples(sequence: Sequence, dose: float = 0.1, seed: int = 0) -> Sequence:
    """Round motion samples to multiples of the dose: a converter of few bits, a log of few digits."""
    return _with_values(sequence, dose * np.round(sequence.motion.values / dose))


def gyro_bias(sequence: Sequence, dose: float = 0.01, seed: int = 0) -> Sequence:
    """Add a constant of the dose (rad/s), in a direction drawn, to every angular velocity: a warm gyro."""
    axis = np.random.default_rng(seed).standard_normal(3)
    bias = np.concatenate([np.zeros(3), dose * axis / np.linalg.norm(axis)])
    return _with_values(sequence, sequence.motion.values + bias)


def wrong_noise(sequence: Sequence, dose: float = 2.0, seed: int = 0) -> Sequence:
    """State the dose times the noise of tracks and motion, which stay as they are: a data sheet of another sensor."""
    rig = replace(sequence.rig, cov_uv_px2=sequence.rig.cov_uv_px2 * dose**2)
    return replace(sequence, rig=rig, noise=sequence.noise.scaled(dose))


# The calibration and the truth; clocks are in ``clock_faults`` --------------------------------------------------------


def zero_intrinsics(sequence: Sequence, dose: float = 0.0, seed: int = 0) -> Sequence:
    """Give every intrinsic the value of the dose: a K nobody filled in."""
    return _with_rig(sequence, fx_px=dose, fy_px=dose, cx_px=dose, cy_px=dose)


def identity_intrinsics(sequence: Sequence, dose: float = 1.0, seed: int = 0) -> Sequence:
    """Give the focal lengths the value of the dose and put the centre to zero: K left at the identity."""
    return _with_rig(sequence, fx_px=dose, fy_px=dose, cx_px=0.0, cy_px=0.0)


def transposed_intrinsics(sequence: Sequence, dose: float = 0.0, seed: int = 0) -> Sequence:
    """Put the principal point to the dose: what a transposed K, read by its places, says."""
    return _with_rig(sequence, cx_px=dose, cy_px=dose)


def negative_focal(sequence: Sequence, dose: float = -1.0, seed: int = 0) -> Sequence:
    """Multiply the focal lengths by the dose: axes of a camera that looks backwards."""
    return _with_rig(sequence, fx_px=dose * sequence.rig.fx_px, fy_px=dose * sequence.rig.fy_px)


def wrong_focal_length(sequence: Sequence, dose: float = 1.05, seed: int = 0) -> Sequence:
    """Multiply both focal lengths by the dose: a data sheet instead of a calibration, another zoom."""
    return _with_rig(sequence, fx_px=dose * sequence.rig.fx_px, fy_px=dose * sequence.rig.fy_px)


def wrong_aspect(sequence: Sequence, dose: float = 1.05, seed: int = 0) -> Sequence:
    """Multiply fx alone by the dose: images that were resized in one direction."""
    return _with_rig(sequence, fx_px=dose * sequence.rig.fx_px)


def shifted_centre(sequence: Sequence, dose: float = 15.0, seed: int = 0) -> Sequence:
    """Write the principal point so many pixels away, in a direction drawn: the middle of the image taken for it."""
    angle = np.random.default_rng(seed).uniform(0.0, 2.0 * np.pi)
    cx_px, cy_px = sequence.rig.cx_px + dose * np.cos(angle), sequence.rig.cy_px + dose * np.sin(angle)
    return _with_rig(sequence, cx_px=float(cx_px), cy_px=float(cy_px))


def skewed_pixels(sequence: Sequence, dose: float = 50.0, seed: int = 0) -> Sequence:
    """Give the images a skew of the dose (px), as a K may state one that no rectified pair has."""
    rig, uv_px = sequence.rig, sequence.observations.uv_px
    shift_px = dose * (uv_px[:, 2:] - rig.cy_px) / rig.fy_px
    return _with_pixels(sequence, uv_px + shift_px * np.array([1.0, 1.0, 0.0]))


def baseline_unit(sequence: Sequence, dose: float = 1000.0, seed: int = 0) -> Sequence:
    """Multiply the baseline by the dose: 1000 for millimetres."""
    return _with_rig(sequence, baseline_m=dose * sequence.rig.baseline_m)


def extrinsic_unit(sequence: Sequence, dose: float = 1000.0, seed: int = 0) -> Sequence:
    """Multiply the camera's position in the IMU frame by the dose: 1000 for millimetres, -1 for a sign mixed up."""
    T_imu_cam = sequence.rig.T_imu_cam
    return _with_rig(sequence, T_imu_cam=se3(T_imu_cam[:3, :3], dose * T_imu_cam[:3, 3]))


def inverted_extrinsic(sequence: Sequence, dose: float = 1.0, seed: int = 0) -> Sequence:
    """Invert the extrinsic: IMU to camera written where camera to IMU is read. A dose of 0 leaves it."""
    return _with_rig(sequence, T_imu_cam=se3_inverse(sequence.rig.T_imu_cam)) if dose else sequence


def turned_camera(sequence: Sequence, dose: float = 0.05, seed: int = 0) -> Sequence:
    """Turn the camera in its mount by the dose (rad) about an axis drawn: a knock, a calibration of another day."""
    axis = np.random.default_rng(seed).standard_normal(3)
    T_imu_cam = sequence.rig.T_imu_cam
    return _with_rig(sequence, T_imu_cam=T_imu_cam @ se3(so3_exp(dose * axis / np.linalg.norm(axis)), np.zeros(3)))


def displaced_camera(sequence: Sequence, dose: float = 0.3, seed: int = 0) -> Sequence:
    """Write the camera so many metres from where it is, in a direction drawn: a tape measure, a bracket moved since."""
    axis, T_imu_cam = np.random.default_rng(seed).standard_normal(3), sequence.rig.T_imu_cam
    displaced = se3(T_imu_cam[:3, :3], T_imu_cam[:3, 3] + dose * axis / np.linalg.norm(axis))
    return _with_rig(sequence, T_imu_cam=displaced)


def truth_unit(sequence: Sequence, dose: float = 1000.0, seed: int = 0) -> Sequence:
    """Multiply the true positions and velocities by the dose: 1000 for millimetres."""
    truth = _truth_of(sequence)
    T_world_imu = se3(truth.T_world_imu[:, :3, :3], dose * truth.T_world_imu[:, :3, 3])
    v_world = None if truth.v_world is None else dose * truth.v_world
    return replace(sequence, truth=replace(truth, T_world_imu=T_world_imu, v_world=v_world))


def truth_clock_rate(sequence: Sequence, dose: float = 1.03, seed: int = 0) -> Sequence:
    """Multiply the time of the truth, from its first pose on, by the dose: a quartz of another temperature."""
    truth = _truth_of(sequence)
    since_ns = np.rint(dose * (truth.t_ns - truth.t_ns[0])).astype(np.int64)
    return replace(sequence, truth=replace(truth, t_ns=truth.t_ns[0] + since_ns))


def unwritten_orientations(sequence: Sequence, dose: float = 1.0, seed: int = 0) -> Sequence:
    """Write every true orientation as the identity: a file of positions alone. A dose of 0 leaves them."""
    truth = _truth_of(sequence)
    T_world_imu = se3(np.broadcast_to(np.eye(3), (len(truth.t_ns), 3, 3)), truth.T_world_imu[:, :3, 3])
    return replace(sequence, truth=replace(truth, T_world_imu=T_world_imu)) if dose else sequence


def _truth_of(sequence: Sequence) -> Truth:
    if sequence.truth is None:
        raise DataError(f"{sequence.name}: no truth, which could be wrong")
    return sequence.truth


def _struck_tracks(sequence: Sequence, share: float, seed: int) -> BoolArray:
    """Say of each sighting (N,) whether its track is of the share that is struck."""
    track, row = np.unique(sequence.observations.track_id, return_inverse=True)
    return np.asarray((np.random.default_rng(seed).uniform(size=track.size) < share)[row])


def _with_pixels(sequence: Sequence, uv_px: Array) -> Sequence:
    return replace(sequence, observations=replace(sequence.observations, uv_px=uv_px))


def _with_values(sequence: Sequence, values: Array) -> Sequence:
    """Return the sequence with other values (S, 6) of its motion samples."""
    return replace(sequence, motion=sequence.motion.of(sequence.motion.t_ns, values))


def _with_samples(sequence: Sequence, kept: BoolArray) -> Sequence:
    arrays: dict[str, Any] = {k: x[kept] for k, x in vars(sequence.motion).items() if isinstance(x, np.ndarray)}
    return replace(sequence, motion=replace(sequence.motion, **arrays))


def _with_rig(sequence: Sequence, **fields: Any) -> Sequence:
    return replace(sequence, rig=replace(sequence.rig, **fields))
