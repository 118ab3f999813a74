"""Pairs of image files: listed in the tables of an ASL folder, or paired by the numbers in their names.

Checks before any image is read: both cameras are there, stamps differ, and they lie in the motion's time.
"""

import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from toolkit.datasets.io.fields import check_frame_count, observations, probable_unit_of_ns
from toolkit.datasets.io.tables import read_stamps
from toolkit.errors import DataError
from toolkit.files.reading import is_regular, read_text_input
from toolkit.frontend import ImageRecording, ImageTracks, Pinhole, StampedPair, size_of
from toolkit.geometry import Array, IntArray
from toolkit.measurements import NS_PER_S, StereoRig
from toolkit.models.noise import pixel_covariance
from toolkit.progress import Progress
from toolkit.sequence import Observations
from toolkit.settings import Frontend, Tracks

SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".pgm")
UNPACK_IMAGES = f"unpack them there ({', '.join(SUFFIXES)} are read)"
# Cameras of one trigger differ by microseconds; at 1 m/s and 2 m a millisecond moves a corner by .2 px.
_SAME_INSTANT_NS = 1_000_000
# A name that ends in a number, as frame000123.
_NUMBER = re.compile(r"(.*\D)(\d+)")
# Pairs left out that are listed by name, and images that are opened to find the size of all.
_NAMED, _OPENED = 10, 10


@dataclass(frozen=True, eq=False)
class Listed:
    """Pairs in order of time, how many stamps the left camera has, and what had to be put right, in words.

    ``apart_ms`` is how far from each left image the nearest right one is (median) where none is of its instant.
    """

    pairs: tuple[StampedPair, ...]
    stamps: int
    remarks: tuple[str, ...] = ()
    apart_ms: float | None = None

    def existing(self, least: float) -> "Listed":
        """Return the pairs of which both files are there, with a remark, where their share is below the least.

        Of a recording that has nearly all its files those that are missing stay in, to be named one by one.
        """
        pairs = tuple(pair for pair in self.pairs if is_regular(pair.left) and is_regular(pair.right))
        if len(pairs) >= least * len(self.pairs):
            return self
        remark = f"{len(self.pairs) - len(pairs)} of {len(self.pairs)} image pairs lack a file and are left out"
        return replace(self, pairs=pairs, remarks=(*self.remarks, remark))

    def shifted(self, shift_s: float) -> "Listed":
        """Return the pairs with a time added to their stamps: that from the cameras' clock to the motion's."""
        shift_ns = round(shift_s * NS_PER_S)
        return replace(self, pairs=tuple(replace(pair, t_ns=pair.t_ns + shift_ns) for pair in self.pairs))

    def within(self, root: Path, motion_t_ns: IntArray, motion: str, remedy: str = "") -> "Listed":
        """Return the pairs within the time of motion samples (N,), with a remark where that leaves any out.

        Raises DataError as :func:`check_one_clock`, or where fewer than two pairs are left.
        """
        check_one_clock(root, np.array([pair.t_ns for pair in self.pairs]), motion_t_ns, motion, remedy)
        first, last = int(motion_t_ns.min()), int(motion_t_ns.max())
        pairs = tuple(pair for pair in self.pairs if first <= pair.t_ns <= last)
        check_frame_count(root, len(pairs))
        outside = len(self.pairs) - len(pairs)
        remark = f"{outside} of {len(self.pairs)} image pairs are outside the time of the motion samples and left out"
        return replace(self, pairs=pairs, remarks=(*self.remarks, remark)) if outside else self


def images_only(path: Path, tracks: Tracks) -> bool:
    """Say that the tracks are made of the images; raise DataError where simulated ones are asked for."""
    if tracks == "simulated":
        raise DataError(f"{path}: tracks are simulated for EuRoC folders only; leave --tracks simulated out")
    return True


def images_in(folder: Path) -> list[Path]:
    """Return the image files of a folder by name, without hidden ones; none where there is no such folder.

    A Mac puts a hidden ``._name.png`` beside each image on a disk of another system, which is none.
    """
    if not folder.is_dir():
        return []
    return sorted(p for p in folder.glob("*") if p.suffix.lower() in SUFFIXES and not p.name.startswith("."))


