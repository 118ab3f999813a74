"""Triangulation of landmarks seen from several poses: Levenberg-Marquardt over all tracks at once.

The sightings are one flat list, ordered by track, because tracks differ much in length. Source of the problem: Mourikis
& Roumeliotis 2007, "A multi-state constraint Kalman filter for vision-aided inertial navigation", appendix.
"""

from typing import NamedTuple

import numpy as np

from toolkit.geometry import Array, BoolArray, IntArray, se3_inverse, transposed
from toolkit.measurements import StereoRig, is_left_only
from toolkit.models import stereo
from toolkit.models.gating import LEAST_DEPTH_M, LEAST_DISPARITY_PX

ITERATIONS, FIRST_DAMPING = 6, 1e-3
# The landmark is eliminated to first order afterwards, so a fit to better than a hundredth of a sigma has no effect.
RELATIVE_DECREASE = 1e-4
# A step that raises the error by no more than rounding is accepted, so that rounding does not decide.
ROUNDING = 1e-12
# Added to the normal equations: the information of rays that are parallel to within a thousandth of a radian.
_LEAST_RAY = 1e-6


class _Views(NamedTuple):
    """N sightings (N, 3) px, ordered by track, and the camera pose of each: ``p_cam = R p_world + t``.

    ``track`` (N,) is the row of the point each sees, ``first`` (F,) where each track's sightings begin.
    """

    uvs_px: Array
    R_cam_world: Array
    t_cam: Array
    track: IntArray
    first: IntArray


class _Fit(NamedTuple):
    """Points (F, 3), half the squared error (F,) of each, its derivatives, and the least depth (F,) m.

    The error is infinite where a point is behind a camera that saw it.
    """

    points: Array
    cost: Array
    gradient: Array
    hessian: Array
    depth_m: Array


def triangulate(uvs_px: Array, seen: BoolArray, poses: Array, rig: StereoRig) -> tuple[Array, BoolArray]:
    """Return the points (F, 3) that fit sightings (F, W, 3) px from poses (W, 4, 4) best, and which (F,) to rely on.

    ``seen`` (F, W) marks the sightings, of which every track must have one. The start is the stereo triangulation with
    the largest disparity. A point is reliable if it lies in front of every pose that saw it and one disparity is large
    enough to determine its depth; where right images are missing, also if the sightings together determine it
    (:func:`is_determined`).
    """
    if not len(seen):
        return np.empty((0, 3)), np.empty(0, dtype=bool)
    start, wide = nearest_view(uvs_px, seen, poses, rig)
    views = _views(uvs_px, seen, poses, rig)
    fit, damping = _fit(start, views, rig), np.full(len(start), FIRST_DAMPING)
    for _ in range(ITERATIONS):
        damped = fit.hessian + (damping[:, None, None] * fit.hessian + 1e-12) * np.eye(3)
        tried = _fit(fit.points + np.linalg.solve(damped, fit.gradient[..., None])[..., 0], views, rig)
        better = tried.cost < (1.0 + ROUNDING) * fit.cost
        unsettled = tried.cost < (1.0 - RELATIVE_DECREASE) * fit.cost
        fit = _chosen(better, tried, fit)
        damping = np.where(better, 0.1 * damping, 10.0 * damping)
        if not unsettled.any():
            break
    determined, blind = wide, lacking(uvs_px, seen, wide)
    if blind.any():
        determined = wide | (blind & is_determined(fit.hessian, fit.depth_m))
    return fit.points, determined & (fit.depth_m > LEAST_DEPTH_M)


def nearest_view(uvs_px: Array, seen: BoolArray, poses: Array, rig: StereoRig) -> tuple[Array, BoolArray]:
    """Return each point (F, 3) by the sighting of largest disparity, and whether (F,) the disparity is large enough.

    Where it is not and right images are missing, the point is where the rays of all sightings meet best.
    """
    disparity_px = np.where(seen & ~is_left_only(uvs_px), stereo.disparity_px(uvs_px), -np.inf)
    nearest = np.argmax(disparity_px, axis=1)
    rows = np.arange(len(nearest))
    wide = disparity_px[rows, nearest] > LEAST_DISPARITY_PX
    best_px = np.where(wide[:, None], uvs_px[rows, nearest], [rig.cx_px + 1.0, rig.cx_px, rig.cy_px])
    points, blind = stereo.triangulate_world(best_px, poses[nearest], rig), lacking(uvs_px, seen, wide)
    if blind.any():
        points[blind] = _where_rays_meet(uvs_px[blind], seen[blind], poses, rig)
    return points, wide


