"""Draws tracks over the images they were made of, so that they can be checked by eye."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from toolkit.errors import DataError, OutputError
from toolkit.files.writing import replaced_directory
from toolkit.frontend.cameras import Image
from toolkit.frontend.images import Unusable
from toolkit.frontend.tracking import ImageRecording, ImageTracks, read_pairs
from toolkit.geometry import IntArray
from toolkit.progress import SILENT, Progress

# How many past positions a track drags behind it, and the age (frames) at which it has its last colour.
_TRAIL, _OLD = 12, 20
_VIDEO, _VIDEO_HZ = "tracks.avi", 10.0


def write_stills(
    recording: ImageRecording, tracks: ImageTracks, directory: Path, count: int, progress: Progress = SILENT
) -> tuple[str, ...]:
    """Write ``count`` stills, spread over the recording, to a directory, whole or not at all; return their names.

    A still is a left image beside its right one: a circle a track, blue where it is new and red where it is old, with
    its way over the last frames. Raises OutputError where the directory holds anything else.
    """
    import cv2

    frames = np.unique(np.linspace(0, tracks.t_ns.size - 1, count).astype(int))
    names = []
    with replaced_directory(directory, _written_by_us) as partial:
        for k, image in _drawn(recording, tracks, frames, progress):
            name = f"{int(tracks.t_ns[k])}.png"
            (partial / name).write_bytes(cv2.imencode(".png", image)[1].tobytes())
            names.append(name)
    return tuple(names)


def write_video(
    recording: ImageRecording, tracks: ImageTracks, directory: Path, progress: Progress = SILENT
) -> tuple[str, ...]:
    """Write every frame as a video (Motion JPEG) to a directory, as :func:`write_stills`."""
    import cv2

    width, height = recording.rig.size_px
    with replaced_directory(directory, _written_by_us) as partial:
        code = cv2.VideoWriter.fourcc(*"MJPG")
        video = cv2.VideoWriter(str(partial / _VIDEO), code, _VIDEO_HZ, (2 * width, height))
        for _, image in _drawn(recording, tracks, np.arange(tracks.t_ns.size), progress):
            video.write(image)
        video.release()
        # OpenCV does not say where it could not write.
        reader = cv2.VideoCapture(str(partial / _VIDEO))
        there = int(reader.get(cv2.CAP_PROP_FRAME_COUNT)) if reader.isOpened() else 0
        reader.release()
        if there != tracks.t_ns.size:
            why = f"{there} of {tracks.t_ns.size} frames of {_VIDEO} are there; is the disk full?"
            raise OutputError(f"{directory} cannot be written ({why}); choose another directory with --out")
    return (_VIDEO,)


def _written_by_us(directory: Path) -> frozenset[str]:
    stills = {path.name for path in directory.glob("*.png") if path.stem.lstrip("-").isdecimal()}
    return frozenset({*stills, _VIDEO})


def _drawn(
    recording: ImageRecording, tracks: ImageTracks, frames: IntArray, progress: Progress
) -> Iterator[tuple[int, Image]]:
    pair_at = {pair.t_ns: pair for pair in recording.pairs}
    requested = [pair_at[t_ns] for t_ns in tracks.t_ns[frames].tolist()]
    for done, (k, images) in enumerate(zip(frames.tolist(), read_pairs(recording, requested), strict=True), start=1):
        if isinstance(images, Unusable):
            raise DataError(f"{images}: it was there when the tracks were made; copy it again")
        yield k, _still(images, tracks, k)
        progress.advance(done, frames.size, "drawing")


def _still(images: tuple[Image, Image], tracks: ImageTracks, k: int) -> Image:
    import cv2

    canvas = cv2.cvtColor(np.hstack(images), cv2.COLOR_GRAY2BGR)
    rows = np.flatnonzero((tracks.frame <= k) & (tracks.frame > k - max(_TRAIL, _OLD)))
    now = rows[tracks.frame[rows] == k]
    for row in now.tolist():
        past = rows[tracks.track_id[rows] == tracks.track_id[row]]
        # By the number of frames it was seen in: from blue over green to red.
        share = min(past.size / _OLD, 1.0)
        blue, red = max(1.0 - 2.0 * share, 0.0), max(2.0 * share - 1.0, 0.0)
        colour = round(255 * blue), round(255 * (1.0 - blue - red)), round(255 * red)
        way = np.rint(tracks.corners_px[past[-_TRAIL:], :2]).astype(np.int32)
        cv2.polylines(canvas, [way[:, None]], False, colour, 1, cv2.LINE_AA)
        left, right = tracks.corners_px[row, :2], tracks.corners_px[row, 2:] + [images[0].shape[1], 0.0]
        for place in (left, right):
            cv2.circle(canvas, np.rint(place).astype(int).tolist(), 3, colour, 1, cv2.LINE_AA)
    return np.asarray(canvas, dtype=np.uint8)
