"""Makes stereo tracks of a recording's images: reads, rectifies, tracks, and caches the result.

A pair that cannot be used is named and left out; the tracks continue after it. Before the first step it is checked that
left and right are not exchanged, and that the calibration fits the images.
"""

from collections.abc import Iterable, Iterator, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from toolkit.errors import DataError
from toolkit.frontend import cache
from toolkit.frontend.cameras import Image, RectifiedPair
from toolkit.frontend.images import StampedPair, Unusable, bit_depth, read_ahead, read_image
from toolkit.frontend.tracker import TrackedCorners, Tracker
from toolkit.geometry import Array, IntArray
from toolkit.progress import SILENT, Progress
from toolkit.settings import Frontend

# Pairs that are checked before all others, spread over the recording.
_LOOKED_AT = 5
# A valid pair has matches for a third or more of the wanted corners, two images that are no pair hardly any.
_LEAST_MATCHED, _MOST_SWAPPED = 0.08, 2.0
_MISPAIRED = "left and right image are not of the same instant", "pair the images by when they were taken"
_REPEATED = "it and its partner are those of the pair before"


@dataclass(frozen=True, eq=False)
class ImageRecording:
    """The image pairs of a recording in order of time, and the pair of cameras that took them.

    ``spool`` is the folder they were unpacked into, which goes with it; None where they are files of the recording.
    """

    pairs: tuple[StampedPair, ...]
    rig: RectifiedPair
    spool: cache.ImageSpool | None = None

    def tracks(self, frontend: Frontend, progress: Progress) -> "ImageTracks":
        """Make the tracks, as :func:`track_images`; a message names what images were unpacked of."""
        with nullcontext() if self.spool is None else self.spool.errors_named():
            return track_images(self.pairs, self.rig, frontend, progress)


@dataclass(frozen=True, eq=False)
class ImageTracks:
    """Tracks of the usable pairs: stamps (K,), sightings as frame (N,), id (N,), corners (N, 4) px, and what was not.

    A corner is uL, vL, uR, vR in the rectified images; ``skipped`` names each pair left out, with the reason.
    """

    t_ns: IntArray
    frame: IntArray
    track_id: IntArray
    corners_px: Array
    skipped: tuple[str, ...] = ()


def track_images(
    pairs: Sequence[StampedPair], rig: RectifiedPair, settings: Frontend, progress: Progress = SILENT
) -> ImageTracks:
    """Return the tracks over pairs in order of time, from the cache where the same images were tracked so before.

    The same images and settings give the same bits. Raises DataError where half the pairs or more cannot be used, left
    and right are exchanged, or the calibration is not that of the images.
    """
    key = cache.key_of(pairs, rig, settings)
    kept = cache.load(key)
    if kept is not None:
        return ImageTracks(**kept)
    bits = _bits_of(pairs)
    _check_sides(_SideCheck(pairs, rig, settings, bits))
    found = _tracked(pairs, rig, settings, bits, progress)
    cache.save(key, vars(found))
    return found


def matched_corners(pairs: Sequence[StampedPair], rig: RectifiedPair, settings: Frontend) -> int:
    """Return how many corners of the left images of a few pairs are found in the same rows of the right ones."""
    return sum(one.found for one in _SideCheck(pairs, rig, settings, _bits_of(pairs)).looked_at.values())


def read_pair(
    pair: StampedPair, rig: RectifiedPair, bits: int, sides: tuple[int, int] = (0, 1)
) -> tuple[Image, Image] | Unusable:
    """Read and rectify both images of a pair, or return what is wrong with the first that cannot be used.

    ``sides`` says which camera, left (0) or right (1), either file is of.
    """
    images = []
    for side, path in zip(sides, (pair.left, pair.right), strict=True):
        image = read_image(path, bits, rig.raw_size_px)
        if isinstance(image, Unusable):
            return image
        images.append(rig.apply(image, side))
    return images[0], images[1]


def read_pairs(recording: ImageRecording, pairs: Sequence[StampedPair]) -> Iterator[tuple[Image, Image] | Unusable]:
    """Yield some rectified pairs of a recording, grey values as its tracks were made of, or what is wrong with one."""
    bits = _bits_of(recording.pairs)
    yield from (read_pair(pair, recording.rig, bits) for pair in pairs)


def _bits_of(pairs: Sequence[StampedPair]) -> int:
    return bit_depth(path for pair in _some(pairs) for path in (pair.left, pair.right))


