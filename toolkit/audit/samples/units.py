"""Times, lengths, speeds, rates of rotation and accelerations in other units than SI.

Two sources of one motion have a ratio that does not depend on axes: of the speeds of samples and camera, of their rates
of rotation, of the speeds of truth and samples, of specific force and gravity. A ratio far from one that is a unit's
factor names the unit; other ratios are not judged here. A ratio that speeds and rates have in common is that of the
stamps, because the camera's motion is divided by time. The baseline and the extrinsic are judged by lengths that no rig
has.
"""

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from toolkit.audit.fault import Evidence, Fault, Symptom, Undecided
from toolkit.audit.parts.intervals import Intervals
from toolkit.audit.parts.one_step import median_one_step_px
from toolkit.audit.parts.ratios import (
    FORCES,
    RATES,
    SPEEDS,
    force_ratio,
    is_from_scatter,
    ratio_of_speeds,
    rotation_ratio,
    speed_ratio,
)
from toolkit.audit.parts.robust import Scalar
from toolkit.geometry import se3
from toolkit.measured_motion import TwistNoise, TwistSamples
from toolkit.resampling import NS_PER_S
from toolkit.sequence import Sequence

LENGTHS = {"millimetres": 1000.0, "centimetres": 100.0}
# A unit is named where the ratio is within this factor of the unit's, and this many standard errors from one.
WITHIN_FACTOR, SIGMAS = 1.25, 5.0
# Vision's speed is accurate to 5 % in sound recordings, which distinguishes km/h from ft/s, a factor of 1.1 apart.
WITHIN_FACTOR_OF_SPEED = 1.08
# The stamps are wrong if the ratios of speeds and of rates of rotation are both beyond the first factor, and differ by
# less than the second.
LEAST_OF_STAMPS, STAMPS_ALIKE = 1.3, 1.15
# Limits of the time (s) between two frames of a vehicle's camera.
LEAST_FRAME_S, MOST_FRAME_S = 1e-3, 5.0
IN_A_PART = " in a part of the recording and not in another"
# Limits of the baselines of rigs on vehicles, hand-held or flying (m), and the largest distance of a camera from its
# IMU (m).
LEAST_BASELINE_M, MOST_BASELINE_M, MOST_LEVER_M = 0.005, 5.0, 10.0


class _Wrong(NamedTuple):
    """A unit that is wrong: what was measured, and the sequence in SI, or None where two units are as likely."""

    summary: str
    remedy: Sequence | None


def check(evidence: Evidence) -> Symptom | Undecided | None:
    """Count the quantities in another unit; convert them where the unit is certain."""
    found: list[_Wrong] = []
    now = evidence
    stamps = _stamps(evidence) or _frame_rate(evidence)
    measures = (_baseline, _lever_arm, _speed, _rotation, _force, _truth)
    found += [] if stamps is None else [stamps]
    for measure in measures if stamps is None else ():
        wrong = measure(now)
        if wrong is not None:
            found.append(wrong)
            now = now if wrong.remedy is None else now.after(wrong.remedy)
    if not found:
        return evidence.blind if evidence.intervals is None else None
    certain = all(wrong.remedy is not None for wrong in found)
    return Symptom(
        count=len(found),
        detail="; ".join(wrong.summary for wrong in found),
        treatment="converted to SI" if certain else "no single unit fits all of it: correct the recording",
        remedy=now.sequence if certain else None,
        spoils_vision=True,
    )


def _stamps(evidence: Evidence) -> _Wrong | None:
    """Report stamps by which both speeds and rates of rotation of camera and odometry differ by one factor."""
    speed = speed_ratio(evidence.intervals)
    if evidence.intervals is None or speed is None or not speed.value > 0.0:
        return None
    rotation = rotation_ratio(evidence.intervals)
    known = all(ratio.error * SIGMAS < (LEAST_OF_STAMPS - 1.0) * ratio.value for ratio in (speed, rotation))
    if not known or abs(np.log(speed.value / rotation.value)) > np.log(STAMPS_ALIKE):
        return None
    if min(abs(np.log(ratio.value)) for ratio in (speed, rotation)) < np.log(LEAST_OF_STAMPS):
        return None
    return _Wrong(
        f"the samples' speed is {speed.value:.3g} +- {speed.error:.1g} and their rate of rotation {rotation.value:.3g} "
        f"+- {rotation.error:.1g} times the camera's: the stamps run {speed.value:.3g} times as fast as "
        "time, so they are not in seconds",
        None,
    )


