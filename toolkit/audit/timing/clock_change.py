"""Clocks of frames and motion samples that run at different rates, or one of which was set during the recording.

With clocks of one rate, the offset between camera and samples is the same in both halves of the recording, whatever
interval a sample describes. If it changes, no constant shift is right. With an IMU the change is an unknown of the
self-calibration, whose other unknowns both halves share. With odometry, and where no calibration is found, it is the
difference of the offsets that the rotations have in both halves.
"""

from toolkit.audit.fault import Evidence, Fault, Symptom, Undecided
from toolkit.audit.parts.bundle import CHANGE
from toolkit.audit.parts.clocks import change_of_offset, least_change_s
from toolkit.audit.parts.intervals import Intervals
from toolkit.audit.parts.robust import Scalar
from toolkit.audit.parts.self_calibration import self_calibration

# Where only a change larger than this (s) would be found, the finding is undecided and says so.
LARGEST_S = 0.1


def check(evidence: Evidence) -> Symptom | Undecided | None:
    """Compare the offsets of both halves."""
    intervals = evidence.intervals
    if intervals is None:
        return evidence.blind
    found = _fitted(evidence, intervals) or change_of_offset(evidence.sequence, intervals)
    if found is None:
        return Undecided("too little change of rotation in half of the recording: whether the clocks drift is unknown")
    change_s, error_s = found.value, found.error
    least_s = least_change_s(evidence.sequence, error_s)
    if least_s > LARGEST_S:
        known = f"a change of the offset by less than {least_s:.2g} s between the halves would not show"
        return Undecided(f"too little change of rotation: {known}")
    if abs(change_s) < least_s:
        return None
    return Symptom.warning(
        count=1,
        detail=(
            f"the offset of frames and motion samples changes by {1e3 * change_s:.0f} +- {1e3 * error_s:.0f} ms from "
            "the first half of the recording to the second"
        ),
        treatment="a clock drifts or was set: stamp both by one clock, or cut the recording there",
    )


def _fitted(evidence: Evidence, intervals: Intervals) -> Scalar | None:
    """Return the change (s) by the self-calibration; None where it has no windows in both halves.

    Rotations of half a short recording may agree best at a wrong shift, about which their standard error is too small.
    """
    found = evidence.self_calibration
    if found is not None and found.windows == 1:
        found = self_calibration(evidence.sequence, evidence.camera_motion, intervals, fewest_windows=2)
    if found is None or found.windows == 1:
        return None
    return Scalar(float(found.value[CHANGE]), float(found.error[CHANGE]))


FAULT = Fault(
    "clock-change",
    "clocks of frames and motion samples that drift apart during the recording",
    check,
    after=("time-offset",),
)
