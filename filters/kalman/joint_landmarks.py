"""Landmarks in a joint belief: how a frame corrects it by them.

It uses the newest clone, whose estimate and covariance are those of the present pose.
"""

from typing import NamedTuple

import numpy as np

from filters.kalman.joint import JointBelief, Linearisation
from toolkit.geometry import Array, IntArray, se3_inverse, transform
from toolkit.measurements import StereoFrame, StereoRig
from toolkit.models import stereo
from toolkit.models.gating import FrameGate, mahalanobis_squared


class LandmarkSightings(NamedTuple):
    """Whitened residuals (L, 3) of the state's landmarks, their Jacobians and the landmarks' depths (L,) m.

    ``H_pose`` (L, 3, 6) is to the newest clone, ``H_point`` (L, 3, 3) to the landmark. ``dof`` are the degrees of
    freedom of the residuals: (L,), or one number for all.
    """

    residuals: Array
    H_pose: Array
    H_point: Array
    depth_m: Array
    dof: int | IntArray


def correct(joint: JointBelief, frame: StereoFrame, at: Linearisation, rig: StereoRig, gate: FrameGate) -> None:
    """Correct the whole state by its landmarks; the frame must show every one of them."""
    if not len(joint.landmark_ids):
        return
    seen = linearise_sightings(joint, frame, at, rig)
    cross_covs = covs_with_state(joint, seen)
    weights = weighed(joint, seen, cross_covs, gate)
    if weights.any():
        joint.update(*innovation(joint, seen, cross_covs, weights))


def linearise_sightings(joint: JointBelief, frame: StereoFrame, at: Linearisation, rig: StereoRig) -> LandmarkSightings:
    """Linearise the frame's sightings of all landmarks of the state; the frame must show every one of them."""
    order = np.argsort(frame.track_ids)
    uvs_px = frame.uvs_px[order[np.searchsorted(frame.track_ids, joint.landmark_ids, sorter=order)]]
    predicted_px, depth_m = stereo.images(transform(se3_inverse(joint.clones[-1]), joint.points), rig)
    there = stereo.predict(at.points(joint), at.clones(joint)[-1], rig)
    whitener = stereo.whitener(uvs_px, rig)
    residuals = stereo.whitened_residuals(uvs_px, predicted_px, rig)
    H_pose, H_point = whitener @ there.d_uv_d_pose, whitener @ there.d_uv_d_point
    return LandmarkSightings(residuals, H_pose, H_point, depth_m, stereo.degrees_of_freedom(uvs_px))


def covs_with_state(joint: JointBelief, seen: LandmarkSightings) -> Array:
    """Return the covariances H P (L, 3, n) of sightings with the whole state."""
    P = joint.cov
    by_point = seen.H_point @ P[joint.landmark_columns].reshape(-1, 3, len(P))
    return np.asarray(by_point + (seen.H_pose.reshape(-1, 6) @ P[-6:]).reshape(by_point.shape))


def weighed(joint: JointBelief, seen: LandmarkSightings, cross_covs: Array, gate: FrameGate) -> Array:
    """Return the weights of landmarks (L,): 0 unless in front of the camera with residuals that pass the gate.

    The projection formula gives a point behind the camera an image too, which may even match the measured one.
    """
    each = np.arange(len(cross_covs))
    own = cross_covs[:, :, joint.landmark_columns].reshape(each.size, 3, each.size, 3)[each, :, each]
    covs = own @ seen.H_point.mT + cross_covs[:, :, -6:] @ seen.H_pose.mT + np.eye(3)
    nis = mahalanobis_squared(seen.residuals, covs)
    return gate.weights(nis, seen.dof, gate.accepts(nis, seen.dof, seen.depth_m > 0.0))


def innovation(
    joint: JointBelief, seen: LandmarkSightings, cross_covs: Array, weights: Array
) -> tuple[Array, Array, Array]:
    """Return H P (m, n), H P H^T + 1 (m, m) and residuals (m,) of the landmarks whose weight (L,) is not zero."""
    rows = np.flatnonzero(weights)
    roots, m = np.sqrt(weights[rows])[:, None, None], 3 * rows.size
    H_pose, H_point = roots * seen.H_pose[rows], roots * seen.H_point[rows]
    cross = (roots * cross_covs[rows]).reshape(m, -1)
    of_points = cross[:, joint.landmark_columns].reshape(m, -1, 3)[:, rows].swapaxes(0, 1) @ H_point.mT
    cov = of_points.swapaxes(0, 1).reshape(m, m) + cross[:, -6:] @ H_pose.reshape(m, 6).T + np.eye(m)
    return cross, cov, (roots[..., 0] * seen.residuals[rows]).ravel()