def _frame_rate(evidence: Evidence) -> _Wrong | None:
    """Report stamps whose steps between frames are not those of a vehicle's camera."""
    if evidence.sequence.frame_count < 2 or evidence.intervals is None:
        return None
    step_s = float(np.median(np.diff(evidence.sequence.frames_t_ns))) / NS_PER_S
    if LEAST_FRAME_S <= step_s <= MOST_FRAME_S:
        return None
    return _Wrong(
        f"by the stamps frames come every {step_s:.2g} s, which no camera does: they are not in seconds", None
    )


def _baseline(evidence: Evidence) -> _Wrong | None:
    """Judge the baseline by its size; a measured speed decides between units."""
    rig = evidence.sequence.rig
    if LEAST_BASELINE_M <= rig.baseline_m <= MOST_BASELINE_M:
        return None
    fitting = [u for u, factor in LENGTHS.items() if LEAST_BASELINE_M <= rig.baseline_m / factor <= MOST_BASELINE_M]
    ratio = speed_ratio(evidence.intervals)
    summary = f"baseline_m is {rig.baseline_m:g}, which no rig has"
    if ratio is not None:
        measured = {unit: 1.0 / LENGTHS[unit] for unit in fitting}
        unit = _in_other_unit(ratio, measured, WITHIN_FACTOR, SIGMAS)
        fitting = [unit] if unit is not None else []
        summary += f" and the samples' speed is {ratio.value:.3g} +- {ratio.error:.1g} times the camera's"
    if len(fitting) != 1:
        return _Wrong(f"{summary}: it is not in metres", None)
    baseline_m = rig.baseline_m / LENGTHS[fitting[0]]
    remedy = replace(evidence.sequence, rig=replace(rig, baseline_m=baseline_m))
    return _Wrong(f"{summary}: it is in {fitting[0]}, {baseline_m:g} m", remedy)


def _lever_arm(evidence: Evidence) -> _Wrong | None:
    """Judge the distance of camera and IMU by its size, in the largest unit that makes it one."""
    rig = evidence.sequence.rig
    position = rig.T_imu_cam[:3, 3]
    distance_m = float(np.linalg.norm(position))
    if not distance_m > MOST_LEVER_M:
        return None
    summary = f"T_imu_cam puts the camera {distance_m:.3g} m from the IMU"
    unit = "millimetres"
    if distance_m / LENGTHS[unit] > MOST_LEVER_M:
        return _Wrong(f"{summary}: it is not in metres", None)
    T_imu_cam = se3(rig.T_imu_cam[:3, :3], position / LENGTHS[unit])
    if evidence.intervals is not None:
        camera = evidence.camera_motion
        given_px, now_px = (median_one_step_px(evidence.sequence, camera, T) for T in (rig.T_imu_cam, T_imu_cam))
        summary += f" (median one-step reprojection {given_px:.2f} px as given, {now_px:.2f} px in {unit})"
    remedy = replace(evidence.sequence, rig=replace(rig, T_imu_cam=T_imu_cam))
    return _Wrong(f"{summary}: its translation is in {unit}", remedy)


def _speed(evidence: Evidence) -> _Wrong | None:
    ratio = speed_ratio(evidence.intervals)
    unit = None if ratio is None else _in_other_unit(ratio, SPEEDS, WITHIN_FACTOR_OF_SPEED, SIGMAS)
    if ratio is None or unit is None:
        return None
    summary = f"the samples' speed is {ratio.value:.3g} +- {ratio.error:.1g} times the camera's: it is in {unit}"
    if not _all_along(evidence, speed_ratio, SPEEDS[unit]):
        return _Wrong(f"{summary}{IN_A_PART}", None)
    return _Wrong(summary, _scaled(evidence.sequence, 1.0 / SPEEDS[unit]))


def _rotation(evidence: Evidence) -> _Wrong | None:
    intervals = evidence.intervals
    if intervals is None:
        return None
    ratio = rotation_ratio(intervals)
    unit = _in_other_unit(ratio, RATES, WITHIN_FACTOR, SIGMAS)
    if unit is None:
        return None
    summary = f"the gyro turns {ratio.value:.3g} +- {ratio.error:.1g} times as fast as the camera: it is in {unit}"
    if not _all_along(evidence, rotation_ratio, RATES[unit]):
        return _Wrong(f"{summary}{IN_A_PART}", None)
    return _Wrong(summary, _scaled(evidence.sequence, 1.0, 1.0 / RATES[unit]))