def image_folder(camera: Path) -> Path:
    """Return where a camera's images are: in ``data`` as ASL has it, in ``images`` (TUM-VI's dso), or in its folder."""
    return next(
        (folder for folder in (camera / "data", camera / "images", camera) if images_in(folder)), camera / "data"
    )


class _Side(NamedTuple):
    """The stamps (N,) ns and the images of a camera, in the order in which they are listed."""

    t_ns: IntArray
    images: Sequence[Path]


def _paired(left: _Side, right: _Side, reach_ns: float, alone: str) -> Listed:
    """Pair images by the nearest stamp within reach; ``alone`` says of left ones that none is."""
    remarks = []
    if (np.diff(left.t_ns) < 0).any():
        remarks.append("the stamps of the left images were out of order and have been sorted")
    t_ns, first = np.unique(left.t_ns, return_index=True)
    if t_ns.size < left.t_ns.size:
        remarks.append(f"{left.t_ns.size - t_ns.size} left images had the stamp of another and are left out")
    partner = _nearest(right.t_ns, t_ns, reach_ns)
    if (partner < 0).any():
        remarks.append(f"{int((partner < 0).sum())} left images have no right one {alone} and are left out")
    rows = zip(t_ns.tolist(), first.tolist(), partner.tolist(), strict=True)
    pairs = tuple(StampedPair(t, left.images[i], right.images[j]) for t, i, j in rows if j >= 0)
    none = t_ns.size > 0 and right.t_ns.size > 0 and not pairs
    apart_ms = 1e-6 * float(np.median(np.abs(right.t_ns[:, None] - t_ns).min(axis=0))) if none else None
    return Listed(pairs, t_ns.size, tuple(remarks), apart_ms)


def pairs_of_asl(mav0: Path) -> Listed:
    """Pair the images of cam0 and cam1 by their stamps; files that are listed and missing stay in, to be named.

    Raises DataError where a table is damaged.
    """
    return _paired(_side(mav0 / "cam0"), _side(mav0 / "cam1"), _SAME_INSTANT_NS, "within 1 ms")


def pairs_by_name(left: Path, right: Path, t_ns: Mapping[int, int]) -> Listed:
    """Pair images whose names are the same number; ``t_ns`` has the stamp of each number.

    An image whose partner is missing stays in, to be named; numbers without a stamp are left out and said. Either
    camera may write its numbers with other leading zeros or another suffix.
    """
    sides = {left: numbered(left), right: numbered(right)}
    names = {number: path.name for side in sides.values() for number, path in side.items()}
    stamped = [number for number in sorted(names) if number in t_ns]
    stamps = np.array([t_ns[number] for number in stamped], dtype=np.int64)
    both = [_Side(stamps, [there.get(n, folder / names[n]) for n in stamped]) for folder, there in sides.items()]
    listed = _paired(both[0], both[1], 0, "")
    unstamped = len(names) - len(stamped)
    remarks = (f"{unstamped} images have no stamp and are left out",) if unstamped else ()
    return replace(listed, stamps=len(names), remarks=(*remarks, *listed.remarks))


