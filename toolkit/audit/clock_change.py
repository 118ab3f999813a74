"""Clocks of frames and motion samples that do not keep pace, or one of which was set during the recording.

The offset between the camera's rotation and the gyro, estimated in either half of the recording, is the same where the
clocks keep pace, whatever interval a sample stands for. No constant shift mends what is not.
"""

import numpy as np

from toolkit.audit.fault import Evidence, Fault, Symptom, Undecided
from toolkit.audit.time_offset import camera_offset

# Standard errors of the difference, and what sound recordings at hand have beyond them (s): the halves of drives 14 ms
# at most, those of recordings beside an IMU 3 ms. Chosen with them in view.
SIGMAS, SYSTEMATIC_S = 5.0, {"twist": 0.015, "imu": 0.005}
# Where a change must be larger than this (s) to be seen, nothing is said.
LARGEST_S = 0.1


def check(evidence: Evidence) -> Symptom | Undecided | None:
    """Compare the offsets of both halves."""
    intervals, sequence = evidence.intervals, evidence.sequence
    if intervals is None:
        return evidence.blind
    w_imu = intervals.w_cam_radps @ sequence.rig.T_imu_cam[:3, :3].T
    early = np.arange(len(w_imu)) < len(w_imu) // 2
    found = [camera_offset(sequence, intervals.select(rows), w_imu[rows]) for rows in (early, ~early)]
    first, second = found
    if first is None or second is None:
        return Undecided("too little change of rotation in half of the recording: whether clocks keep pace is unknown")
    change_s, error_s = second.value - first.value, float(np.hypot(first.error, second.error))
    least_s = SIGMAS * error_s + SYSTEMATIC_S[sequence.motion_kind]
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


FAULT = Fault(
    "clock-change",
    "clocks of frames and motion samples that part during the recording",
    check,
    after=("time-offset",),
)
