"""An accelerometer or a gyro at the end of its range: larger values are cut off and lost.

Samples that are cut off accumulate at the largest value of an axis, while those of a sensor within its range become
fewer towards it. Nothing is repaired, because the true values are unknown.
"""

import numpy as np

from toolkit.audit.fault import Evidence, Fault, Symptom
from toolkit.geometry import Array, BoolArray

# Least number of samples at the largest value of an axis, and the least ratio to the number at the value next to it. A
# sensor with coarse steps also has several samples at its largest value, but more at the one next to it.
LEAST_COUNT, LEAST_RATIO = 10, 3.0
AXES = tuple(f"{sensor} {axis}" for sensor in ("accelerometer", "gyro") for axis in "xyz")
UNITS = ("m/s^2", "m/s^2", "m/s^2", "rad/s", "rad/s", "rad/s")


def check(evidence: Evidence) -> Symptom | None:
    """Report the axes whose samples accumulate at an end of the range, with their number and value."""
    if evidence.sequence.motion_kind != "imu":
        return None
    values = evidence.sequence.motion.values
    findings, rows = list[str](), np.zeros(len(values), dtype=bool)
    for name, unit, column in zip(AXES, UNITS, values.T, strict=True):
        for sign in (1.0, -1.0):
            at_end = _at_range_end(sign * column)
            if at_end.any():
                rows |= at_end
                findings.append(f"{name} at {column[at_end][0]:.3g} {unit} ({at_end.sum()} samples)")
    if not findings:
        return None
    return Symptom.warning(
        count=int(rows.sum()),
        detail=f"samples accumulate at the end of a range: {', '.join(findings)}",
        treatment="values beyond it are lost: use a sensor of a larger range",
    )


def _at_range_end(column: Array) -> BoolArray:
    """Say which samples (S,) are at the largest value, if they are too many for a sensor within its range."""
    distinct, counts = np.unique(column, return_counts=True)
    if distinct.size < 2 or counts[-1] < max(LEAST_COUNT, LEAST_RATIO * counts[-2]):
        return np.zeros(column.size, dtype=bool)
    return np.asarray(column == distinct[-1])


FAULT = Fault(
    "saturated-samples",
    "an accelerometer or a gyro that is saturated",
    check,
    after=("not-finite", "implausible", "stuck-samples"),
)