def pairs_by_stamps(left: Path, right: Path, t_ns: Mapping[int, int], right_t_ns: Mapping[int, int]) -> Listed:
    """Pair images whose names are numbers and whose stamps, by number, are the nearest.

    Where one camera has dropped an image the other has, numbers no longer tell what belongs together. Where stamps are
    out of order they tell it less than the numbers do, as :func:`pairs_by_name`. A stamp of the right camera that is
    missing leaves its image to the left one of the same number.
    """
    both = [dict(sorted(stamps.items())) for stamps in (t_ns, {**t_ns, **right_t_ns})]
    lefts, rights = (np.array(list(stamps.values()), dtype=np.int64) for stamps in both)
    reach_ns = 0.5 * float(np.median(np.diff(lefts))) if lefts.size > 1 else np.inf
    numbers = np.array([*both[1], -1])[_nearest(rights, lefts, reach_ns)]
    in_order = all((np.diff([stamps[n] for n in sorted(stamps)]) > 0).all() for stamps in (t_ns, right_t_ns))
    if not in_order or (numbers[numbers >= 0] == np.array(list(both[0]))[numbers >= 0]).all():
        return pairs_by_name(left, right, t_ns)
    there = numbered(left), numbered(right)
    kept = [number for number in both[0] if number in there[0]]
    listed = _paired(
        _Side(np.array([t_ns[number] for number in kept], dtype=np.int64), [there[0][number] for number in kept]),
        _Side(rights, [there[1].get(number, right / f"{number:010d}.png") for number in both[1]]),
        reach_ns,
        "of the same time",
    )
    how = "the cameras' images are numbered differently and paired by their stamps"
    return replace(listed, remarks=(how, *listed.remarks))


def numbered(folder: Path) -> dict[int, Path]:
    """Return the images of a folder by the numbers that are their names, or stand at the end of all of them."""
    images = images_in(folder)
    plain = {int(path.stem): path for path in images if path.stem.isdecimal()}
    ends = [_NUMBER.fullmatch(path.stem) for path in images]
    if plain or None in ends or len({end[1] for end in ends if end}) != 1:
        return plain
    return {int(end[2]): path for end, path in zip(ends, images, strict=True) if end}


@dataclass(frozen=True, eq=False)
class Seen:
    """What image pairs make of a recording: stamps (K,) of its frames, sightings, rig, and what to know of them."""

    frames_t_ns: IntArray
    observations: Observations
    rig: StereoRig
    facts: tuple[str, ...]


def seen_in(root: Path, filmed: ImageRecording, T_imu_left: Array, frontend: Frontend, progress: Progress) -> Seen:
    """Track image pairs; ``T_imu_left`` (4, 4) is where the left camera is mounted, before it is rectified.

    Raises DataError where the images cannot be used, or fewer than two pairs can.
    """
    tracks = filmed.tracks(frontend, progress)
    check_frame_count(root, tracks.t_ns.size)
    sightings = observations(tracks.frame, tracks.track_id, tracks.corners_px)
    pair, T_imu_rect = filmed.rig, T_imu_left.copy()
    T_imu_rect[:3, :3] = T_imu_left[:3, :3] @ pair.R_rect_cam.T
    pinhole_px = (pair.fx_px, pair.fy_px, pair.cx_px, pair.cy_px)
    rig = StereoRig(*pinhole_px, pair.baseline_m, T_imu_rect, pixel_covariance(2))
    return Seen(tracks.t_ns, sightings, rig, _facts_of(tracks, len(filmed.pairs)))


def image_size(left: Path, right: Path) -> tuple[int, int]:
    """Return the size (width, height) px of the first image that can be opened; DataError has the first one's fault."""
    found = images_in(left) or images_in(right)
    for path in found[:_OPENED]:
        with suppress(DataError):
            return size_of(path)
    return size_of(found[0])


def pinhole_of(P: Array) -> Pinhole:
    """Return fx, fy, cx, cy (px) of a projection (3, 4) or a camera matrix (3, 3)."""
    return float(P[0, 0]), float(P[1, 1]), float(P[0, 2]), float(P[1, 2])


def _facts_of(tracks: ImageTracks, pairs: int) -> tuple[str, ...]:
    a_frame = np.bincount(tracks.frame, minlength=tracks.t_ns.size)
    made = f"stereo tracks made of {tracks.t_ns.size} image pairs with OpenCV"
    counted = f"{made}: {a_frame.mean():.0f} a frame, {a_frame.min()} at least"
    if not tracks.skipped:
        return (counted,)
    named, others = ", ".join(tracks.skipped[:_NAMED]), len(tracks.skipped) - _NAMED
    lost = f"{len(tracks.skipped)} of {pairs} image pairs could not be used and are left out: {named}"
    return counted, f"{lost} and {others} more" if others > 0 else lost


