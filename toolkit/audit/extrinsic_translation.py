"""An extrinsic whose translation belongs to its inverse.

A file can hold a rotation IMU -> camera beside the camera's position in the IMU frame; inverted like a proper
transform it puts the camera at p = -R_imu_cam t instead of t. Rotation distinguishes the two: the camera's velocity
differs from the IMU's by w x p. The measured share s of the way from the given p to the candidate t is a
regression over the whole file; real odometry misplaces p by some decimetres, which is allowed for.
"""

from dataclasses import replace

import numpy as np

from toolkit.audit.fault import Evidence, Fault, Symptom, Undecided
from toolkit.audit.parts.intervals import Intervals
from toolkit.audit.parts.robust import Scalar, slope
from toolkit.geometry import Array, se3

# Largest standard error of the share: beyond it there was too little rotation, and no fault is reported.
LARGEST_ERROR = 0.1
# Standard errors by which the measured lever arm must lie beyond the middle between the two candidates.
BEYOND_MIDDLE = 3.0
# Standard deviations it may be away from the one that is chosen.
NEAR_CANDIDATE = 4.0
# How far from the true lever arm (m) a regression on real odometry lands. Measured: 0.6 to 1 m towards
# the other one on KITTI, whose INS velocities slip sideways in turns by 0.35 m times the turning rate.
LEVER_ARM_SIGMA_M = 0.3
# Log-likelihood ratio from which the candidate is accepted.
LOG_ODDS = 3.0


def check(evidence: Evidence) -> Symptom | Undecided | None:
    """Weigh the translation as given against that of the inverse; replace it where the latter is far likelier."""
    if evidence.intervals is None:
        return evidence.blind
    if evidence.intervals.v_mps is None:
        return None  # no velocity to weigh: lever-arm measures the position itself
    rig = evidence.sequence.rig
    rotation, given = rig.T_imu_cam[:3, :3], rig.T_imu_cam[:3, 3]
    candidate = -rotation.T @ given
    apart_m = float(np.linalg.norm(candidate - given))
    if apart_m == 0.0:
        return None
    share = _share(evidence.intervals, evidence.intervals.v_mps, rig.T_imu_cam, candidate)
    variance = share.error**2 + (LEVER_ARM_SIGMA_M / apart_m) ** 2
    log_odds = (share.value**2 - (share.value - 1.0) ** 2) / (2.0 * variance)
    clearly_nearer = share.error < LARGEST_ERROR and share.value - BEYOND_MIDDLE * share.error > 0.5
    explained = abs(share.value - 1.0) < NEAR_CANDIDATE * np.sqrt(variance)
    if share.error >= LARGEST_ERROR:
        where = f"{share.value:.1f} +- {share.error:.1f} of the way to where the inverse has it"
        return Undecided(f"too little rotation: the tracks put the camera {where}")
    if not (clearly_nearer and explained and log_odds > LOG_ODDS):
        return None
    return Symptom(
        count=1,
        detail=(
            f"the camera at {_metres(given)} in the IMU frame is the translation of the inverse: in turns the tracks "
            f"put it {share.value:.2f} +- {share.error:.2f} of the way (of {apart_m:.2f} m) to {_metres(candidate)}"
        ),
        treatment="it is put there",
        remedy=replace(evidence.sequence, rig=replace(rig, T_imu_cam=se3(rotation, candidate))),
    )


def _share(intervals: Intervals, v_mps: Array, T_imu_cam: Array, candidate: Array) -> Scalar:
    """Estimate s in v_imu = v_cam - w x (given + s (candidate - given))."""
    given = T_imu_cam[:3, 3]
    w_imu = intervals.w_cam_radps @ T_imu_cam[:3, :3].T
    unexplained = v_mps - intervals.v_cam_mps @ T_imu_cam[:3, :3].T + np.cross(w_imu, given)
    per_share = -np.cross(w_imu, candidate - given)
    return slope(per_share, per_share, unexplained)


def _metres(position: Array) -> str:
    return "(" + ", ".join(f"{x:.2f}" for x in position) + ")"


FAULT = Fault(
    "extrinsic-translation",
    "an extrinsic whose translation is that of its inverse",
    check,
    after=("mixed-axes", "motion-gap"),  # in the wrong axes no lever arm fits
)
