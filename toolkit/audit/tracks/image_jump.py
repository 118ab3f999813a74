"""An image that is displaced from some time on: a knock of the camera, another crop, a stabiliser.

For one interval the camera seems to rotate by an angle that the gyro did not measure. A slip of the tracks causes the
same, but does not last. With odometry the direction of the camera's velocity must change by the same angle from then
on. With an IMU, whose gyro has little noise, a single such interval is enough.
"""

import numpy as np

from toolkit.audit.fault import Evidence, Fault, Symptom, Undecided
from toolkit.audit.parts.intervals import Intervals
from toolkit.audit.parts.robust import Scalar, median_error
from toolkit.geometry import Array
from toolkit.models.gating import MAD_TO_SIGMA
from toolkit.resampling import NS_PER_S

# An interval is a candidate beyond so many standard deviations of all and beyond this angle (rad). Single intervals of
# sound recordings have up to 9 and 0.007 with an IMU, and up to 21 and 0.021 on drives, without a lasting rotation.
SIGMAS, LEAST_RAD = 12.0, 0.008
# The intervals before and after it must be less than this share of it.
ALONE = 0.5
# The lasting rotation, over so many intervals before and after, must be within these shares of the jump, and so many
# standard errors from zero. Real drives have shares of 1.26 to 1.43 where a jump was planted; three slips of the tracks
# in 03 have 0.0, 0.4 and 2.1.
AROUND, STAYS_SIGMAS, SHARE = 60, 4.0, (0.5, 1.75)
LEAST_AROUND = 10


def check(evidence: Evidence) -> Symptom | Undecided | None:
    """Report the times at which the camera's axes rotate and stay rotated."""
    if evidence.intervals is None:
        return evidence.blind
    sequence, intervals = evidence.sequence, evidence.intervals
    frame_s = (sequence.frames_t_ns - sequence.frames_t_ns[0]) / NS_PER_S
    R_imu_cam = sequence.rig.T_imu_cam[:3, :3]
    excess_radps = intervals.w_cam_radps @ R_imu_cam.T - intervals.w_radps
    excess_radps = excess_radps - np.median(excess_radps, axis=0)
    turn_rad = excess_radps * np.diff(frame_s)[intervals.interval][:, None]
    sigma_rad = np.maximum(MAD_TO_SIGMA * np.median(np.abs(turn_rad), axis=0), 1e-9)
    size, angle_rad = np.linalg.norm(turn_rad / sigma_rad, axis=1), np.linalg.norm(turn_rad, axis=1)
    beside = np.maximum(np.append(size[1:], 0.0), np.insert(size[:-1], 0, 0.0))
    jumps = np.flatnonzero((size > SIGMAS) & (angle_rad > LEAST_RAD) & (beside < ALONE * size))
    if not jumps.size:
        return None
    stay = [k for k in jumps.tolist() if _stays(intervals, sequence.rig.T_imu_cam, k, turn_rad[k])]
    places = [f"{frame_s[intervals.interval[k]]:.1f} s (by {angle_rad[k]:.3f} rad)" for k in stay or jumps.tolist()]
    if not stay:
        return Undecided(
            f"the camera jumps at {', '.join(places)}, and its velocity does not show whether the change is permanent"
        )
    return Symptom.warning(
        count=len(stay),
        detail=f"the image jumps, and not the vehicle, at {', '.join(places)}",
        treatment="the camera was knocked or the image was cropped anew: cut the recording there",
    )


def _stays(intervals: Intervals, T_imu_cam: Array, k: int, turn_rad: Array) -> bool:
    """Say whether the camera's velocity is rotated by that angle after interval ``k``; True with an IMU."""
    if intervals.v_mps is None:
        return True
    share = _share_that_stays(intervals, intervals.v_mps, T_imu_cam, k, turn_rad)
    return share is not None and max(SHARE[0], STAYS_SIGMAS * share.error) < share.value < SHARE[1]


def _share_that_stays(intervals: Intervals, v_mps: Array, T_imu_cam: Array, k: int, turn_rad: Array) -> Scalar | None:
    """Return the share of a rotation by which the camera's velocity is rotated after interval k and not before."""
    w_imu, seen = intervals.w_cam_radps @ T_imu_cam[:3, :3].T, intervals.v_cam_mps @ T_imu_cam[:3, :3].T
    deviation = v_mps + np.cross(w_imu, T_imu_cam[:3, 3]) - seen
    expected = np.cross(turn_rad, seen)  # if the camera is rotated by it against its extrinsic
    size = np.sum(expected**2, axis=1)
    before, after = slice(max(k - AROUND, 0), k), slice(k + 1, k + 1 + AROUND)
    shares = np.sum(deviation * expected, axis=1) / np.maximum(size, 1e-12)
    one, other = shares[before, None], shares[after, None]
    if min(len(one), len(other)) < LEAST_AROUND:
        return None
    error = float(np.hypot(median_error(one)[0], median_error(other)[0]))
    return Scalar(float(np.median(other) - np.median(one)), error)


FAULT = Fault(
    "image-jump",
    "an image that jumps, permanently, while the vehicle does not",
    check,
    after=("mixed-axes", "twist-lag", "time-offset"),
)