def _side(camera: Path) -> _Side:
    """Return what a camera's table lists, or the images there are, whose names are stamps.

    An image that was converted is found by its stem: tables keep the old suffix.
    """
    table, folder = camera / "data.csv", image_folder(camera)
    there = images_in(folder)
    if not is_regular(table):
        stamped = [(stamp, path) for path in there if (stamp := _stamp_ns(path.stem)) is not None]
        return _Side(np.array([t for t, _ in stamped], dtype=np.int64), [path for _, path in stamped])
    lines = read_text_input(table, "copy it again").splitlines()
    headings = 0 if lines and lines[0][:1].isdigit() else 1
    t_ns = read_stamps(table, headings)
    rows = [row for row in lines[headings:] if row.strip() and row[0] != "#"]
    names = [row.partition(",")[2].strip() for row in rows]
    if len(names) != t_ns.size or any("/" in name or "\\" in name for name in names):
        raise DataError(f"{table}: expected a stamp and the name of an image in each row; export it again")
    by_name, by_stem = {path.name: path for path in there}, {path.stem: path for path in there}
    named = [name or f"{t}.png" for name, t in zip(names, t_ns.tolist(), strict=True)]
    return _Side(t_ns, [by_name.get(name) or by_stem.get(Path(name).stem, folder / name) for name in named])


def _stamp_ns(stem: str) -> int | None:
    """Return the stamp that a name without its suffix is, in nanoseconds or in seconds with a point; None otherwise."""
    whole, point, fraction = stem.partition(".")
    if not whole.isdecimal() or (point and not fraction.isdecimal()):
        return None
    return int(f"{whole}{fraction[:9]:0<9}") if point else int(whole[:19])


def _nearest(t_ns: IntArray, wanted_ns: IntArray, reach_ns: float) -> IntArray:
    """Return the row of the stamp nearest to each asked one, -1 where none is within reach."""
    if t_ns.size == 0:
        return np.full(wanted_ns.size, -1)
    order = np.argsort(t_ns, kind="stable")
    half_way = t_ns[order][:-1] + np.diff(t_ns[order]) // 2
    nearest = order[np.searchsorted(half_way, wanted_ns)]
    return np.where(np.abs(t_ns[nearest] - wanted_ns) <= reach_ns, nearest, -1)


def check_both_cameras(root: Path, left: Path, right: Path) -> None:
    """Raise DataError where one of two folders of a recording, its cameras' images, has none."""
    there, lacking = (left, right) if images_in(left) else (right, left)
    if not images_in(lacking):
        with_images, without = (str(folder.relative_to(root)) for folder in (there, lacking))
        why = "and stereo needs both cameras; add those of"
        raise DataError(f"{root}: {with_images} has images and {without} has none, {why} {without}")


def check_several_stamps(path: Path, listed: Listed) -> None:
    """Raise DataError, naming the file of the stamps, where there are not two pairs of two instants."""
    if len(listed.pairs) == 1 < listed.stamps:
        raise DataError(f"{path}: all {listed.stamps} images have one and the same stamp; write the time of each")
    check_frame_count(path, len(listed.pairs))


def check_one_clock(root: Path, images_t_ns: IntArray, motion_t_ns: IntArray, motion: str, remedy: str = "") -> None:
    """Raise DataError where no image (N,) lies in the time of the motion samples (S,), which ``motion`` names.

    The remedy is for two clocks that count alike.
    """
    first, last = int(motion_t_ns.min()), int(motion_t_ns.max())
    if first == last:
        raise DataError(f"{root}: {motion} are all of one instant, {first} ns; copy the whole recording again")
    if not ((images_t_ns >= first) & (images_t_ns <= last)).any():
        unit = probable_unit_of_ns(images_t_ns)
        why = f"they are of two clocks or two recordings{remedy}" if unit is None else f"the images' look like {unit}"
        pairs = f"{images_t_ns.size} image pairs, {images_t_ns.min()} to {images_t_ns.max()} ns"
        raise DataError(f"{root}: none of the {pairs}, lies in the time of {motion}, {first} to {last} ns; {why}")
