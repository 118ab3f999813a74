"""Faults to plant in a recording: of trackers, motion sensors, clocks, calibrations and units.

Every injector is ``fault(sequence, dose, seed) -> Sequence``: it returns a changed copy, draws the affected times and
tracks from the seed, and can be followed by another. The dose is in the unit its docstring names. The truth stays that
of the motion, unless the fault is one of the truth.
"""

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from typing import Any, NamedTuple, TypeVar

import numpy as np

from toolkit.errors import DataError
from toolkit.geometry import Array, BoolArray, IntArray, se3, se3_inverse, so3_exp
from toolkit.measurements import NS_PER_S, TwistNoise
from toolkit.models.stereo import project, triangulate
from toolkit.motion_samples import TwistSamples
from toolkit.sequence import Observations, Sequence, Truth
from toolkit.simulation.sensors import TrackNoise, with_slips, with_track_noise

Fault = Callable[[Sequence, float, int], Sequence]
F = TypeVar("F", bound=Fault)
# Names of faults with their doses, planted one after the other.
Doses = tuple[tuple[str, float], ...]
# Points whose tracks begin within this many seconds are on one vehicle.
_ONE_VEHICLE_S = 2.0


# What can be planted --------------------------------------------------------------------------------------------------


class Injector(NamedTuple):
    """A fault that a dose leads up to: ``clean`` is the dose that leaves a recording as it is."""

    plant: Fault
    unit: str
    clean: float

    @property
    def meaning(self) -> str:
        """Return what it does, and what it stands for, in one sentence."""
        return (self.plant.__doc__ or "").partition("\n")[0]


INJECTORS: dict[str, Injector] = {}


def _injector(unit: str, clean: float = 0.0) -> Callable[[F], F]:
    """Register a fault by its name, with the unit of its dose and the dose of a clean recording."""

    def registered(fault: F) -> F:
        INJECTORS[fault.__name__] = Injector(fault, unit, clean)
        return fault

    return registered


def planted(sequence: Sequence, doses: Doses, seed: int) -> Sequence:
    """Return a sequence with faults planted, each drawn by itself from the seed: a smaller dose strikes the same first.

    Raises DataError where a fault cannot be planted in it, or its dose leaves no recording.
    """
    for name, dose in doses:
        own_seed = int(np.random.SeedSequence([seed, *name.encode()]).generate_state(1)[0])
        try:
            sequence = INJECTORS[name].plant(sequence, dose, own_seed)
            if sequence.frame_count < 2:
                raise ValueError("no recording is left")
        except (ValueError, OverflowError, MemoryError) as error:  # NumPy's, of a dose that is out of all bounds
            unit = INJECTORS[name].unit
            raise DataError(f"{name}: a dose of {dose:g} {unit} cannot be planted ({error}); name another") from error
    return sequence


# Tracks: single sightings, and whole tracks ---------------------------------------------------------------------------


@_injector("share")
def dropped_sightings(sequence: Sequence, dose: float = 0.1, seed: int = 0) -> Sequence:
    """Lose a share of the sightings, each independently: a matcher that sometimes fails, or lost data packets."""
    kept = np.random.default_rng(seed).uniform(size=len(sequence.observations)) >= dose
    return replace(sequence, observations=sequence.observations.select(kept))


@_injector("share")
def dropped_frames(sequence: Sequence, dose: float = 0.1, seed: int = 0) -> Sequence:
    """Lose a share of the frames, each independently, but the first and the last: a full disk, a busy computer."""
    kept = np.random.default_rng(seed).uniform(size=sequence.frame_count) >= dose
    kept[[0, -1]] = True
    return sequence.with_frames(np.flatnonzero(kept))


@_injector("share")
def missing_right(sequence: Sequence, dose: float = 0.33, seed: int = 0) -> Sequence:
    """Lose the right image of a share of the sightings, each independently: a stereo matcher that sometimes fails."""
    uv_px = sequence.observations.uv_px.copy()
    uv_px[np.random.default_rng(seed).uniform(size=len(uv_px)) < dose, 1] = np.nan
    return _with_pixels(sequence, uv_px)


