"""A frame as ``correction`` and ``landmark_map`` have it, by compiled kernels; imported only where they run."""

from functools import lru_cache

import numpy as np

from filters.kalman.correction import FrameCorrection
from filters.kalman.gate import FrameGate
from filters.kalman.kernels import decoupled as kernel
from filters.kalman.landmark_map import LandmarkMap
from toolkit.geometry import Array
from toolkit.models import left_only
from toolkit.models.gating import huber_threshold
from toolkit.models.state import Belief
from toolkit.sequence import StereoRig, is_left_only

COMPILED = kernel.COMPILED
_DOF = np.array([3, 2])


def corrected(
    belief: Belief, landmarks: LandmarkMap, uvs_px: Array, rig: StereoRig, gate: FrameGate
) -> FrameCorrection:
    """Correct the pose by the landmarks, then the landmarks by the pose: ``correction.corrected``, compiled."""
    missing = is_left_only(uvs_px)
    measured = np.where(np.isnan(uvs_px), 0.0, uvs_px) if missing.any() else uvs_px
    moved_by, step, cov, points, covs, nis, accepted = kernel.correct(
        (landmarks.points, landmarks.covs, measured[:, None], missing),
        (np.array(belief.T_world_imu[None], order="C"), np.array(belief.cov, order="C")),
        _camera(rig),
        _rules(gate.probability, gate.huber),
    )
    gate.count(nis, left_only.degrees_of_freedom(uvs_px), accepted)
    moved = belief.displaced(moved_by, step[0])
    corrected = Belief(moved.layout, moved.T_world_imu, moved.v_world, moved.bias, cov)
    return FrameCorrection(corrected, LandmarkMap(landmarks.track_ids, points, covs))


def started(uvs_px: Array, T_world_imu: Array, rig: StereoRig) -> tuple[Array, Array]:
    """Return where stereo sees N landmarks and how well: ``landmark_map.started``, compiled."""
    points, covs = kernel.start(uvs_px, np.array(T_world_imu[None], order="C"), _camera(rig))
    return points, covs


@lru_cache(maxsize=4)
def _camera(rig: StereoRig) -> tuple[Array, Array, Array]:
    intrinsics = np.array([rig.fx_px, rig.fy_px, rig.cx_px, rig.cy_px, rig.baseline_m])
    return intrinsics, np.array(rig.T_imu_cam[None]), np.stack([rig.cov_uv_px2, left_only.left_noise_px2(rig)])


@lru_cache(maxsize=4)
def _rules(probability: float | None, huber: float | None) -> Array:
    thresholds = np.full(2, np.inf) if huber is None else huber_threshold(_DOF, huber)
    return np.column_stack([FrameGate(probability).bound(_DOF), thresholds])
