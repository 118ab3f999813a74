"""How far tracks made of rendered images are from the scene that was rendered: what a front end costs, in pixels.

The ray of a track's first sighting, from the true pose, meets a point of the hall; from then on every sighting of the
track should be where that point is. What flies about counts as wrong, as it does to an estimator.
"""

from dataclasses import replace

import numpy as np

from toolkit.arrays import rows_of
from toolkit.geometry import Array, se3_inverse, transform
from toolkit.models import stereo
from toolkit.sequence import Sequence
from toolkit.simulation.surfaces import furnished_hall

# Scatter is told as the median deviation of a normal variable's sigma, which mismatches do not move.
_TO_SIGMA = 1.4826
_MISMATCH_PX = 3.0


def errors_px(sequence: Sequence) -> Array:
    """Return by how much each sighting (N, 3) px is off; NaN where the frame has no truth or the ray meets nothing."""
    truth, seen, rig = sequence.truth, sequence.observations, sequence.rig
    if truth is None:
        return np.full((len(seen), 3), np.nan)
    row, is_true = rows_of(sequence.frames_t_ns, truth.t_ns)
    T_world_cam = np.where(is_true[:, None, None], truth.T_world_imu[row] @ rig.T_imu_cam, np.nan)
    _, first, track = np.unique(seen.track_id, return_index=True, return_inverse=True)
    rays = np.stack(
        [
            (seen.uv_px[first, 0] - rig.cx_px) / rig.fx_px,
            (seen.uv_px[first, 2] - rig.cy_px) / rig.fy_px,
            np.ones(first.size),
        ],
        axis=1,
    )
    points = _met(T_world_cam[seen.frame[first]], rays)
    return seen.uv_px - stereo.project(transform(se3_inverse(T_world_cam)[seen.frame], points[track]), rig)


def _met(T_world_cam: Array, rays: Array) -> Array:
    """Return the points (M, 3) of the hall that rays (M, 3), each of a camera of its own (M, 4, 4), meet first."""
    origin, towards = T_world_cam[:, :3, 3], (T_world_cam[:, :3, :3] @ rays[:, :, None])[..., 0]
    nearest = np.full(len(rays), np.inf)
    with np.errstate(divide="ignore", invalid="ignore"):
        for panel in furnished_hall().standing:
            axes, corner = panel.T_world_panel[:3, :3], panel.T_world_panel[:3, 3]
            start, step = (origin - corner) @ axes, towards @ axes
            reach = -start[:, 2] / step[:, 2]
            place = start[:, :2] + reach[:, None] * step[:, :2]
            inside = ((place >= 0.0) & (place <= panel.size_m)).all(axis=1)
            met = inside & (start[:, 2] > 0.0) & (reach > 0.0) & (reach < nearest)
            nearest[met] = reach[met]
        return np.where(np.isfinite(nearest)[:, None], origin + nearest[:, None] * towards, np.nan)


def with_scene_errors(sequence: Sequence) -> Sequence:
    """Return the sequence, made of rendered images, with a fact that says how far its tracks are off."""
    off_px = errors_px(sequence)
    off_px = off_px[np.isfinite(off_px).all(axis=1)]
    if not len(off_px):
        return sequence
    u_left, u_right, v = (_TO_SIGMA * np.median(np.abs(off_px), axis=0)).tolist()
    beyond = 100.0 * float((np.abs(off_px) > _MISMATCH_PX).any(axis=1).mean())
    fact = (
        f"against the rendered scene, at the points that tracks began with, sightings are off by {u_left:.2f} px (uL), "
        f"{u_right:.2f} px (uR) and {v:.2f} px (v), by the median; {beyond:.1f} % by more than {_MISMATCH_PX:g} px"
    )
    provenance = sequence.provenance
    return replace(sequence, provenance=replace(provenance, facts=(provenance.facts[0], fact, *provenance.facts[1:])))