@_injector("s")
def blackout(sequence: Sequence, dose: float = 1.0, seed: int = 0) -> Sequence:
    """Lose all sightings for the dose (s), and start new tracks after that: a tunnel, glare, a covered lens."""
    seen, begin_s, end_s = sequence.observations, *_span_s(sequence, dose, seed)
    time_s = sequence.frames_s[seen.frame]
    later = (time_s >= end_s) & (dose > 0.0)
    track_id = np.where(later, seen.track_id + seen.track_id.max(initial=-1) + 1, seen.track_id)
    rows = (time_s < begin_s) | (time_s >= end_s)
    return replace(sequence, observations=Observations(seen.frame, track_id, seen.uv_px).select(rows))


@_injector("share")
def outlier_tracks(sequence: Sequence, dose: float = 0.3, seed: int = 0) -> Sequence:
    """Let a share of the tracks slide over the image by a steady few pixels a frame: points on moving vehicles."""
    rng, seen = np.random.default_rng(seed), sequence.observations
    track, first, row = np.unique(seen.track_id, return_index=True, return_inverse=True)
    slides = rng.uniform(size=track.size) < dose
    angle, speed_px = rng.uniform(0.0, 2.0 * np.pi, track.size), rng.uniform(1.0, 6.0, track.size)
    step_px = (slides * speed_px * np.stack([np.cos(angle), np.sin(angle)])).T
    age = seen.frame - seen.frame[first][row]
    return _with_pixels(sequence, seen.uv_px + age[:, None] * step_px[row][:, [0, 0, 1]])


@_injector("share")
def moving_objects(sequence: Sequence, dose: float = 0.5, seed: int = 0) -> Sequence:
    """Let a share of the points move as one for a third of the recording: traffic that flows with the vehicle.

    They move in the camera's axes, level in the image, by a quarter of the scene's median depth a second. What comes
    closer than half a metre is lost.
    """
    seen, rig = sequence.observations, sequence.rig
    rng, (begin_s, end_s) = np.random.default_rng(seed), _span_s(sequence, sequence.duration_s / 3.0, seed)
    seen_s = sequence.frames_s[seen.frame]
    moves = _struck_tracks(sequence, dose, seed) & (seen.uv_px[:, 0] > seen.uv_px[:, 1])
    moves &= (seen_s >= begin_s) & (seen_s < end_s)
    if not moves.any():
        return sequence
    angle, points = rng.uniform(0.0, 2.0 * np.pi), triangulate(seen.uv_px[moves], rig)
    velocity_mps = 0.25 * np.median(points[:, 2]) * np.array([np.cos(angle), 0.0, np.sin(angle)])
    _, first, row = np.unique(seen.track_id[moves], return_index=True, return_inverse=True)
    moved = points + (seen_s[moves] - seen_s[moves][first][row])[:, None] * velocity_mps
    uv_px, kept = seen.uv_px.copy(), np.ones(len(seen), dtype=bool)
    kept[moves] = moved[:, 2] > 0.5
    uv_px[moves & kept] = project(moved[kept[moves]], rig)
    return replace(sequence, observations=Observations(seen.frame, seen.track_id, uv_px).select(kept))


@_injector("tracks", clean=np.inf)
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
        free = int(np.clip(dose - followed.size, 0, others.size))
        followed = np.concatenate([followed, others[np.argsort(chance[others])][:free]])
        kept[begin:end] = np.isin(here, followed)
    return replace(sequence, observations=seen.select(kept))


@_injector("share")
def one_sided_view(sequence: Sequence, dose: float = 0.5, seed: int = 0) -> Sequence:
    """Lose a share of the image, starting at its left or its right edge: a dirty lens, a wall on one side only."""
    seen, side = sequence.observations, np.random.default_rng(seed).choice([-1.0, 1.0])
    across = side * seen.uv_px[:, 0]
    hidden = across < np.quantile(across, dose) if len(seen) else np.zeros(0, dtype=bool)
    return replace(sequence, observations=seen.select(~hidden))


@_injector("share")
def swapped_images(sequence: Sequence, dose: float = 1.0, seed: int = 0) -> Sequence:
    """Exchange left and right in a share of the tracks; in all of them if the cameras' cables are exchanged."""
    seen, struck = sequence.observations, _struck_tracks(sequence, dose, seed)
    return _with_pixels(sequence, np.where(struck[:, None], seen.uv_px[:, [1, 0, 2]], seen.uv_px))


@_injector("share")
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


@_injector("px")
def shifted_pixels(sequence: Sequence, dose: float = 5000.0, seed: int = 0) -> Sequence:
    """Add the dose (px) to every image coordinate: pixels of a crop or a mosaic, or of another origin."""
    return _with_pixels(sequence, sequence.observations.uv_px + dose)


