"""What tracks in view tell, as ``tracks_in_view`` wants it, by the compiled kernel; imported only where that runs."""

import numpy as np

from filters.kalman import tracks_in_view
from filters.kalman.compiled_gate import camera_of, given
from filters.kalman.gate import FrameGate
from filters.kalman.joint import JointBelief, times_root, transposed_root_times, without_products
from filters.kalman.kernels import tracks_in_view as kernel
from filters.kalman.multiview import TrackSightings
from filters.kalman.tracks_in_view import FollowedTracks, RootedWindow, Told
from toolkit.models.gating import FEWEST_SIGHTINGS, LEAST_DEPTH_M, LEAST_DISPARITY_PX, huber_threshold
from toolkit.sequence import StereoRig

COMPILED = kernel.COMPILED


def followed(known: FollowedTracks, sightings: TrackSightings, joint: JointBelief, rig: StereoRig) -> FollowedTracks:
    """Return tracks with their landmarks: ``tracks_in_view.followed``, compiled where no right image is missing."""
    if sightings.left_only.any():
        return tracks_in_view.followed(known, sightings, joint, rig)
    before = given((known.sightings.track_ids, known.clone_frames, known.points, known.weights))
    now = given((sightings.track_ids, joint.clone_frames, sightings.uvs_px, sightings.seen))
    found, points, weights = kernel.follow(
        before, now, np.ascontiguousarray(joint.clones), camera_of(rig), FEWEST_SIGHTINGS, LEAST_DISPARITY_PX
    )
    return FollowedTracks(sightings, joint.clone_frames, points, weights).select(found)


def told(tracks: FollowedTracks, window: RootedWindow, rig: StereoRig, gate: FrameGate) -> Told:
    """Gate the newest sightings and return what the tracks tell: ``tracks_in_view.told``, compiled.

    The gate is asked for its bounds; it counts nothing. Where a right image is missing, NumPy does it.
    """
    counted = tracks.counted
    if counted.left_only.any():
        return tracks_in_view.told(tracks, window, rig, gate)
    arrays = given((counted.uvs_px, counted.seen, counted.ages, tracks.weights, tracks.points))
    poses, root = given((window.poses, window.poses_at)), window.root
    threshold = np.inf if gate.huber is None else float(huber_threshold(3, gate.huber))
    rules = np.array([LEAST_DEPTH_M, float(gate.bound(3)), threshold])
    normals = kernel.normals_of_tracks(arrays, poses, camera_of(rig), rules)
    to_points, newest, vector = normals[3], normals[5], normals[7]
    eliminated = times_root(to_points, root)
    by_root = (root, newest @ root[-newest.shape[1] :], eliminated)
    points, weights, in_front, taken, of_poses = kernel.told_by_newest(normals, by_root, rules)
    matrix = without_products(transposed_root_times(root, of_poses), eliminated)
    return Told(points, weights, in_front, matrix, root.T @ vector - eliminated.T @ taken)
