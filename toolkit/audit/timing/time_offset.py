"""Frames stamped by another clock than the motion samples, or with a constant delay of the camera.

The camera's rotation over an interval, from its tracks alone, equals the mean of the gyro over that interval, shifted
by the offset (`parts.clocks`).

For twists stamped at the frames, `twist_lag` sets the pairing, and only an offset that no pairing explains is reported
here. For twists stamped between the frames, the frames are shifted to where the samples, as they are paired, fit.
Frames are not shifted by an offset that only half of the recording has, or that grows: that is a change of the clock.
They are not shifted either where the velocities of the twists then fit worse: the rates of rotation alone are late.
"""

from dataclasses import replace

import numpy as np

from toolkit.audit.fault import Evidence, Fault, Symptom, Undecided
from toolkit.audit.parts.bundle import LATE
from toolkit.audit.parts.clocks import LAG, camera_offset, change_of_offset, is_stamped_at_frames, least_change_s
from toolkit.audit.parts.edits import keep_frames
from toolkit.audit.parts.robust import LEAST_SPREAD_V, Scalar, cauchy, mean_in_sigmas
from toolkit.measured_motion import TwistSamples
from toolkit.resampling import NS_PER_S
from toolkit.sequence import Sequence

# An offset is reported beyond so many standard errors and beyond what is no fault. A sample of an IMU may describe the
# interval before or after its stamp, 5 ms at 100 Hz. A twist may describe the interval before or after its stamp, whose
# middle is half an interval away, and may be one interval late: an indoor recording that is taken as sound is late by
# 0.8.
SIGMAS, LEAST_S, LEAST_TWIST_INTERVALS = 5.0, 0.005, 1.5
# With an IMU, sound recordings at hand have 3.1 standard errors at most; from this many on the finding is undecided and
# says so.
DOUBTFUL_SIGMAS = 3.2
# The same limit, in intervals, for twists stamped between the frames. There a pairing has the same effect as an offset
# of the clock, and the shift corrects both.
LEAST_OFF_FRAMES = 0.25
# A shift is rejected if the velocities fit worse by so many standard errors. Halves and thirds of the indoor recording
# whose gyro is late have 3.4 and 3.5; planted offsets of 0.2 and 0.3 s on four real drives and a simulated one have
# -0.1 at most. Chosen between these.
AGAINST_SHIFT = 2.5
# Offsets (s) up to this are taken from the self-calibration.
NEAR_S = 0.025
# With a larger standard error (s), an offset is not excluded and the finding is undecided. One beyond chance is
# accepted up to twice the standard error, except for twists stamped at the frames, whose interval is open.
LARGEST_ERROR_S, LARGEST_TWIST_ERROR_S, LARGEST_BEYOND = 0.0064, 0.0125, 2.0
# The time from a sample to the next frame is constant if this share of the frames has it to within this share of a
# step; drifting clocks and different rates have no constant. The tracks do not exclude an offset within so many
# standard errors.
CONSTANT_SHARE, CONSTANT_STEPS, NEAR_SIGMAS = 0.9, 0.02, 2.0


