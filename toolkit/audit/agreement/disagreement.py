"""Tracks that do not follow the measured motion after all repairs: the calibration or the samples are wrong.

This is the final check of the calibration. It reports what no other fault explains, and what a repair has left.
"""

from collections.abc import Mapping

import numpy as np

from toolkit.audit.fault import Evidence, Fault, Symptom, Undecided
from toolkit.audit.parts.intervals import LEAST_INTERVALS
from toolkit.audit.parts.ratios import (
    FORCES,
    MOST_FORCE_RATIO,
    MOST_RATIO,
    RATES,
    SPEEDS,
    force_ratio,
    rotation_ratio,
    speed_ratio,
)
from toolkit.audit.parts.robust import Scalar

# A ratio must be so many standard errors beyond its limit. The noise of the camera's rotation lowers the ratio of the
# rates of rotation, so that ratio has only an upper limit.
SIGMAS = 5.0
# Vision's speed is accurate to 5 % in sound recordings. A unit is named where the ratio is this near to its factor.
NEAR_UNIT = 0.08
# Units that are named and not converted: their factors are too near to those of other units or other faults.
OTHER_SPEEDS, OTHER_FORCES = {"knots": 1.944}, {"ft/s^2": 3.281}
OTHER_RATES = {"turns a minute": 30.0 / np.pi, "mrad/s": 1000.0}
# Velocities in the faster half whose median angle exceeds this have a wrong sign, or axes that no repair corrected.
MOST_ANGLE_DEG = 60.0


def check(evidence: Evidence) -> Symptom | Undecided | None:
    """Compare the median one-step residual with what the noise explains, and the sizes of the motions."""
    if evidence.intervals is None:
        return evidence.blind
    found = evidence.agreement
    findings = _ratios(evidence)
    if found.residual_px > found.limit_px or found.own_px > found.limit_px or findings:
        findings.append(
            f"the tracks' residuals from frame to frame are {found.residual_px:.2f} px against the measured motion "
            f"(median; noise explains {found.limit_px:.2f} px at most) and {found.own_px:.2f} px against the camera "
            "motion that fits them best"
        )
    if not findings:
        return None
    treatment = "T_imu_cam, the intrinsics, the baseline or the samples are wrong: check them"
    if found.own_px > found.limit_px:
        treatment = "the intrinsics or the tracks themselves are wrong: check K and the pixels"
    return Symptom(count=1, detail="; ".join(findings), treatment=treatment, remedy=None)


def _ratios(evidence: Evidence) -> list[str]:
    """Describe which sizes of the motion differ from the camera's, or from gravity, by a factor."""
    assert evidence.intervals is not None
    speed, force = speed_ratio(evidence.intervals), force_ratio(evidence.sequence)
    rotation = rotation_ratio(evidence.intervals)
    findings = []
    angle_deg = _median_angle_deg(evidence)
    if angle_deg is not None and angle_deg > MOST_ANGLE_DEG:
        findings.append(f"the samples' velocity points {angle_deg:.0f} degrees away from the camera's (median)")
    if speed is not None and _is_off(speed, 1.0 / MOST_RATIO, MOST_RATIO):
        meant = _units_meant(speed.value, SPEEDS | OTHER_SPEEDS)
        findings.append(f"the samples' speed is {speed.value:.3g} +- {speed.error:.1g} times the camera's{meant}")
    if _is_off(rotation, 0.0, MOST_RATIO):
        meant = _units_meant(rotation.value, RATES | OTHER_RATES)
        findings.append(
            f"the gyro turns {rotation.value:.3g} +- {rotation.error:.1g} times as fast as the camera{meant}"
        )
    if force is not None and _is_off(force, 1.0 / MOST_FORCE_RATIO, MOST_FORCE_RATIO):
        meant = _units_meant(force.value, FORCES | OTHER_FORCES)
        findings.append(f"the accelerometer reads {force.value:.3g} times gravity (median){meant}")
    return findings


def _units_meant(ratio: float, factors: Mapping[str, float]) -> str:
    """Name the units whose factor is near a ratio, if there are any."""
    units = [unit for unit, factor in factors.items() if abs(ratio / factor - 1.0) < NEAR_UNIT]
    return f", as if in {' or '.join(units)}" if units else ""


def _median_angle_deg(evidence: Evidence) -> float | None:
    """Return the median angle between the samples' velocity and the camera's in the faster half; None with an IMU."""
    intervals = evidence.intervals
    assert intervals is not None
    if intervals.v_mps is None:
        return None
    T_imu_cam = evidence.sequence.rig.T_imu_cam
    w_radps, seen = intervals.w_cam_radps @ T_imu_cam[:3, :3].T, intervals.v_cam_mps @ T_imu_cam[:3, :3].T
    measured = intervals.v_mps + np.cross(w_radps, T_imu_cam[:3, 3])
    lengths = np.linalg.norm(measured, axis=1) * np.linalg.norm(seen, axis=1)
    moving = lengths > np.median(lengths)
    if moving.sum() < LEAST_INTERVALS // 2:
        return None
    cosine = np.sum(measured * seen, axis=1)[moving] / lengths[moving]
    return float(np.degrees(np.arccos(np.clip(np.median(cosine), -1.0, 1.0))))


def _is_off(ratio: Scalar, least: float, most: float) -> bool:
    margin = SIGMAS * ratio.error
    return not least - margin <= ratio.value <= most + margin


FAULT = Fault(
    "disagreement",
    "tracks that are inconsistent with the measured motion, for a reason that no other fault explains",
    check,
    after=("units", "intrinsics", "mixed-axes", "extrinsic-translation", "twist-lag", "time-offset"),
)
