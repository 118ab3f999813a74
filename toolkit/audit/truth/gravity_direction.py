"""Gravity in another direction of the truth's world than IMU and truth show, for example z down for z up.

The mean of the specific force over a recording, rotated into the world by the truth, is the mean acceleration less
gravity. An estimator that starts at the truth with gravity upside down accelerates at twice its size. The truth is used
where its rates of rotation agree with the gyro's. Without a truth there is nothing to compare: the first frame is
levelled by the samples.
"""

from dataclasses import replace

import numpy as np

from toolkit.audit.fault import Evidence, Fault, Symptom, Undecided
from toolkit.audit.parts.intervals import interval_means, is_comparable
from toolkit.geometry import Array, interpolate_poses, so3_log
from toolkit.measured_motion import ImuSamples
from toolkit.resampling import NS_PER_S
from toolkit.sequence import Sequence, Truth

# Least angle between both directions: sound recordings are within a degree, and 1 m/s^2 of mean acceleration that the
# truth does not show makes six. An axis of the world nearer than the second angle is taken as the direction of gravity.
LEAST_DEG, NEAR_AXIS_DEG = 30.0, 15.0
# Least length (s) of a recording, for its mean acceleration to be small, and the rate at which the truth is read.
LEAST_S, READ_HZ = 2.0, 20.0
# The rotations of truth and gyro agree if their squared difference is no more than this share of the squared rates.
MOST_LEFT = 0.25
STANDARD_MPS2 = 9.81


def check(evidence: Evidence) -> Symptom | Undecided | None:
    """Compare the given direction of gravity with that of the samples."""
    sequence, truth = evidence.sequence, evidence.sequence.truth
    if not isinstance(sequence.motion, ImuSamples) or truth is None or evidence.spoilt_by:
        return None
    if not is_comparable(sequence) or (measured := _measured(sequence, truth)) is None:
        return None
    given = sequence.gravity_world
    size_mps2 = float(np.linalg.norm(given))
    if size_mps2 > 0.0 and _angle_deg(given, measured) < LEAST_DEG:
        return None
    axis = np.zeros(3)
    largest = int(np.argmax(np.abs(measured)))
    axis[largest] = np.sign(measured[largest])
    measured_text, given_text = _rounded(measured), _rounded(given)
    summary = f"by the samples gravity is {measured_text} m/s^2 in the truth's world, and gravity_world is {given_text}"
    certain = _angle_deg(axis, measured) < NEAR_AXIS_DEG
    gravity_world = (size_mps2 if size_mps2 > 0.0 else STANDARD_MPS2) * axis
    return Symptom(
        count=1,
        detail=summary,
        treatment=f"it is set to {_rounded(gravity_world)}" if certain else "no axis of the world is near: correct it",
        remedy=replace(sequence, gravity_world=gravity_world) if certain else None,
    )


def _measured(sequence: Sequence, truth: Truth) -> Array | None:
    """Return gravity (3,) m/s^2 in the truth's world; None where the truth is short, or rotates otherwise."""
    in_order = truth.t_ns.size >= 2 and (np.diff(truth.t_ns) > 0).all() and np.isfinite(truth.T_world_imu).all()
    begin_ns = max(int(truth.t_ns[0]), int(sequence.motion.t_ns[0])) if truth.t_ns.size else 0
    end_ns = min(int(truth.t_ns[-1]), int(sequence.motion.t_ns[-1])) if truth.t_ns.size else 0
    duration_s = (end_ns - begin_ns) / NS_PER_S
    if not in_order or duration_s < LEAST_S:
        return None
    t_ns = np.linspace(begin_ns, end_ns, round(READ_HZ * duration_s) + 1).astype(np.int64)
    poses, step_s = interpolate_poses(truth.t_ns, truth.T_world_imu, t_ns), np.diff(t_ns)[:, None] / NS_PER_S
    R_world_imu = poses[:, :3, :3]
    mean = interval_means(sequence.motion.t_ns, sequence.motion.values, t_ns)
    seen, turned = mean[:, 3:], so3_log(R_world_imu[:-1].swapaxes(1, 2) @ R_world_imu[1:]) / step_s
    apart = turned - seen
    apart, seen = apart - np.median(apart, axis=0), seen - np.median(seen, axis=0)
    if np.sum(apart**2) > MOST_LEFT * np.sum(seen**2):
        return None
    v_world = np.diff(poses[:, :3, 3], axis=0) / step_s
    faster = (np.median(v_world[-5:], axis=0) - np.median(v_world[:5], axis=0)) / duration_s
    force = np.mean((R_world_imu[:-1] @ mean[:, :3, None])[..., 0], axis=0)
    return np.asarray(faster - force)


def _angle_deg(a: Array, b: Array) -> float:
    return float(np.degrees(np.arccos(np.clip(a @ b / (np.linalg.norm(a) * np.linalg.norm(b)), -1.0, 1.0))))


def _rounded(vector: Array) -> str:
    return "(" + ", ".join(f"{x:.2f}" for x in vector) + ")"


FAULT = Fault(
    "gravity-direction",
    "gravity whose direction in the truth's world differs from the IMU's",
    check,
    after=("accelerometer-axes", "time-offset"),
)
