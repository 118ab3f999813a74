"""A few images of a recording with their tracks, and the error of each track under each estimator's poses.

The error of a sighting is its leave-one-view-out error: its distance from the prediction by the track's other sightings
and the estimated poses. It needs only the poses of an estimator, and is small where poses and track are accurate.
"""

from collections.abc import Iterator

import numpy as np

from toolkit.datasets import tracked_images
from toolkit.errors import DataError
from toolkit.experiment.comparison import Comparison, Row
from toolkit.files.documents import numbers
from toolkit.frontend import ImageRecording
from toolkit.frontend.cameras import Image
from toolkit.frontend.images import Unusable
from toolkit.frontend.tracking import read_pairs
from toolkit.geometry import Array, BoolArray, IntArray
from toolkit.metrics.parts.evaluation import Evaluation
from toolkit.metrics.parts.leave_one_out import errors_left_out
from toolkit.report.curves import seconds
from toolkit.report.report_json import CameraFrame, TrackErrors
from toolkit.sequence import Sequence

FOLDER = "frames"
_COUNT = 4
_JPEG_QUALITY = 80


def camera_frames(comparison: Comparison) -> tuple[tuple[CameraFrame, bytes], ...]:
    """Return some frames, spread over the recording, each with its JPEG, where its tracks are made of images."""
    recording = None if comparison.over_seeds else _images(comparison)
    if recording is None:
        return ()
    import cv2

    sequence = comparison.sequence
    shown = np.unique(np.linspace(0, sequence.frame_count - 1, _COUNT + 2)[1:-1].astype(np.int64))
    seen = np.isin(sequence.observations.frame, shown)
    errors_px = {row: found for row in comparison.rows if (found := _errors_px(row, sequence, seen)) is not None}
    frames = []
    for k, image in _left_images(recording, sequence.frames_t_ns, shown):
        here = np.flatnonzero(sequence.observations.frame == k)
        uv_px = sequence.observations.uv_px[here]
        frame = CameraFrame(
            t_s=seconds(sequence, sequence.frames_t_ns[[k]])[0],
            image=f"{FOLDER}/{int(sequence.frames_t_ns[k])}.jpg",
            width_px=image.shape[1],
            height_px=image.shape[0],
            u_px=numbers(uv_px[:, 0]),
            v_px=numbers(uv_px[:, 2]),
            errors=tuple(
                TrackErrors(estimator=row.estimator, output=row.output, off_px=numbers(of_all[here]))
                for row, of_all in errors_px.items()
            ),
        )
        jpeg = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])[1].tobytes()
        frames.append((frame, jpeg))
    return tuple(frames)


def _images(comparison: Comparison) -> ImageRecording | None:
    try:
        return tracked_images(comparison.source, comparison.settings.frontend)
    except DataError:  # a sequence given as a value has a name and no path
        return None


def _errors_px(row: Row, sequence: Sequence, requested: BoolArray) -> Array | None:
    """Return the error (N,) px of every sighting whose track has one that is asked for (N,); NaN where there is none.

    None where the row has no poses of its own.
    """
    if row.repeats_causal or row.run.trajectory(row.output) is None:
        return None
    observations = sequence.observations
    wanted = np.flatnonzero(np.isin(observations.track_id, observations.track_id[requested]))
    poses = Evaluation(row.run, row.output, sequence).poses_of_frames
    with np.errstate(all="ignore"):  # a diverged run overflows; that becomes null
        found, found_px = errors_left_out(observations.select(wanted), poses, sequence.rig)
    errors_px = np.full(len(observations), np.nan)
    errors_px[wanted[found]] = found_px
    return errors_px


def _left_images(recording: ImageRecording, frames_t_ns: IntArray, shown: IntArray) -> Iterator[tuple[int, Image]]:
    """Yield the left images of frames; an image that was removed since the tracks were made is left out."""
    pair_at = {pair.t_ns: pair for pair in recording.pairs}
    there = [(k, pair_at[t]) for k, t in zip(shown.tolist(), frames_t_ns[shown].tolist(), strict=True) if t in pair_at]
    for (k, _), images in zip(there, read_pairs(recording, [pair for _, pair in there]), strict=True):
        if not isinstance(images, Unusable):
            yield k, images[0]
