"""Bring an estimated trajectory into the truth's world: by its first pose, or by the best fit of all positions.

Sources: Umeyama, "Least-squares estimation of transformation parameters between two point patterns" (PAMI 1991);
Zhang and Scaramuzza, "A tutorial on quantitative trajectory evaluation for visual(-inertial) odometry" (IROS 2018)
for the fit of yaw and position, the four degrees of freedom a visual-inertial estimator cannot observe.
"""

from dataclasses import dataclass

import numpy as np

from toolkit.geometry import Array, about_z, se3, se3_inverse
from toolkit.metrics.parts.scores import Unavailable

# Ratio of the second to the first singular value of the covariance below which the positions lie on a line: the
# squared sideways extent is then 1e-12 of the squared length, a micrometre in a metre.
_COLLINEAR = 1e-12


@dataclass(frozen=True, eq=False)
class Alignment:
    """The similarity x -> scale R x + t from the estimate's world to the truth's.

    ``rotation_is_unique`` is False where the positions lie on a line (or in a point): the residual distances are then
    still the least ones, but any rotation about the line gives the same distances.
    """

    rotation: Array
    translation: Array
    scale: float = 1.0
    rotation_is_unique: bool = True

    def apply(self, poses: Array) -> Array:
        """Return poses (n, 4, 4), rotated and with their positions also scaled."""
        positions = self.scale * poses[:, :3, 3] @ self.rotation.T + self.translation
        return se3(self.rotation @ poses[:, :3, :3], positions)


def place_pose(truth: Array, estimate: Array) -> Alignment:
    """Make one estimated pose (4, 4) coincide with the true one; nothing is fitted."""
    T_truth_estimate = truth @ se3_inverse(estimate)
    return Alignment(T_truth_estimate[:3, :3], T_truth_estimate[:3, 3])


def place_yaw(truth: Array, estimate: Array) -> Alignment:
    """Make the position of an estimated pose (4, 4) coincide with the true one, its heading as nearly as possible."""
    rotation = about_z(_best_yaw(truth[:3, :3] @ estimate[:3, :3].T))
    return Alignment(rotation, truth[:3, 3] - rotation @ estimate[:3, 3])


def place_first(truth: Array, estimate: Array, level: bool) -> Alignment:
    """Place the first estimated pose (4, 4) on the true one, by heading and position alone where the world is level.

    An estimator starts in a world of its own. With an IMU the vertical is measured, so that a tilt is an error and
    stays; without one the whole first pose is arbitrary.
    """
    return place_yaw(truth, estimate) if level else place_pose(truth, estimate)


def fit_se3(truth: Array, estimate: Array) -> Alignment:
    """Fit rotation and translation to positions (n, 3) by least squares (Umeyama, eqs. 38-43 with c = 1).

    Raises Unavailable for fewer than three pairs, as do the other fits.
    """
    rotation, _, unique = _umeyama_rotation(_covariance(truth, estimate))
    return _centred(truth, estimate, Alignment(rotation, np.zeros(3), 1.0, unique))


def fit_sim3(truth: Array, estimate: Array) -> Alignment:
    """Fit rotation, translation and scale to positions (n, 3) by least squares (Umeyama, eqs. 38-43)."""
    rotation, trace_of_ds, unique = _umeyama_rotation(_covariance(truth, estimate))
    variance_m2 = float(np.mean(np.sum((estimate - estimate.mean(axis=0)) ** 2, axis=1)))  # eq. 36
    if variance_m2 == 0.0:
        raise Unavailable("the estimated positions are all the same, so no scale fits them")
    return _centred(truth, estimate, Alignment(rotation, np.zeros(3), trace_of_ds / variance_m2, unique))


def fit_yaw(truth: Array, estimate: Array) -> Alignment:
    """Fit heading and translation to positions (n, 3) by least squares (Zhang and Scaramuzza 2018)."""
    rotation = about_z(_best_yaw(_covariance(truth, estimate)))
    return _centred(truth, estimate, Alignment(rotation, np.zeros(3)))


def _covariance(truth: Array, estimate: Array) -> Array:
    """Return the mean of (y - mean y)(x - mean x)^T (3, 3) over truth y and estimate x (Umeyama, eq. 38)."""
    if len(truth) < 3:
        raise Unavailable(f"a fit needs 3 matched pairs, there are {len(truth)}")
    covariance: Array = (truth - truth.mean(axis=0)).T @ (estimate - estimate.mean(axis=0)) / len(truth)
    if not np.isfinite(covariance).all():
        raise Unavailable("the estimated positions are too large to fit")
    return covariance


def _umeyama_rotation(covariance: Array) -> tuple[Array, float, bool]:
    """Return R = U S V^T (eq. 40), tr(D S) for the scale (eq. 42), and whether R is the only solution."""
    u, d, v_transposed = np.linalg.svd(covariance)
    mirrored = np.linalg.det(u) * np.linalg.det(v_transposed) < 0.0
    s = np.array([1.0, 1.0, -1.0 if mirrored else 1.0])  # eq. 43
    return (u * s) @ v_transposed, float(d @ s), bool(d[1] > _COLLINEAR * d[0])


def _best_yaw(covariance: Array) -> Array:
    """Return the angle that maximises tr(Rz(angle)^T C) = (C00 + C11) cos(angle) + (C10 - C01) sin(angle)."""
    angle: Array = np.arctan2(covariance[1, 0] - covariance[0, 1], covariance[0, 0] + covariance[1, 1])
    return angle


def _centred(truth: Array, estimate: Array, turned: Alignment) -> Alignment:
    """Give an alignment the translation that maps mean to mean (Umeyama, eq. 41)."""
    translation = truth.mean(axis=0) - turned.scale * turned.rotation @ estimate.mean(axis=0)
    return Alignment(turned.rotation, translation, turned.scale, turned.rotation_is_unique)