def check(evidence: Evidence) -> Symptom | Undecided | None:
    """Find the offset of the frames' stamps; shift the frames by it."""
    sequence, intervals = evidence.sequence, evidence.intervals
    if intervals is None:
        return evidence.blind
    w_imu = intervals.w_cam_radps @ sequence.rig.T_imu_cam[:3, :3].T
    found = _refined(camera_offset(sequence, intervals, w_imu), evidence)
    if found is None:
        return Undecided("too little change of rotation: the offset of camera and gyro is unknown")
    expected_s, least_s = _expected(sequence)
    offset_s = found.value - expected_s
    beyond_s = found.value if is_stamped_at_frames(sequence) else offset_s
    surely_s = _largest_error_s(sequence) * (1.0 if is_stamped_at_frames(sequence) else LARGEST_BEYOND)
    if abs(beyond_s) < max(least_s, SIGMAS * found.error) or found.error > surely_s:
        return _as_often(sequence, Scalar(offset_s, found.error)) or _unknown(sequence, found)
    late = "late" if offset_s < 0.0 else "early"
    seen = (
        f"the camera turns as the gyro does when its stamps are shifted by {1e3 * offset_s:.1f} +- "
        f"{1e3 * found.error:.1f} ms"
    )
    detail = f"{seen}: frames are stamped {late}"
    change = change_of_offset(sequence, intervals)
    if change is not None and abs(change.value) > max(least_change_s(sequence, change.error), 0.5 * abs(offset_s)):
        return _changing(detail, change)
    remedy = _shifted(sequence, offset_s)
    if (worse := _velocities_against(evidence, remedy, offset_s)) > AGAINST_SHIFT:
        return Symptom.warning(
            count=1,
            detail=(
                f"{seen}, but then the velocities fit worse, by {worse:.1f} standard errors: the gyro alone is shifted"
            ),
            treatment="stamp rates of rotation and velocities by one clock, the camera's",
        )
    return Symptom(count=1, detail=detail, treatment="the frames are shifted by it", remedy=remedy)


def _velocities_against(evidence: Evidence, shifted: Sequence, offset_s: float) -> float:
    """Return by how many standard errors the twists' velocities fit the camera's worse after the frames are shifted."""
    before, after = evidence.intervals, evidence.after(shifted).intervals
    if before is None or after is None or before.v_mps is None or after.v_mps is None:
        return 0.0
    stamps_ns = shifted.frames_t_ns - round(offset_s * NS_PER_S)
    _, here, there = np.intersect1d(
        evidence.sequence.frames_t_ns[before.interval], stamps_ns[after.interval], return_indices=True
    )
    R_imu_cam, p_imu_cam = evidence.sequence.rig.T_imu_cam[:3, :3], evidence.sequence.rig.T_imu_cam[:3, 3]
    seen = before.v_cam_mps @ R_imu_cam.T - np.cross(before.w_cam_radps @ R_imu_cam.T, p_imu_cam)
    costs = cauchy(np.stack([before.v_mps[here] - seen[here], after.v_mps[there] - seen[here]]), LEAST_SPREAD_V)
    return mean_in_sigmas(costs[1] - costs[0])


def _changing(detail: str, change: Scalar) -> Symptom:
    """Report an offset that differs between the halves, so that no constant shift is right."""
    parted = f"{1e3 * change.value:.0f} +- {1e3 * change.error:.0f} ms"
    return Symptom.warning(
        count=1,
        detail=f"{detail}, but by {parted} more in the second half than in the first",
        treatment="a clock drifts or was set: stamp both by one clock, or cut the recording there",
    )


def _refined(found: Scalar | None, evidence: Evidence) -> Scalar | None:
    """Return the self-calibration's offset, unless that of the rotations is large and a self-calibration confirms it.

    Offsets by rotations have larger errors, and a wrong rotation of the extrinsic causes offsets of up to 0.1 s.
    """
    fitted = evidence.self_calibration
    if found is None or fitted is None:
        return found
    if abs(found.value) > NEAR_S:
        shifted = evidence.after(_shifted(evidence.sequence, found.value))
        if shifted.self_calibration is not None:
            return found
    return Scalar(float(fitted.value[LATE]), float(fitted.error[LATE]))


def _unknown(sequence: Sequence, found: Scalar) -> Undecided | None:
    """Return the standard error of an offset that is within chance, where it is large."""
    if found.error <= _largest_error_s(sequence):
        return _doubtful(sequence, found)
    known = f"the offset of camera and gyro is known to {1e3 * found.error:.0f} ms"
    return Undecided(f"too little change of rotation: {known}")


def _doubtful(sequence: Sequence, found: Scalar) -> Undecided | None:
    """Return, with an IMU, an offset that is beyond chance and below the limit of a finding."""
    if isinstance(sequence.motion, TwistSamples) or abs(found.value) < max(LEAST_S, DOUBTFUL_SIGMAS * found.error):
        return None
    late = "late" if found.value < 0.0 else "early"
    seen = f"{1e3 * abs(found.value):.0f} +- {1e3 * found.error:.0f} ms"
    return Undecided(
        f"frames look as if stamped {late} by {seen}, too little change of rotation to distinguish that from chance"
    )


