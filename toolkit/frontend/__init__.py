"""Stereo tracks from images, with OpenCV, made once for all estimators.

Read ``tracker`` first: it is the algorithm, with ``motion`` and ``patches``. ``tracking`` runs it over a
recording of ``images`` that ``cameras`` took, with a ``cache``; ``stills`` draw what it found.
"""

from toolkit.frontend.cameras import Camera as Camera
from toolkit.frontend.cameras import Pinhole as Pinhole
from toolkit.frontend.cameras import RectifiedPair as RectifiedPair
from toolkit.frontend.cameras import already_rectified as already_rectified
from toolkit.frontend.cameras import rectified as rectified
from toolkit.frontend.images import StampedPair as StampedPair
from toolkit.frontend.images import size_of as size_of
from toolkit.frontend.tracking import ImageRecording as ImageRecording
from toolkit.frontend.tracking import ImageTracks as ImageTracks
from toolkit.frontend.tracking import matched_corners as matched_corners
from toolkit.frontend.tracking import track_images as track_images
