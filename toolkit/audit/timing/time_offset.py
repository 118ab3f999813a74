"""Frames stamped by another clock than the motion samples, or with a constant delay of the camera.

The camera's rotation, from its tracks alone, is the mean of the gyro over each interval, shifted by the offset
(`parts.clocks`).

A twist that is stamped at the frames is judged by its lag; here only an offset that no pairing of it explains. Where it
is stamped elsewhere no pairing mends it, and the frames are shifted to where the samples, as they are paired, fit. An
offset that half of the recording has, or that grows, is none to be shifted by: that is a change of the clock. Nor is
one that the velocities of a twist speak against: then the rates of rotation alone are late, and the camera is not.
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

# An offset is one beyond so many standard errors and beyond what is no fault: a sample of an IMU may stand for the
# interval before or after its stamp, 5 ms at 100 Hz. A twist may stand for the interval before its stamp or after it,
# which is half of one from the middle, and be one off: an indoor recording that is taken for sound is by 0.8.
SIGMAS, LEAST_S, LEAST_TWIST_INTERVALS = 5.0, 0.005, 1.5
# Beside an IMU no sound recording at hand is farther beyond than 3.1 standard errors; from so many on it is said.
DOUBTFUL_SIGMAS = 3.2
# Between frames nothing of that can be told from the clock, and what the shift mends is either.
LEAST_OFF_FRAMES = 0.25
# The velocities speak against a shift that explains them worse by so many standard errors. The halves and thirds of the
# indoor recording whose gyro is late have 3.4 and 3.5; planted offsets of 0.2 and 0.3 s on four real drives and a
# simulated one, -0.1 at most. Chosen between these.
AGAINST_SHIFT = 2.5
# A self-calibration finds offsets (s) no larger than this.
NEAR_S = 0.025
# With a larger standard error (s) than these no offset is ruled out; one that is beyond chance is believed up to twice
# as much, but where a twist leaves open which interval it describes.
LARGEST_ERROR_S, LARGEST_TWIST_ERROR_S, LARGEST_BEYOND = 0.0064, 0.0125, 2.0
# Twists stand a constant time beside the frames where nine in ten do so to this share of their step. Clocks that drift,
# and rates that differ, have no such constant. What is within so many standard errors the tracks do not exclude.
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
            detail=f"{seen}, but then the velocities fit worse, by {worse:.1f} standard errors: the gyro alone is off",
            treatment="stamp rates of rotation and velocities by one clock, the camera's",
        )
    return Symptom(count=1, detail=detail, treatment="the frames are shifted by it", remedy=remedy)


def _velocities_against(evidence: Evidence, shifted: Sequence, offset_s: float) -> float:
    """Return by how many standard errors a twist's velocities fit the camera's worse once the frames are shifted."""
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
    """Tell of an offset that no constant shift mends, for half of the recording has another one."""
    parted = f"{1e3 * change.value:.0f} +- {1e3 * change.error:.0f} ms"
    return Symptom.warning(
        count=1,
        detail=f"{detail}, but by {parted} more in the second half than in the first",
        treatment="a clock drifts or was set: stamp both by one clock, or cut the recording there",
    )


def _refined(found: Scalar | None, evidence: Evidence) -> Scalar | None:
    """Return the offset by which tracks and IMU fit together, where that of the rotations is near or fits nothing.

    Rotations err more, and of a camera that is turned they make an offset of up to a tenth of a second.
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
    """Say how well an offset is known that is no more than chance, where that is badly."""
    if found.error <= _largest_error_s(sequence):
        return _doubtful(sequence, found)
    known = f"the offset of camera and gyro is known to {1e3 * found.error:.0f} ms"
    return Undecided(f"too little change of rotation: {known}")


def _doubtful(sequence: Sequence, found: Scalar) -> Undecided | None:
    """Say of an IMU's recording that its offset is between what chance makes and what is told."""
    if isinstance(sequence.motion, TwistSamples) or abs(found.value) < max(LEAST_S, DOUBTFUL_SIGMAS * found.error):
        return None
    late = "late" if found.value < 0.0 else "early"
    seen = f"{1e3 * abs(found.value):.0f} +- {1e3 * found.error:.0f} ms"
    return Undecided(
        f"frames look as if stamped {late} by {seen}, too little change of rotation to tell that from chance"
    )


def _largest_error_s(sequence: Sequence) -> float:
    return LARGEST_TWIST_ERROR_S if isinstance(sequence.motion, TwistSamples) else LARGEST_ERROR_S


def _as_often(sequence: Sequence, offset: Scalar) -> Symptom | None:
    """Tell of twists that come as often as frames and a constant time beside them, if the tracks allow a late clock."""
    if not isinstance(sequence.motion, TwistSamples) or (late_s := _constant_phase_s(sequence)) is None:
        return None
    step_s = float(np.median(np.diff(sequence.motion.t_ns))) / NS_PER_S
    near = [shift for shift in (-late_s, step_s - late_s) if abs(offset.value - shift) <= NEAR_SIGMAS * offset.error]
    if not near:
        return None
    shifts = " or ".join(f"{1e3 * shift:+.0f}" for shift in near)
    return Symptom.warning(
        count=1,
        detail=(
            f"twists come as often as frames, and each frame {1e3 * late_s:.0f} ms after one: a camera's clock that is "
            f"to be shifted by {shifts} ms looks so; by the tracks it is {1e3 * offset.value:+.0f} +- "
            f"{1e3 * offset.error:.0f} ms, which does not tell that from none"
        ),
        treatment="if frames and twists were taken together, give them the same stamps",
    )


def _constant_phase_s(sequence: Sequence) -> float | None:
    """Return how long (s) after a sample frames are stamped, where that is constant, not nothing, at equal rates."""
    t_ns, frames_t_ns = sequence.motion.t_ns, sequence.frames_t_ns
    step_ns, tolerance = float(np.median(np.diff(t_ns))), CONSTANT_STEPS * float(np.median(np.diff(t_ns)))
    since_ns = frames_t_ns - t_ns[np.clip(np.searchsorted(t_ns, frames_t_ns, side="right") - 1, 0, t_ns.size - 1)]
    phase_ns = float(np.median(since_ns))
    varies = np.quantile(np.abs(since_ns - phase_ns), CONSTANT_SHARE) > tolerance
    if varies or abs(float(np.median(np.diff(frames_t_ns))) - step_ns) > tolerance:
        return None
    return phase_ns / NS_PER_S if tolerance < phase_ns < step_ns - tolerance else None


def _expected(sequence: Sequence) -> tuple[float, float]:
    """Return the offset (s) that a right pairing of twists shows, and the largest that is no fault."""
    if not isinstance(sequence.motion, TwistSamples):
        return 0.0, LEAST_S
    step_s = float(np.median(np.diff(sequence.motion.t_ns))) / NS_PER_S
    least_s = (
        LEAST_TWIST_INTERVALS * step_s if is_stamped_at_frames(sequence) else max(LEAST_S, LEAST_OFF_FRAMES * step_s)
    )
    return (LAG[sequence.motion.pairing] - 0.5) * step_s, least_s


def _shifted(sequence: Sequence, offset_s: float) -> Sequence:
    """Return the sequence with its frames on the motion's clock, without those that its samples do not reach."""
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
