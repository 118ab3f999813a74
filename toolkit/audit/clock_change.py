"""Clocks of frames and motion samples that do not keep pace, or one of which was set during the recording.

The offset between the camera and the samples is the same in either half of the recording where the clocks keep pace,
whatever interval a sample stands for. No constant shift mends what is not. Beside an IMU it is that by which tracks and
samples fit together best, with a calibration that both halves share; where none is found, and beside odometry, it is
that of the rotations.
"""

import numpy as np

from toolkit.audit.fault import Evidence, Fault, Symptom, Undecided
from toolkit.audit.parts.bundle import CHANGE
from toolkit.audit.parts.intervals import Intervals
from toolkit.audit.parts.robust import Scalar
from toolkit.audit.parts.self_calibration import self_calibration
from toolkit.audit.time_offset import camera_offset

# Standard errors of the difference, and what sound recordings at hand have beyond them (s): the halves of drives 14 ms
# at most, those of recordings beside an IMU 3 ms. Chosen with them in view.
SIGMAS, SYSTEMATIC_S = 5.0, {"twist": 0.015, "imu": 0.005}
# Where a change must be larger than this (s) to be seen, nothing is said.
LARGEST_S = 0.1


def check(evidence: Evidence) -> Symptom | Undecided | None:
    """Compare the offsets of both halves."""
    intervals = evidence.intervals
    if intervals is None:
        return evidence.blind
    found = _fitted(evidence, intervals) or _of_rotations(evidence, intervals)
    if found is None:
        return Undecided("too little change of rotation in half of the recording: whether clocks keep pace is unknown")
    change_s, error_s = found.value, found.error
    least_s = SIGMAS * error_s + SYSTEMATIC_S[evidence.sequence.motion_kind]
    if least_s > LARGEST_S:
        known = f"clocks that part by less than {least_s:.2g} s between the halves would not show"
        return Undecided(f"too little change of rotation: {known}")
    if abs(change_s) < least_s:
        return None
    return Symptom(
        count=1,
        detail=(
            f"frames and motion samples part by {1e3 * change_s:.0f} +- {1e3 * error_s:.0f} ms from the first half of "
            "the recording to the second"
        ),
        treatment="a clock drifts or was set: stamp both by one clock, or cut the recording there",
        remedy=None,
        harmful=False,
        warns=True,
    )


def _fitted(evidence: Evidence, intervals: Intervals) -> Scalar | None:
    """Return the change by which tracks and IMU fit together; None where no calibration is found in both halves.

    Rotations of half a short recording may agree best at a shift that is none: their error is that about the shift.
    """
    found = evidence.self_calibration
    if found is not None and found.windows == 1:
        found = self_calibration(evidence.sequence, evidence.camera_motion, intervals, fewest_windows=2)
    if found is None or found.windows == 1:
        return None
    return Scalar(float(found.value[CHANGE]), float(found.error[CHANGE]))


def _of_rotations(evidence: Evidence, intervals: Intervals) -> Scalar | None:
    """Return the change of the offset at which the camera turns as the samples do; None where a half shows none."""
    sequence = evidence.sequence
    w_imu = intervals.w_cam_radps @ sequence.rig.T_imu_cam[:3, :3].T
    early = np.arange(len(w_imu)) < len(w_imu) // 2
    first, second = (camera_offset(sequence, intervals.select(rows), w_imu[rows]) for rows in (early, ~early))
    if first is None or second is None:
        return None
    return Scalar(second.value - first.value, float(np.hypot(first.error, second.error)))


FAULT = Fault(
    "clock-change",
    "clocks of frames and motion samples that part during the recording",
    check,
    after=("time-offset",),
)