@_injector("px")
def misaligned_rows(sequence: Sequence, dose: float = 12.0, seed: int = 0) -> Sequence:
    """Shift vR by the dose (px) against vL: a pair that is not rectified. v, their mean, shifts by half of it."""
    return _with_pixels(sequence, sequence.observations.uv_px + np.array([0.0, 0.0, 0.5 * dose]))


@_injector("rad")
def rolled_right(sequence: Sequence, dose: float = 0.01, seed: int = 0) -> Sequence:
    """Roll the right camera by the dose (rad) about its optical axis: a mount that was bent after the calibration.

    Columns and rows of the right image rotate about the principal point; v, the mean of both rows, by half of it.
    """
    rig, uv_px = sequence.rig, sequence.observations.uv_px.copy()
    across, down = (uv_px[:, 1] - rig.cx_px) / rig.fx_px, (uv_px[:, 2] - rig.cy_px) / rig.fy_px
    row_px = rig.cy_px + rig.fy_px * (np.cos(dose) * down - np.sin(dose) * across)
    uv_px[:, 1] = rig.cx_px + rig.fx_px * (np.cos(dose) * across + np.sin(dose) * down)
    uv_px[:, 2] = np.where(np.isnan(row_px), uv_px[:, 2], 0.5 * (uv_px[:, 2] + row_px))
    return _with_pixels(sequence, uv_px)


@_injector("px")
def shifted_right(sequence: Sequence, dose: float = 0.5, seed: int = 0) -> Sequence:
    """Add the dose (px) to the columns of the right image: cameras that turned apart, two principal points."""
    return _with_pixels(sequence, sequence.observations.uv_px + dose * np.array([0.0, 1.0, 0.0]))


@_injector("factor", clean=1.0)
def stretched_disparity(sequence: Sequence, dose: float = 1.05, seed: int = 0) -> Sequence:
    """Multiply all disparities by the dose: images scaled after the matching, a matcher that is biased."""
    uv_px = sequence.observations.uv_px.copy()
    uv_px[:, 1] = uv_px[:, 0] - dose * (uv_px[:, 0] - uv_px[:, 1])
    return _with_pixels(sequence, uv_px)


@_injector("px")
def jumped_image(sequence: Sequence, dose: float = 15.0, seed: int = 0) -> Sequence:
    """Shift every image of the second half by the dose (px): a camera that is knocked, a crop that changes."""
    later = sequence.observations.frame >= sequence.frame_count // 2
    return _with_pixels(sequence, sequence.observations.uv_px + dose * later[:, None])


@_injector("share")
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


# Errors of real trackers that last over a track, unlike the noise of single sightings ---------------------------------


@_injector("px")
def track_noise(sequence: Sequence, dose: float = 0.5, seed: int = 0) -> Sequence:
    """Add white noise of the dose (px) as sigma to mean column, disparity and row of each sighting: blur, low light."""
    return _with_track_noise(sequence, TrackNoise(np.full(3, dose), np.zeros(3), np.zeros(3)), seed)


@_injector("px")
def track_walk(sequence: Sequence, dose: float = 0.13, seed: int = 0) -> Sequence:
    """Let every track wander by the dose (px per root frame) in mean column, disparity and row: a tracker's drift."""
    return _with_track_noise(sequence, TrackNoise(np.zeros(3), np.full(3, dose), np.zeros(3)), seed)


@_injector("px")
def match_offset(sequence: Sequence, dose: float = 0.7, seed: int = 0) -> Sequence:
    """Give every track a constant disparity error, of the dose (px) as sigma: matched once, at its start, and wrong."""
    return _with_track_noise(sequence, TrackNoise(np.zeros(3), np.zeros(3), np.array([0.0, dose, 0.0])), seed)


@_injector("share")
def cut_tracks(sequence: Sequence, dose: float = 0.08, seed: int = 0) -> Sequence:
    """End every track before a share of the frames, and continue with new ones: repeated images, a tracker that fails.

    Repaired stale frames have this effect: across each, only the motion samples measure the motion.
    """
    seen = sequence.observations
    cut = np.random.default_rng(seed).uniform(size=sequence.frame_count) < dose
    cut[0] = False
    track_id = np.cumsum(cut)[seen.frame] * (int(seen.track_id.max(initial=-1)) + 1) + seen.track_id
    return replace(sequence, observations=replace(seen, track_id=track_id))