def lacking(uvs_px: Array, seen: BoolArray, wide: BoolArray) -> BoolArray:
    """Say which tracks (F,) have no disparity that determines their depth and lack a right image."""
    return np.asarray(~wide & (seen & is_left_only(uvs_px)).any(axis=1))


def is_determined(information: Array, depth_m: Array) -> BoolArray:
    """Say which points (F,) are determined to within their depths (F,) m by an information matrix (F, 3, 3) 1/m^2.

    By the rule of :data:`toolkit.models.gating.LEAST_DISPARITY_PX`, the standard deviation in every direction must be
    less than the depth itself.
    """
    return np.asarray(np.linalg.eigvalsh(information)[:, 0] * np.square(depth_m) > 1.0)


def _where_rays_meet(uvs_px: Array, seen: BoolArray, poses: Array, rig: StereoRig) -> Array:
    """Return the points (F, 3) nearest to the rays of the left image; parallel rays meet far in front of it."""
    T_world_cam = poses @ rig.T_imu_cam
    rays = np.ones((*seen.shape, 3))
    rays[..., 0] = (uvs_px[..., 0] - rig.cx_px) / rig.fx_px
    rays[..., 1] = (uvs_px[..., 2] - rig.cy_px) / rig.fy_px
    rays = (T_world_cam[:, :3, :3] @ rays[..., None])[..., 0]
    directions, centres = rays / np.linalg.norm(rays, axis=2, keepdims=True), T_world_cam[:, :3, 3]
    across = (np.eye(3) - directions[..., None] * directions[..., None, :]) * seen[..., None, None]
    far = (centres + rig.fx_px * rig.baseline_m / LEAST_DISPARITY_PX * rays)[np.arange(len(seen)), seen.argmax(axis=1)]
    system = across.sum(axis=1) + _LEAST_RAY * np.eye(3)
    right = (across @ centres[..., None]).sum(axis=1)[..., 0] + _LEAST_RAY * far
    return np.asarray(np.linalg.solve(system, right[..., None])[..., 0])


def _views(uvs_px: Array, seen: BoolArray, poses: Array, rig: StereoRig) -> _Views:
    track, pose = np.nonzero(seen)
    T_cam_world = se3_inverse(poses @ rig.T_imu_cam)
    first = np.searchsorted(track, np.arange(len(seen)))
    return _Views(uvs_px[seen], T_cam_world[pose, :3, :3], T_cam_world[pose, :3, 3], track, first)


def _fit(points: Array, views: _Views, rig: StereoRig) -> _Fit:
    points_cam = (views.R_cam_world @ points[views.track][:, :, None])[..., 0] + views.t_cam
    depth_m = points_cam[:, 2].copy()
    points_cam[:, 2] = np.where(np.abs(depth_m) < 1e-3, 1e-3, depth_m)
    # Jacobian and residual side by side: one product yields the normal equations and the cost.
    system = np.empty((len(depth_m), 3, 4))
    system[..., :3] = stereo.projection_jacobian(points_cam, rig) @ views.R_cam_world
    system[..., 3] = stereo.residuals_px(views.uvs_px, stereo.project(points_cam, rig))
    system = stereo.whitener(views.uvs_px, rig) @ system
    normal = np.add.reduceat(transposed(system) @ system, views.first)
    nearest_m = np.minimum.reduceat(depth_m, views.first)
    cost = np.where(nearest_m > 0.0, 0.5 * normal[:, 3, 3], np.inf)
    return _Fit(points, cost, normal[:, :3, 3], normal[:, :3, :3], nearest_m)


def _chosen(rows: BoolArray, new: _Fit, old: _Fit) -> _Fit:
    """Return the new fit of some tracks (F,) and the old one of the others."""
    if rows.all():
        return new

    def pick(a: Array, b: Array) -> Array:
        return np.where(np.expand_dims(rows, tuple(range(1, a.ndim))), a, b)

    return _Fit(*[pick(a, b) for a, b in zip(new, old, strict=True)])
