"""Sightings of many landmarks from many poses as information on the poses alone: the landmarks are eliminated.

Each track is a smart factor (Carlone, Kira, Beall, Indelman & Dellaert 2014, "Eliminating conditionally independent
sets in factor graphs"; Forster et al. 2017, eqs. 47-50): its landmark's 3x3 block is eliminated by a Schur
complement, for all tracks at once. GTSAM's SmartStereoProjectionPoseFactor does the same for one noise only, equal
and independent in uL, uR and v; this takes the rig's whole covariance and weighs each sighting by Huber's loss.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from filters.graph.growth import HUBER_THRESHOLD
from toolkit.geometry import Array, IntArray
from toolkit.models import stereo
from toolkit.sequence import StereoRig

# A sighting from behind the camera says nothing, but must not be the cheaper place to be: it costs a gross mismatch.
_BEHIND_NORM = 100.0
# Keeps a landmark that no sighting determines from making its 3x3 block singular, far below any pixel's information.
_LEAST_INFORMATION_PER_M2 = 1e-12


@dataclass(frozen=True, eq=False)
class Sightings:
    """N sightings: rows of their poses (N,), rows of their points (N,) and measurements (N, 3) px."""

    pose: IntArray
    point: IntArray
    uv_px: Array

    def of_points(self, points: IntArray) -> "Sightings":
        """Return the sightings of some points (M,), which keep their rows."""
        rows = np.isin(self.point, points)
        return Sightings(self.pose[rows], self.point[rows], self.uv_px[rows])


class Reduced(NamedTuple):
    """Information (6K, 6K) and its vector (6K,) on the poses, and what gives the points' step back."""

    information: Array
    vector: Array
    coupling: Array
    root: Array
    point_vector: Array

    def point_steps(self, pose_steps: Array) -> Array:
        """Return the steps (M, 3) of the points that go with steps (6K,) of the poses."""
        whitened = self.point_vector - (self.coupling.T @ pose_steps).reshape(-1, 3)
        return (self.root @ whitened[..., None])[..., 0]


class _Whitened(NamedTuple):
    residual: Array
    norm: Array
    prediction: stereo.StereoPrediction
    root: Array


def loss(poses: Array, points: Array, seen: Sightings, rig: StereoRig) -> float:
    """Return the sum of Huber's losses of the whitened residuals, half a square each where small."""
    norm = _whitened(poses, points, seen, rig).norm
    return float(np.where(norm <= HUBER_THRESHOLD, 0.5 * norm**2, HUBER_THRESHOLD * (norm - HUBER_THRESHOLD / 2)).sum())


def reduced(poses: Array, points: Array, seen: Sightings, rig: StereoRig) -> Reduced:
    """Linearise sightings at poses (K, 4, 4) and points (M, 3) and eliminate the points.

    The poses' errors are GTSAM's, on the right: [rotation, position] in the body frame.
    """
    white = _whitened(poses, points, seen, rig)
    weights = np.sqrt(np.minimum(1.0, HUBER_THRESHOLD / np.maximum(white.norm, 1e-12)))
    weights = np.where(white.prediction.depth_m > 0.0, weights, 0.0)[:, None]
    residual = weights * white.residual
    J_pose = np.where(weights[..., None] > 0.0, weights[..., None] * (white.root @ white.prediction.d_uv_d_pose), 0.0)
    J_point = np.where(weights[..., None] > 0.0, weights[..., None] * (white.root @ white.prediction.d_uv_d_point), 0.0)
    return _eliminated(residual, J_pose, J_point, seen, (len(poses), len(points)))


def _whitened(poses: Array, points: Array, seen: Sightings, rig: StereoRig) -> _Whitened:
    root = np.linalg.inv(np.linalg.cholesky(rig.cov_uv_px2))
    with np.errstate(divide="ignore", invalid="ignore"):
        prediction = stereo.predict(points[seen.point], poses[seen.pose], rig)
        residual = (seen.uv_px - prediction.uv_px) @ root.T
    front = prediction.depth_m > 0.0
    residual = np.where(front[:, None], residual, 0.0)
    norm = np.where(front, np.linalg.norm(residual, axis=1), _BEHIND_NORM)
    return _Whitened(residual, norm, prediction, root)


def _eliminated(residual: Array, J_pose: Array, J_point: Array, seen: Sightings, counts: tuple[int, int]) -> Reduced:
    pose_count, point_count = counts
    to_pose, to_point = np.swapaxes(J_pose, 1, 2), np.swapaxes(J_point, 1, 2)
    information_point = np.tile(_LEAST_INFORMATION_PER_M2 * np.eye(3), (point_count, 1, 1))
    np.add.at(information_point, seen.point, to_point @ J_point)
    vector_point = np.zeros((point_count, 3))
    np.add.at(vector_point, seen.point, (to_point @ residual[..., None])[..., 0])
    root = np.swapaxes(np.linalg.inv(np.linalg.cholesky(information_point)), 1, 2)
    whitened_vector = (np.swapaxes(root, 1, 2) @ vector_point[..., None])[..., 0]
    coupling = np.zeros((pose_count, 6, point_count, 3))
    coupling[seen.pose, :, seen.point, :] = (to_pose @ J_point) @ root[seen.point]
    across = coupling.reshape(6 * pose_count, 3 * point_count)
    blocks, vector = np.zeros((pose_count, 6, 6)), np.zeros((pose_count, 6))
    np.add.at(blocks, seen.pose, to_pose @ J_pose)
    np.add.at(vector, seen.pose, (to_pose @ residual[..., None])[..., 0])
    information = -across @ across.T
    diagonal = information.reshape(pose_count, 6, pose_count, 6)
    diagonal[np.arange(pose_count), :, np.arange(pose_count), :] += blocks
    reduced_vector = vector.ravel() - across @ whitened_vector.ravel()
    return Reduced(information, reduced_vector, across, root, whitened_vector)