def _all_along(evidence: Evidence, ratio_of: Callable[[Intervals], Scalar | None], factor: float) -> bool:
    """Say whether both halves of the recording have a ratio nearer to a unit's factor than to one."""
    intervals = evidence.intervals
    assert intervals is not None
    first = np.arange(intervals.interval.size) < intervals.interval.size // 2
    halves = (intervals.select(first), intervals.select(~first))
    ratios = [ratio for half in halves if (ratio := ratio_of(half)) is not None]
    return all((ratio.value > np.sqrt(factor)) == (factor > 1.0) for ratio in ratios)


def _force(evidence: Evidence) -> _Wrong | None:
    ratio = force_ratio(evidence.sequence)
    unit = None if ratio is None else _in_other_unit(ratio, FORCES, WITHIN_FACTOR, SIGMAS)
    if ratio is None or unit is None:
        return None
    summary = f"the accelerometer reads {ratio.value:.3g} times gravity (median): it is in {unit}"
    return _Wrong(summary, _scaled(evidence.sequence, 1.0 / FORCES[unit]))


def _truth(evidence: Evidence) -> _Wrong | None:
    """Judge the truth by the ratio of its speed to the samples', or to the camera's with an IMU."""
    sequence, intervals = evidence.sequence, evidence.intervals
    truth = sequence.truth
    if truth is None or intervals is None or truth.t_ns.size < 2:
        return None
    frames_t_ns = sequence.frames_t_ns
    inside = (frames_t_ns >= truth.t_ns[0]) & (frames_t_ns <= truth.t_ns[-1])
    t_s, at_s = ((stamps - truth.t_ns[0]) / NS_PER_S for stamps in (truth.t_ns, frames_t_ns))
    positions = np.stack([np.interp(at_s, t_s, axis) for axis in truth.T_world_imu[:, :3, 3].T], axis=1)
    v_true = np.diff(positions, axis=0) / np.diff(at_s)[:, None]
    rows = inside[intervals.interval] & inside[intervals.interval + 1]
    measured = intervals.v_cam_mps if intervals.v_mps is None else intervals.v_mps
    ratio = ratio_of_speeds(v_true[intervals.interval[rows]], measured[rows])
    unit = None if ratio is None else _in_other_unit(ratio, LENGTHS, WITHIN_FACTOR, SIGMAS)
    if ratio is None or unit is None:
        return None
    scale = 1.0 / LENGTHS[unit]
    T_world_imu = se3(truth.T_world_imu[:, :3, :3], scale * truth.T_world_imu[:, :3, 3])
    v_world = None if truth.v_world is None else scale * truth.v_world
    remedy = replace(sequence, truth=replace(truth, T_world_imu=T_world_imu, v_world=v_world))
    summary = f"the truth moves {ratio.value:.4g} +- {ratio.error:.1g} times as fast as measured: it is in {unit}"
    return _Wrong(summary, remedy)


def _in_other_unit(ratio: Scalar, factors: Mapping[str, float], within_factor: float, sigmas: float) -> str | None:
    """Return the only unit whose factor a ratio matches; None where none does, several do, or the ratio may be 1."""
    if not ratio.value > 0.0 or abs(ratio.value - 1.0) < sigmas * ratio.error:
        return None
    apart = {unit: abs(np.log(ratio.value / factor)) for unit, factor in factors.items()}
    near = [unit for unit in apart if apart[unit] < np.log(within_factor)]
    return near[0] if len(near) == 1 else None


def _scaled(sequence: Sequence, linear: float, angular: float = 1.0) -> Sequence:
    """Return the sequence with its motion samples multiplied, linear and angular ones.

    Noise that the file did not state, but a loader estimated from the scatter of the samples, is in their unit and
    is scaled as well.
    """
    motion, noise = sequence.motion, sequence.noise
    scaled = motion.of(motion.t_ns, motion.values * np.repeat([linear, angular], 3))
    if not (isinstance(motion, TwistSamples) and isinstance(noise, TwistNoise)):
        return replace(sequence, motion=scaled)
    velocity, gyro_noise = noise.velocity_noise_density, noise.gyro_noise_density
    if linear != 1.0 and is_from_scatter(velocity, motion.v_mps, motion.t_ns):
        velocity = linear * velocity
    if angular != 1.0 and is_from_scatter(gyro_noise, motion.w_radps, motion.t_ns):
        gyro_noise = angular * gyro_noise
    return replace(
        sequence,
        motion=scaled,
        noise=replace(noise, velocity_noise_density=velocity, gyro_noise_density=gyro_noise),
    )


FAULT = Fault(
    "units",
    "times, lengths, speeds, rates of rotation or accelerations in another unit than SI",
    check,
    after=("stale-frames", "doubled-disparity", "no-disparity", "time-gap", "intrinsics", "exchanged-samples"),
)
