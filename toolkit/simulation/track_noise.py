"""How the errors of one track's sightings are correlated: white noise, a random walk, and an offset of its own.

A tracker that follows a patch from image to image adds a small error at every step (a random walk). One that matches
left and right only in the first frame of a track has the same disparity error in all its frames (an offset). Simulators
draw white noise alone, and most estimators assume it.
"""

from dataclasses import dataclass

from toolkit.arrays import freeze_arrays
from toolkit.geometry import Array


@dataclass(frozen=True, eq=False)
class TrackNoise:
    """Standard deviations (3,) in the channels (c, d, v) of the parts of a track's error.

    ``white_px`` px of every sighting by itself; ``walk_px`` px per root frame; ``offset_px`` px of the track, constant.
    The covariance of the errors of sightings j and k, whose ages in frames are a_j and a_k, is
    ``white^2 [j = k] + walk^2 min(a_j, a_k) + offset^2``.
    """

    white_px: Array
    walk_px: Array
    offset_px: Array

    def __post_init__(self) -> None:
        freeze_arrays(self, white_px=(3,), walk_px=(3,), offset_px=(3,))

    def scaled(self, factor: float) -> "TrackNoise":
        """Return the noise with all its standard deviations multiplied."""
        return TrackNoise(factor * self.white_px, factor * self.walk_px, factor * self.offset_px)
