"""An extrinsic whose translation is that of its inverse.

A file can hold the rotation IMU -> camera together with the camera's position t in the IMU frame. Inverted like a rigid
transform, it puts the camera at p = -R_imu_cam t instead of t. Turns distinguish the two, because the camera's velocity
differs from the IMU's by w x p. The regression of `parts.alignment` over the whole recording estimates the position,
with the scale and the rotation of the camera as further unknowns. Where it lies between p and t decides.
"""

from dataclasses import replace

import numpy as np

from toolkit.audit.fault import Evidence, Fault, Symptom, Undecided
from toolkit.audit.parts.extrinsic import is_excluded, is_there, metres, way_gone
from toolkit.geometry import se3


def check(evidence: Evidence) -> Symptom | Undecided | None:
    """Compare the translation as given with that of the inverse; replace it where the latter is far more likely."""
    if evidence.intervals is None:
        return evidence.blind
    if evidence.intervals.v_mps is None or evidence.alignment is None:
        return None  # without velocities lever-arm estimates the position
    rig = evidence.sequence.rig
    rotation, given = rig.T_imu_cam[:3, :3], rig.T_imu_cam[:3, 3]
    candidate = -rotation.T @ given
    apart_m = float(np.linalg.norm(candidate - given))
    if apart_m == 0.0:
        return None
    share = way_gone(evidence.sequence, evidence.intervals, evidence.alignment, candidate - given)
    if is_excluded(share):
        return None
    where = (
        f"by the tracks during rotation it is {share.value:.2f} +- {share.error:.2f} of the way (of {apart_m:.2f} m) to"
    )
    if not is_there(share):
        summary = (
            f"the camera is at {metres(given)}, or at {metres(candidate)} if that is the translation of the inverse"
        )
        return Undecided(f"{summary}: {where} there, and there is too little rotation to decide")
    return Symptom(
        count=1,
        detail=(
            f"the camera at {metres(given)} in the IMU frame is the translation of the inverse: {where} "
            f"{metres(candidate)}"
        ),
        treatment="the camera's position is set to it",
        remedy=replace(evidence.sequence, rig=replace(rig, T_imu_cam=se3(rotation, candidate))),
    )


FAULT = Fault(
    "extrinsic-translation",
    "an extrinsic whose translation is that of its inverse",
    check,
    after=("mixed-axes", "motion-gap"),  # in the wrong axes no position fits
)
