"""What tracks in view tell, as ``tracks_in_view`` wants it, by the compiled kernel; imported only where that runs."""

import numpy as np

from filters.kalman import tracks_in_view
from filters.kalman.compiled_gate import camera_of, given
from filters.kalman.gate import FrameGate
from filters.kalman.kernels import tracks_in_view as kernel
from filters.kalman.track_gate import Window
from filters.kalman.tracks_in_view import FollowedTracks, Told
from toolkit.models.gating import LEAST_DEPTH_M, huber_threshold
from toolkit.sequence import StereoRig

COMPILED = kernel.COMPILED


def told(tracks: FollowedTracks, window: Window, rig: StereoRig, gate: FrameGate) -> Told:
    """Gate the newest sightings and return what the tracks tell: ``tracks_in_view.told``, compiled.

    The gate is asked for its bounds; it counts nothing. Where a right image is missing, NumPy does it.
    """
    counted = tracks.counted
    if counted.left_only.any():
        return tracks_in_view.told(tracks, window, rig, gate)
    threshold = np.inf if gate.huber is None else float(huber_threshold(3, gate.huber))
    arrays = given((counted.uvs_px, counted.seen, counted.ages, tracks.weights, tracks.points))
    rules = np.array([LEAST_DEPTH_M, float(gate.bound(3)), threshold])
    points, newest, in_front, matrix, vector, taken = kernel.told_by_tracks(
        arrays, given(window), camera_of(rig), rules
    )
    taken = taken.T @ taken
    return Told(points, newest, in_front, matrix - taken[:-1, :-1], vector - taken[:-1, -1])
