"""The present state given also the tracks still in view: for the answer alone, it does not enter the belief.

An MSCKF corrects by a track once, when the track ends or leaves the window. Until then the belief has no information
from its sightings, and the newest pose would follow the measured motion alone. So the answer at a frame is the belief
given all tracks in view, computed beside the belief and then discarded. No sighting counts twice, and up to
linearisation it is the answer that the filter would give if every track ended here (tested).

A landmark is triangulated at its track's second sighting and then follows by one Gauss-Newton step a frame. A sighting
is gated once, at its frame, against the window and the earlier sightings of its track; its weight then stays.
"""

from dataclasses import replace

import numpy as np

from filters.kalman.frame_gate import FrameGate
from filters.kalman.joint import (
    JointBelief,
    cholesky_root,
    divided_by_root,
    regular_root,
    times_root,
    transposed_root_times,
    without_products,
)
from filters.kalman.tracks import WindowPoses, WindowTracks, camera_for_kernels
from toolkit.geometry import Array, se3_exp
from toolkit.measurements import StereoRig
from toolkit.models import stereo
from toolkit.models.gating import LEAST_DEPTH_M, LEAST_DISPARITY_PX, huber_threshold
from toolkit.models.state import POSE, Belief


def given_tracks_in_view(
    joint: JointBelief, window: WindowPoses, tracks: WindowTracks, rig: StereoRig, gate: FrameGate
) -> Belief:
    """Return the present state given also the tracks that the newest of W poses sees and that have not corrected yet.

    Their landmarks and the weights of their newest sightings are kept in ``tracks``; ``gate`` counts nothing.
    """
    from filters.kalman import kernels

    camera, kernel_window = camera_for_kernels(rig), window.for_kernels(rig)
    kernels.start_landmarks((tracks.uvs_px, tracks.seen), tracks.points, kernel_window[0], camera, LEAST_DISPARITY_PX)
    rows = np.flatnonzero(tracks.seen[:, -1] & ~np.isnan(tracks.points[:, 0]))
    uvs_px, weights, points = tracks.uvs_px[rows], tracks.weights[rows], tracks.points[rows]
    depths_m, *of_points, between, H_newest, of_poses, vector = kernels.normals_in_view(
        (uvs_px, weights, points), kernel_window, camera, LEAST_DEPTH_M
    )
    usable = depths_m > 0.0
    if not usable.any():
        tracks.forget_landmarks(rows)
        return joint.core
    root = regular_root(window.cov)
    size = len(root)
    by_root = H_newest @ root[-6:], times_root(between, root)
    dof = np.zeros(len(rows), dtype=np.int64) + stereo.degrees_of_freedom(uvs_px[:, -1])
    normals = (depths_m, *of_points, H_newest, of_poses, vector)
    of_newest, eliminated = kernels.add_newest(normals, by_root, points, (dof, *_limits(gate)))
    tracks.points[rows], tracks.weights[rows, -1] = points, of_newest
    tracks.forget_landmarks(rows[~usable])

    matrix = transposed_root_times(root, (of_poses @ root.reshape(-1, 6, size)).reshape(size, size))
    matrix, vector = without_products(matrix, by_root[1]), root.T @ vector - by_root[1].T @ eliminated
    return _corrected(joint, root, rig.track_weight * matrix, rig.track_weight * vector)


def _limits(gate: FrameGate) -> tuple[Array, Array]:
    """Return the bound of the NIS (4,) and Huber's threshold (4,), infinite without that loss, at 0 to 3 degrees."""
    thresholds = np.full(4, np.inf)
    if gate.huber is not None:
        thresholds[2:] = huber_threshold(np.array([2, 3]), gate.huber)
    return gate.bounds(3), thresholds


def _corrected(joint: JointBelief, root: Array, matrix: Array, vector: Array) -> Belief:
    """Return the present state given information (6 W, 6 W), (6 W,) on errors u; the errors of the clones are R u.

    The update in information form with L and n on the clones moves the state's error by ``P_xc (1 + L P_cc)^-1 n`` and
    subtracts ``P_xc (1 + L P_cc)^-1 L P_cx`` from its covariance.
    """
    core = joint.core
    to_core = divided_by_root(root, joint.cov[joint.clone_columns, : core.layout.size].copy())
    matrix.flat[:: len(matrix) + 1] += 1.0
    halves = divided_by_root(cholesky_root(matrix), np.column_stack([to_core, vector]))
    half = halves[:, :-1]
    delta, cov = half.T @ halves[:, -1], core.cov - to_core.T @ to_core + half.T @ half
    moved = core.displaced(delta, se3_exp(delta[POSE]))
    return replace(moved, cov=0.5 * (cov + cov.T))
