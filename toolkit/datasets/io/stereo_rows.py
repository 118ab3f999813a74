"""Corner coordinates (uL, vL, uR, vR) as the toolkit's measurement (uL, uR, v)."""

import numpy as np

from toolkit.geometry import Array, IntArray
from toolkit.sequence import Observations


def observations(frame: IntArray, track_id: IntArray, corners_px: Array) -> Observations:
    """Build sightings from rows in any order; corners (N, 4) are uL, vL, uR, vR and v is the mean of the two rows."""
    u_left_px, v_left_px, u_right_px, v_right_px = corners_px.T
    uv_px = np.stack([u_left_px, u_right_px, 0.5 * (v_left_px + v_right_px)], axis=1)
    return Observations.sorted(frame, track_id, uv_px)
