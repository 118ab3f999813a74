"""Landmarks mapped along given poses, by one small EKF each (Kang, III-B)."""

import numpy as np

from filters.kalman.correction import correct_landmarks_gated
from filters.kalman.landmarks import TrackedMap
from toolkit.estimate import Landmarks
from toolkit.geometry import Array
from toolkit.sequence import StereoFrame, StereoRig


class MapAlong:
    """Takes every pose for true; a sighting outside the 95 % gate corrects nothing."""

    def __init__(self, rig: StereoRig) -> None:
        self._rig, self._map = rig, TrackedMap(rig)

    def see(self, frame: StereoFrame, T_world_imu: Array) -> None:
        """Correct the landmarks the frame shows again and start its new ones, seen from a pose (4, 4)."""
        seen, uvs_px = self._map.seen_again(frame)
        if len(seen):
            everyone = np.ones(len(seen), dtype=bool)
            seen = correct_landmarks_gated(seen, uvs_px, T_world_imu, np.zeros((6, 6)), self._rig, everyone)
        self._map.keep(seen, frame, T_world_imu)

    def landmarks(self) -> Landmarks:
        """Return every landmark there ever was, as last known."""
        return self._map.landmarks()