@_injector("share")
def persistent_mismatch(sequence: Sequence, dose: float = 0.05, seed: int = 0) -> Sequence:
    """Let a share of the tracks slip to a point 5 to 30 px nearer to the middle, and follow that point to their end."""
    slipped = with_slips(sequence.observations, dose, sequence.rig, np.random.default_rng(seed))
    return replace(sequence, observations=slipped)


@_injector("share")
def moving_vehicles(sequence: Sequence, dose: float = 0.2, seed: int = 0) -> Sequence:
    """Let a share of the points drive along the camera's course at a speed of their vehicle, up to 1.5 times its own.

    Points whose tracks begin within two seconds are on one vehicle. Raises DataError where no truth says where the
    camera was at the frames.
    """
    truth, seen, rng = sequence.truth, sequence.observations, np.random.default_rng(seed)
    if truth is None or not np.isin(sequence.frames_t_ns, truth.t_ns).all():
        raise DataError(f"{sequence.name}: moving objects need the truth at every frame")
    poses = truth.T_world_imu[np.searchsorted(truth.t_ns, sequence.frames_t_ns)] @ sequence.rig.T_imu_cam
    t_s = sequence.frames_s
    velocity = np.gradient(poses[:, :3, 3], t_s, axis=0)
    track, first, row = np.unique(seen.track_id, return_index=True, return_inverse=True)
    begin = seen.frame[first]
    vehicle = (t_s[begin] / _ONE_VEHICLE_S).astype(np.int64)
    speed = rng.uniform(0.3, 1.5, size=vehicle.max(initial=0) + 1)[vehicle] * (rng.uniform(size=track.size) < dose)
    travelled = (speed[:, None] * velocity[begin])[row] * (t_s[seen.frame] - t_s[begin][row])[:, None]
    points = triangulate(seen.uv_px, sequence.rig)
    moved = points + (np.swapaxes(poses[seen.frame][:, :3, :3], 1, 2) @ travelled[:, :, None])[..., 0]
    kept = moved[:, 2] > 0.5
    shift_px = project(moved[kept], sequence.rig) - project(points[kept], sequence.rig)
    left = seen.select(kept)
    return replace(sequence, observations=replace(left, uv_px=left.uv_px + shift_px))


def _with_track_noise(sequence: Sequence, noise: TrackNoise, seed: int) -> Sequence:
    noisy = with_track_noise(sequence.observations, noise, np.random.default_rng(seed))
    return replace(sequence, observations=noisy)


# Motion samples -------------------------------------------------------------------------------------------------------


@_injector("s")
def motion_gap(sequence: Sequence, dose: float = 0.5, seed: int = 0) -> Sequence:
    """Lose the motion samples of a span whose length is the dose (s): a full buffer, a loose cable."""
    begin_s, end_s = _span_s(sequence, dose, seed)
    t_s = sequence.elapsed_s(sequence.motion.t_ns)
    return sequence.with_samples((t_s <= begin_s) | (t_s >= end_s))


@_injector("s")
def stuck_motion(sequence: Sequence, dose: float = 0.5, seed: int = 0) -> Sequence:
    """Repeat the last motion sample for the dose (s): a driver that hangs."""
    begin_s, end_s = _span_s(sequence, dose, seed)
    t_s, values = sequence.elapsed_s(sequence.motion.t_ns), sequence.motion.values.copy()
    stuck = (t_s > begin_s) & (t_s < end_s)
    values[stuck] = values[max(int(np.argmax(stuck)) - 1, 0)]
    return _with_values(sequence, values)


@_injector("share", clean=1.0)
def saturated_motion(sequence: Sequence, dose: float = 0.5, seed: int = 0) -> Sequence:
    """Clip the motion samples at this share of the largest on each axis: a sensor whose range is too small."""
    values = sequence.motion.values
    largest = dose * np.abs(values).max(axis=0, initial=0.0)
    return _with_values(sequence, np.clip(values, -largest, largest))