def _largest_error_s(sequence: Sequence) -> float:
    return LARGEST_TWIST_ERROR_S if isinstance(sequence.motion, TwistSamples) else LARGEST_ERROR_S


def _as_often(sequence: Sequence, offset: Scalar) -> Symptom | None:
    """Report twists at the rate and a constant time from the frames, if the tracks allow an offset of that time."""
    if not isinstance(sequence.motion, TwistSamples) or (late_s := _constant_phase_s(sequence)) is None:
        return None
    step_s = float(np.median(np.diff(sequence.motion.t_ns))) / NS_PER_S
    near = [shift for shift in (-late_s, step_s - late_s) if abs(offset.value - shift) <= NEAR_SIGMAS * offset.error]
    if not near:
        return None
    shifts, sigmas = " or ".join(f"{1e3 * shift:+.0f}" for shift in near), abs(offset.value) / offset.error
    from_zero = "which is consistent with zero as well"
    if sigmas > NEAR_SIGMAS:
        from_zero = f"{sigmas:.1f} standard errors from zero"
    return Symptom.warning(
        count=1,
        detail=(
            f"twists have the rate of the frames, and each frame is {1e3 * late_s:.0f} ms after one, as if the "
            f"camera's clock were to be shifted by {shifts} ms; by the tracks the offset is "
            f"{1e3 * offset.value:+.0f} +- {1e3 * offset.error:.0f} ms, {from_zero}"
        ),
        treatment="if frames and twists were taken together, give them the same stamps",
    )


def _constant_phase_s(sequence: Sequence) -> float | None:
    """Return the time (s) from a sample to the next frame, where rates are equal and it is constant and not zero."""
    t_ns, frames_t_ns = sequence.motion.t_ns, sequence.frames_t_ns
    step_ns, tolerance = float(np.median(np.diff(t_ns))), CONSTANT_STEPS * float(np.median(np.diff(t_ns)))
    since_ns = frames_t_ns - t_ns[np.clip(np.searchsorted(t_ns, frames_t_ns, side="right") - 1, 0, t_ns.size - 1)]
    phase_ns = float(np.median(since_ns))
    varies = np.quantile(np.abs(since_ns - phase_ns), CONSTANT_SHARE) > tolerance
    if varies or abs(float(np.median(np.diff(frames_t_ns))) - step_ns) > tolerance:
        return None
    return phase_ns / NS_PER_S if tolerance < phase_ns < step_ns - tolerance else None


def _expected(sequence: Sequence) -> tuple[float, float]:
    """Return the offset (s) that the pairing of twists implies, and the largest difference that is no fault."""
    if not isinstance(sequence.motion, TwistSamples):
        return 0.0, LEAST_S
    step_s = float(np.median(np.diff(sequence.motion.t_ns))) / NS_PER_S
    least_s = (
        LEAST_TWIST_INTERVALS * step_s if is_stamped_at_frames(sequence) else max(LEAST_S, LEAST_OFF_FRAMES * step_s)
    )
    return (LAG[sequence.motion.pairing] - 0.5) * step_s, least_s


def _shifted(sequence: Sequence, offset_s: float) -> Sequence:
    """Return the sequence with its frames on the samples' clock, without frames outside the time of the samples."""
    shifted = replace(sequence, frames_t_ns=sequence.frames_t_ns + round(offset_s * NS_PER_S))
    motion_t_ns = sequence.motion.t_ns
    inside = (shifted.frames_t_ns >= motion_t_ns[0]) & (shifted.frames_t_ns <= motion_t_ns[-1])
    return shifted if inside.all() else keep_frames(shifted, np.flatnonzero(inside))


FAULT = Fault(
    "time-offset",
    "frames and motion samples stamped by different clocks",
    check,
    after=("mixed-axes", "twist-lag"),
)
