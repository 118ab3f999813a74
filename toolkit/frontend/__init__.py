"""Stereo tracks from images, with OpenCV, made once for all estimators.

Read ``tracker`` first: it is the algorithm, with ``motion`` and ``patches``. ``tracking`` runs it over a
recording of ``images`` that ``cameras`` took, with a ``cache``; ``stills`` draw what it found.
"""

from toolkit.frontend.cameras import Camera, Pinhole, RectifiedPair, already_rectified, rectified
from toolkit.frontend.images import StampedPair, size_of
from toolkit.frontend.tracking import ImageRecording, ImageTracks, matched_corners, track_images

__all__ = [
    "Camera",
    "ImageRecording",
    "ImageTracks",
    "Pinhole",
    "RectifiedPair",
    "StampedPair",
    "already_rectified",
    "matched_corners",
    "rectified",
    "size_of",
    "track_images",
]