def spike(sequence: Sequence, dose: float = 1e300, seed: int = 0) -> Sequence:
    """Set one motion sample to the dose on one axis: a flipped bit, a failed parse."""
    rng, values = np.random.default_rng(seed), sequence.motion.values.copy()
    values[rng.integers(len(values) // 4, 3 * len(values) // 4), rng.integers(6)] = dose
    return _with_values(sequence, values)


@_injector("m/s or m/s^2")
def disturbed_motion(sequence: Sequence, dose: float = 1.0, seed: int = 0) -> Sequence:
    """Add the dose (m/s, or m/s^2) along a random axis to a third of the motion samples: slipping wheels, vibration."""
    begin_s, end_s = _span_s(sequence, sequence.duration_s / 3.0, seed)
    axis, t_s = np.random.default_rng(seed).standard_normal(3), sequence.elapsed_s(sequence.motion.t_ns)
    added = np.concatenate([dose * axis / np.linalg.norm(axis), np.zeros(3)])
    return _with_values(sequence, sequence.motion.values + ((t_s >= begin_s) & (t_s < end_s))[:, None] * added)


@_injector("s")
def nan_span(sequence: Sequence, dose: float = 0.25, seed: int = 0) -> Sequence:
    """Write NaN to all motion samples and sightings of a span of the dose (s): a driver that fails and recovers."""
    begin_s, end_s = _span_s(sequence, dose, seed)
    values, uv_px = sequence.motion.values.copy(), sequence.observations.uv_px.copy()
    t_s, seen_s = sequence.elapsed_s(sequence.motion.t_ns), sequence.frames_s[sequence.observations.frame]
    values[(t_s > begin_s) & (t_s < end_s)] = np.nan
    uv_px[(seen_s > begin_s) & (seen_s < end_s)] = np.nan
    return _with_values(_with_pixels(sequence, uv_px), values)


@_injector("factor", clean=1.0)
def linear_unit(sequence: Sequence, dose: float = 3.6, seed: int = 0) -> Sequence:
    """Multiply velocities, or accelerations, by the dose: 3.6 for km/h, 100 for cm/s, 0.102 for g."""
    return _with_values(sequence, sequence.motion.values * np.repeat([dose, 1.0], 3))


@_injector("factor", clean=1.0)
def changed_speed(sequence: Sequence, dose: float = 1.08, seed: int = 0) -> Sequence:
    """Multiply the velocities, or accelerations, of the second half by the dose: a tyre that loses air."""
    later = sequence.motion.t_ns > sequence.frames_t_ns[sequence.frame_count // 2]
    factor = np.where(later[:, None], np.repeat([dose, 1.0], 3), 1.0)
    return _with_values(sequence, factor * sequence.motion.values)


@_injector("samples", clean=1.0)
def thinned_motion(sequence: Sequence, dose: float = 10.0, seed: int = 0) -> Sequence:
    """Keep one motion sample in as many as the dose: a log that was thinned out, a bus that is busy."""
    return sequence.with_samples(np.arange(sequence.motion.t_ns.size) % int(dose) == 0)


@_injector("factor", clean=1.0)
def angular_unit(sequence: Sequence, dose: float = 180.0 / np.pi, seed: int = 0) -> Sequence:
    """Multiply angular velocities by the dose: 57.3 for degrees."""
    return _with_values(sequence, sequence.motion.values * np.repeat([1.0, dose], 3))


@_injector("factor", clean=1.0)
def gyro_axis_scale(sequence: Sequence, dose: float = 0.9, seed: int = 0) -> Sequence:
    """Multiply the rates about the axis that turns most by the dose: a channel of another sensitivity."""
    scale = np.ones(6)
    scale[3 + int(np.argmax(np.std(sequence.motion.values[:, 3:], axis=0)))] = dose
    return _with_values(sequence, sequence.motion.values * scale)


def coarse_samples(sequence: Sequence, dose: float = 0.1, seed: int = 0) -> Sequence:
    """Round motion samples to multiples of the dose: a converter of few bits, a log of few digits."""
    return _with_values(sequence, dose * np.round(sequence.motion.values / dose))


@_injector("rad/s")
def gyro_bias(sequence: Sequence, dose: float = 0.01, seed: int = 0) -> Sequence:
    """Add a constant of the dose (rad/s) in a random direction to every angular velocity: a warm gyro."""
    axis = np.random.default_rng(seed).standard_normal(3)
    bias = np.concatenate([np.zeros(3), dose * axis / np.linalg.norm(axis)])
    return _with_values(sequence, sequence.motion.values + bias)


@_injector("factor", clean=1.0)
def wrong_noise(sequence: Sequence, dose: float = 2.0, seed: int = 0) -> Sequence:
    """State the dose times the noise of tracks and motion, whose errors stay: a data sheet of another sensor."""
    rig = replace(sequence.rig, cov_uv_px2=sequence.rig.cov_uv_px2 * dose**2)
    return replace(sequence, rig=rig, noise=sequence.noise.scaled(dose))


@_injector("s")
def standstill(sequence: Sequence, dose: float = 10.0, seed: int = 0) -> Sequence:
    """Stop at a frame for the dose (s) and continue from there: a red light. For twists, whose motion may just stop.

    The tracks of that frame are seen again in every one, with the noise of the rig. Raises DataError where the motion
    is an IMU's: braking would need accelerations nobody measured; simulate a scene that halts.
    """
    motion, noise = sequence.motion, sequence.noise
    if not (isinstance(motion, TwistSamples) and isinstance(noise, TwistNoise)):
        raise DataError(
            f"{sequence.name}: a standstill can be planted between twists only; simulate a scene that halts"
        )
    rng, period_ns = np.random.default_rng(seed), int(np.median(np.diff(sequence.frames_t_ns)))
    halt = int(np.searchsorted(sequence.frames_s, _span_s(sequence, 0.0, seed)[0]))
    pause = _Pause(sequence.frames_t_ns[halt], period_ns, round(_ns(dose) / period_ns))
    t_ns, rows = pause.inserted(motion.t_ns)
    density = np.concatenate([noise.velocity_noise_density, noise.gyro_noise_density])
    still = rng.standard_normal((t_ns.size, 6)) * density / np.sqrt(period_ns / NS_PER_S)
    values = np.where(pause.within(t_ns)[:, None], still, motion.values[rows])
    seen, truth = sequence.observations, sequence.truth
    here = np.flatnonzero(seen.frame == halt)
    standing, their_frames = seen.select(np.tile(here, pause.stamps)), np.repeat(np.arange(pause.stamps), here.size)
    noise_px = rng.standard_normal((len(standing), 3)) @ np.linalg.cholesky(sequence.rig.cov_uv_px2).T
    observations = Observations.sorted(
        np.concatenate([seen.frame + pause.stamps * (seen.frame >= halt), halt + their_frames]),
        np.concatenate([seen.track_id, standing.track_id]),
        np.concatenate([seen.uv_px, standing.uv_px + noise_px]),
    )
    if truth is not None:
        true_t_ns, rows = pause.inserted(truth.t_ns)
        v_world = None if truth.v_world is None else truth.v_world[rows] * ~pause.within(true_t_ns)[:, None]
        bias = None if truth.bias is None else truth.bias[rows]
        truth = replace(truth, t_ns=true_t_ns, T_world_imu=truth.T_world_imu[rows], v_world=v_world, bias=bias)
    motion = replace(motion, t_ns=t_ns, v_mps=values[:, :3], w_radps=values[:, 3:])
    frames_t_ns = pause.inserted(sequence.frames_t_ns)[0]
    return replace(sequence, frames_t_ns=frames_t_ns, observations=observations, motion=motion, truth=truth)


class _Pause(NamedTuple):
    """Stamps, a period apart, inserted before the stamp ``at_ns``; later stamps are delayed by the whole pause."""

    at_ns: int
    period_ns: int
    stamps: int

    def inserted(self, t_ns: IntArray) -> tuple[IntArray, IntArray]:
        """Return the stamps (N + stamps,) and the row of ``t_ns`` (N,) that each one repeats."""
        at = int(np.searchsorted(t_ns, self.at_ns))
        rows = np.concatenate([np.arange(at), np.full(self.stamps, min(at, t_ns.size - 1)), np.arange(at, t_ns.size)])
        extra_ns = self.at_ns + self.period_ns * np.arange(self.stamps)
        return np.concatenate([t_ns[:at], extra_ns, t_ns[at:] + self.stamps * self.period_ns]), rows

    def within(self, t_ns: IntArray) -> BoolArray:
        """Say which stamps (N,) are in the pause."""
        return np.asarray((t_ns >= self.at_ns) & (t_ns < self.at_ns + self.stamps * self.period_ns))


# Clocks ---------------------------------------------------------------------------------------------------------------


@_injector("s")
def camera_clock(sequence: Sequence, dose: float = 0.02, seed: int = 0) -> Sequence:
    """Stamp all frames late by the dose (s): exposure and transfer not accounted for, a clock set by hand.

    Frames that leave the time of the motion samples are cut off. The truth stays on the motion's clock.
    """
    return _with_frames_at(sequence, sequence.frames_t_ns + _ns(dose))


@_injector("s")
def camera_clock_step(sequence: Sequence, dose: float = 0.05, seed: int = 0) -> Sequence:
    """Stamp the frames of the second half late by the dose (s): only the camera's clock is set during the recording."""
    later = np.arange(sequence.frame_count) >= sequence.frame_count // 2
    return _with_frames_at(sequence, sequence.frames_t_ns + np.where(later, _ns(dose), 0))


@_injector("s")
def alternate_frames_late(sequence: Sequence, dose: float = 0.02, seed: int = 0) -> Sequence:
    """Stamp every other frame late by the dose (s): two buffers, of which one is read after the other."""
    odd = np.arange(sequence.frame_count) % 2 == 1
    return _with_frames_at(sequence, sequence.frames_t_ns + np.where(odd, _ns(dose), 0))


@_injector("s")
def frame_jitter(sequence: Sequence, dose: float = 0.015, seed: int = 0) -> Sequence:
    """Shift each stamp uniformly by up to the dose (s), less than half a step: a busy computer."""
    off_s = np.random.default_rng(seed).uniform(-dose, dose, sequence.frame_count)
    return _with_frames_at(sequence, sequence.frames_t_ns + np.rint(1e9 * off_s).astype(np.int64))


@_injector("s/s")
def camera_clock_drift(sequence: Sequence, dose: float = 0.02, seed: int = 0) -> Sequence:
    """Let the camera's clock run fast by a share of the time: a cheap quartz, frames counted and not stamped."""
    since_ns = sequence.frames_t_ns - sequence.frames_t_ns[0]
    return _with_frames_at(sequence, sequence.frames_t_ns + np.rint(dose * since_ns).astype(np.int64))


@_injector("s")
def clock_jump(sequence: Sequence, dose: float = -0.5, seed: int = 0) -> Sequence:
    """Shift all stamps of frames and samples by the dose (s) from some time on: a daemon sets the clock."""
    at_ns = sequence.frames_t_ns[0] + _ns(_span_s(sequence, 0.0, seed)[0])
    motion, frames_t_ns = sequence.motion, sequence.frames_t_ns
    frames_t_ns = frames_t_ns + np.where(frames_t_ns > at_ns, _ns(dose), 0)
    samples_t_ns = motion.t_ns + np.where(motion.t_ns > at_ns, _ns(dose), 0)
    return replace(sequence, frames_t_ns=frames_t_ns, motion=replace(motion, t_ns=samples_t_ns))


def _with_frames_at(sequence: Sequence, frames_t_ns: IntArray) -> Sequence:
    """Return the sequence with other stamps of its frames (K,), without those outside the motion samples."""
    moved, motion_t_ns = replace(sequence, frames_t_ns=frames_t_ns), sequence.motion.t_ns
    inside = (frames_t_ns >= motion_t_ns[0]) & (frames_t_ns <= motion_t_ns[-1])
    return moved if inside.all() else moved.with_frames(np.flatnonzero(inside))


# Calibration ----------------------------------------------------------------------------------------------------------


def identity_intrinsics(sequence: Sequence, dose: float = 1.0, seed: int = 0) -> Sequence:
    """Set the focal lengths to the dose and the centre to zero: a K left at the identity, or with 0 never filled in."""
    return _with_rig(sequence, fx_px=dose, fy_px=dose, cx_px=0.0, cy_px=0.0)


@_injector("factor", clean=1.0)
def wrong_focal_length(sequence: Sequence, dose: float = 1.05, seed: int = 0) -> Sequence:
    """Multiply both focal lengths by the dose: a data sheet instead of a calibration, another zoom."""
    return _with_rig(sequence, fx_px=dose * sequence.rig.fx_px, fy_px=dose * sequence.rig.fy_px)


@_injector("factor", clean=1.0)
def wrong_aspect(sequence: Sequence, dose: float = 1.05, seed: int = 0) -> Sequence:
    """Multiply fx alone by the dose: images that were resized in one direction."""
    return _with_rig(sequence, fx_px=dose * sequence.rig.fx_px)


@_injector("px")
def shifted_centre(sequence: Sequence, dose: float = 15.0, seed: int = 0) -> Sequence:
    """Shift the stated principal point by the dose (px) in a random direction: the middle of the image used instead."""
    angle = np.random.default_rng(seed).uniform(0.0, 2.0 * np.pi)
    cx_px, cy_px = sequence.rig.cx_px + dose * np.cos(angle), sequence.rig.cy_px + dose * np.sin(angle)
    return _with_rig(sequence, cx_px=float(cx_px), cy_px=float(cy_px))


@_injector("factor", clean=1.0)
def baseline_unit(sequence: Sequence, dose: float = 1000.0, seed: int = 0) -> Sequence:
    """Multiply the baseline by the dose: 1000 for millimetres."""
    return _with_rig(sequence, baseline_m=dose * sequence.rig.baseline_m)


@_injector("factor", clean=1.0)
def extrinsic_unit(sequence: Sequence, dose: float = 1000.0, seed: int = 0) -> Sequence:
    """Multiply the camera's position in the IMU frame by the dose: 1000 for millimetres, -1 for a sign mixed up."""
    T_imu_cam = sequence.rig.T_imu_cam
    return _with_rig(sequence, T_imu_cam=se3(T_imu_cam[:3, :3], dose * T_imu_cam[:3, 3]))


def inverted_extrinsic(sequence: Sequence, dose: float = 1.0, seed: int = 0) -> Sequence:
    """Invert the extrinsic: IMU to camera written where camera to IMU is read. A dose of 0 leaves it."""
    return _with_rig(sequence, T_imu_cam=se3_inverse(sequence.rig.T_imu_cam)) if dose else sequence


@_injector("rad")
def turned_camera(sequence: Sequence, dose: float = 0.05, seed: int = 0) -> Sequence:
    """Rotate the camera in its mount by the dose (rad) about a random axis: a knock, a calibration of another day."""
    axis = np.random.default_rng(seed).standard_normal(3)
    T_imu_cam = sequence.rig.T_imu_cam
    return _with_rig(sequence, T_imu_cam=T_imu_cam @ se3(so3_exp(dose * axis / np.linalg.norm(axis)), np.zeros(3)))


@_injector("m")
def displaced_camera(sequence: Sequence, dose: float = 0.3, seed: int = 0) -> Sequence:
    """State the camera's position wrong by the dose (m) in a random direction: a tape measure, a bracket moved."""
    axis, T_imu_cam = np.random.default_rng(seed).standard_normal(3), sequence.rig.T_imu_cam
    displaced = se3(T_imu_cam[:3, :3], T_imu_cam[:3, 3] + dose * axis / np.linalg.norm(axis))
    return _with_rig(sequence, T_imu_cam=displaced)


@_injector("rad")
def wrong_start(sequence: Sequence, dose: float = 0.05, seed: int = 0) -> Sequence:
    """Tilt the stated start by the dose (rad) about a random level axis, as certain as before: a guessed attitude.

    Raises DataError where none is stated: one that is found on the measurements is not wrong by a dose.
    """
    prior, angle = sequence.prior, np.random.default_rng(seed).uniform(0.0, 2.0 * np.pi)
    if prior is None:
        raise DataError(f"{sequence.name}: it states no start that could be wrong; simulated sequences do")
    T_world_imu = prior.T_world_imu
    tilt = so3_exp(dose * np.array([np.cos(angle), np.sin(angle), 0.0]))
    tilted = se3(tilt @ T_world_imu[:3, :3], T_world_imu[:3, 3])
    return replace(sequence, prior=replace(prior, T_world_imu=tilted))


# Truth ----------------------------------------------------------------------------------------------------------------


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
        raise DataError(f"{sequence.name}: it has no truth that could be changed")
    return sequence.truth


# Parts of several faults ----------------------------------------------------------------------------------------------


def _span_s(sequence: Sequence, length_s: float, seed: int) -> tuple[float, float]:
    """Return begin and end (s from the first frame) of a span in the middle half, where one of that length fits."""
    begin_s = sequence.duration_s * np.random.default_rng(seed).uniform(0.3, 0.6)
    begin_s = max(min(begin_s, 0.9 * sequence.duration_s - length_s), 0.0)
    return begin_s, begin_s + length_s


def _ns(seconds: float) -> int:
    """Return seconds as whole nanoseconds."""
    return round(seconds * NS_PER_S)


def _with_pixels(sequence: Sequence, uv_px: Array) -> Sequence:
    """Return the sequence with other pixels (N, 3) of its sightings."""
    return replace(sequence, observations=replace(sequence.observations, uv_px=uv_px))


def _with_values(sequence: Sequence, values: Array) -> Sequence:
    """Return the sequence with other values (S, 6) of its motion samples."""
    return replace(sequence, motion=sequence.motion.of(sequence.motion.t_ns, values))


def _with_rig(sequence: Sequence, **fields: Any) -> Sequence:
    return replace(sequence, rig=replace(sequence.rig, **fields))
