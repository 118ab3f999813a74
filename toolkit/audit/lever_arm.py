"""A camera that stands elsewhere on the vehicle than the extrinsic says, or velocities of another point of it.

In a turn of rate w a camera that is off by p moves by w x p against what is expected of it: residuals that come and go
with the turns. Neither source tells which is wrong.
"""

import numpy as np

from toolkit.audit.fault import Evidence, Fault, Symptom, Undecided

# Each axis counts from so many standard errors on, beyond what sound recordings at hand have (m). The velocities of
# cars are those of another point, or slip: 0.43 to 0.85 m along x in all of seven; beside IMUs it is 0.06 m at most.
SIGMAS, SYSTEMATIC_M = 5.0, {"twist": 0.6, "imu": 0.05}
# An axis about which the position is known worse than this (m) is not judged.
LARGEST_ERROR_M = 0.25


def check(evidence: Evidence) -> Symptom | Undecided | None:
    """Name the axes along which the camera is not where the extrinsic has it."""
    if evidence.intervals is None:
        return evidence.blind
    found, kind = evidence.alignment, evidence.sequence.motion_kind
    if found is None or not (judged := found.lever_error_m < LARGEST_ERROR_M).any():
        errors = "" if found is None else f" to {', '.join(f'{error:.1f}' for error in found.lever_error_m)} m"
        return Undecided(f"too little rotation: where the camera is along x, y and z is not known{errors}")
    off = judged & (np.abs(found.lever_m) > SYSTEMATIC_M[kind] + SIGMAS * found.lever_error_m)
    if not off.any():
        return None
    axes = np.flatnonzero(off).tolist()
    told = [f"{found.lever_m[k]:+.2f} +- {found.lever_error_m[k]:.2f} m along {'xyz'[k]}" for k in axes]
    other_point = "" if kind == "imu" else ", and which point of the vehicle the velocities are of"
    return Symptom(
        count=len(axes),
        detail=f"residuals turn with the vehicle: the camera is off by {', '.join(told)} from where T_imu_cam has it",
        treatment=f"check the translation of T_imu_cam{other_point}",
        remedy=None,
        harmful=False,
        warns=True,
    )


FAULT = Fault(
    "lever-arm",
    "a camera that stands elsewhere than the extrinsic says, as its turns show",
    check,
    after=("accelerometer-axes", "disagreement"),
)