def _some(pairs: Sequence[StampedPair]) -> list[StampedPair]:
    return [pairs[i] for i in sorted({0, len(pairs) // 2, len(pairs) - 1})]


def _tracked(
    pairs: Sequence[StampedPair], rig: RectifiedPair, settings: Frontend, bits: int, progress: Progress
) -> ImageTracks:
    tracker, skipped = Tracker(rig, settings), list[Unusable]()
    seen: list[tuple[int, TrackedCorners]] = []
    stalled = 0
    for i, images in enumerate(_without_repeats(read_ahead(pairs, lambda pair: read_pair(pair, rig, bits)), pairs)):
        stalled += isinstance(images, Unusable) and images.reason == _REPEATED
        sightings = None if isinstance(images, Unusable) else tracker.step(*images)
        if sightings is not None:
            seen.append((pairs[i].t_ns, sightings))
        else:
            skipped.append(images if isinstance(images, Unusable) else Unusable(pairs[i].right, *_MISPAIRED))
        progress.advance(i + 1, len(pairs), "tracking")
    if 2 * (len(skipped) - stalled) >= len(pairs) or len(seen) < 2 <= len(pairs):
        reasons = [one.reason for one in skipped]
        often = max(skipped, key=lambda one: reasons.count(one.reason))
        raise DataError(
            f"{often.path.parent}: {len(skipped)} of {len(pairs)} image pairs cannot be used, as {often}; "
            f"{often.remedy}"
        )
    return ImageTracks(
        np.array([t_ns for t_ns, _ in seen], dtype=np.int64),
        np.repeat(np.arange(len(seen)), [len(s.track_ids) for _, s in seen]),
        np.concatenate([s.track_ids for _, s in seen]),
        np.concatenate([s.corners_px for _, s in seen]),
        tuple(map(str, skipped)),
    )


def _without_repeats(
    read: Iterable[tuple[Image, Image] | Unusable], pairs: Sequence[StampedPair]
) -> Iterator[tuple[Image, Image] | Unusable]:
    """Yield what was read of each pair; a pair that is the last one once more, to the last grey value, is unusable.

    Sensor noise makes identical images impossible: the camera stalled, or files were copied. Tracks that stand still
    while the camera moves would contradict every other measurement.
    """
    last: tuple[Image, Image] | None = None
    for images, pair in zip(read, pairs, strict=True):
        if isinstance(images, Unusable):
            yield images
        elif last is not None and all(np.array_equal(*both) for both in zip(images, last, strict=True)):
            yield Unusable(pair.left, _REPEATED)
        else:
            last = images
            yield images


class _Matches(NamedTuple):
    """How many corners of a left image were looked for in a right one, and how many are found."""

    wanted: int
    found: int


@dataclass(frozen=True, eq=False)
class _SideCheck:
    """Matches corners of a few pairs, each by itself, to see whether left and right belong together."""

    pairs: Sequence[StampedPair]
    rig: RectifiedPair
    settings: Frontend
    bits: int

    @cached_property
    def looked_at(self) -> dict[int, _Matches]:
        """The matches of some usable pairs, by their places in the recording."""
        places = np.unique(np.linspace(0, len(self.pairs) - 1, _LOOKED_AT).astype(int)).tolist()
        tried = {place: self._matches(place) for place in places}
        return {place: matches for place, matches in tried.items() if matches is not None}

    def found(self, offset: int = 0, sides: tuple[int, int] = (0, 1)) -> int:
        """Return how many corners of these left images are found in the right images ``offset`` pairs later.

        ``sides`` (1, 0) exchanges left and right.
        """
        matches = (self._matches(place, offset, sides) for place in self.looked_at)
        return sum(one.found for one in matches if one is not None)

    def _matches(self, place: int, offset: int = 0, sides: tuple[int, int] = (0, 1)) -> _Matches | None:
        if not 0 <= place + offset < len(self.pairs):
            return None
        pair = replace(self.pairs[place], right=self.pairs[place + offset].right)
        images = read_pair(pair, self.rig, self.bits, sides)
        if isinstance(images, Unusable):
            return None
        tracker = Tracker(self.rig, self.settings)
        seen = tracker.step(images[sides[0]], images[sides[1]])
        return _Matches(tracker.tried, 0 if seen is None else len(seen.track_ids))

    def all_alike(self) -> bool:
        """Say whether left and right image are one and the same in a few pairs, before any rectification."""
        for pair in _some(self.pairs):
            left, right = (read_image(path, self.bits, self.rig.raw_size_px) for path in (pair.left, pair.right))
            if isinstance(left, Unusable) or isinstance(right, Unusable):
                return False
            if not (np.ptp(left) > 0 and np.array_equal(left, right)):
                return False
        return True


def _check_sides(check: _SideCheck) -> None:
    folders, settings = f"{check.pairs[0].left.parent} and {check.pairs[0].right.parent}", check.settings
    if check.all_alike():
        raise DataError(f"{folders}: left and right images are the same ones; one camera's were copied for both")
    wanted = sum(one.wanted for one in check.looked_at.values())
    matched = sum(one.found for one in check.looked_at.values())
    least = max(_MOST_SWAPPED * matched, _LEAST_MATCHED * wanted)
    # A pair begins at most this many tracks: where enough are found as called, no other way can find more by the
    # factor.
    most = settings.max_tracks * len(check.looked_at)
    if most > least and check.found(sides=(1, 0)) > least:
        raise DataError(
            f"{folders}: left and right images are exchanged; exchange the two, or turn the images back if all are "
            "upside down or mirrored"
        )
    if min(most, wanted) > least:
        before, after = check.found(-1), check.found(1)
        if max(before, after) > least:
            which = "before" if before > after else "after"
            raise DataError(
                f"{folders}: left images match the right images of the pair {which} theirs: one camera began earlier "
                "or dropped an image; pair them by when they were taken"
            )
    if matched < _LEAST_MATCHED * wanted:
        raise DataError(
            f"{folders}: only {matched} of {wanted} corners of left images are found in the same rows of the right "
            "ones; the calibration is not that of these images, they are no pairs, or frontend.* is too strict"
        )
