"""KITTI odometry sequences: rectified stereo images, calib.txt, and times.txt and poses where they are there.

A folder with ``image_0`` and ``image_1`` (or ``image_2`` and ``image_3``, or ``image_l`` and ``image_r``). There is no
motion input: estimators assume a smooth motion (:mod:`toolkit.models.twist`), which every report says. The body,
called IMU everywhere, is camera 0 with the axes forward, left, up. Poses are camera 0's, in the folder or, as the
download has it, in ``../../poses/<name>.txt``.
Source: Geiger, Lenz & Urtasun, "Are we ready for autonomous driving? The KITTI vision benchmark suite" (CVPR 2012).
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from toolkit.datasets.io.fields import stamps_ns
from toolkit.datasets.io.image_pairs import (
    UNPACK_IMAGES,
    Listed,
    check_both_cameras,
    check_several_stamps,
    first_with_images,
    has_folders,
    image_size,
    images_in,
    images_only,
    pairs_by_name,
    pinhole_of,
    seen_in,
)
from toolkit.datasets.trajectories import read_poses
from toolkit.errors import DataError
from toolkit.files.reading import is_regular, read_text_input
from toolkit.frontend import ImageRecording, RectifiedPair, already_rectified
from toolkit.geometry import Array, IntArray, se3
from toolkit.models.noise import unmeasured_motion
from toolkit.motion_samples import NoSamples
from toolkit.progress import SILENT, Progress
from toolkit.sequence import Provenance, Sequence, Truth
from toolkit.settings import DEFAULTS, Frontend

CITES = ("geiger2012kitti",)
NO_MOTION = "no motion input: all estimators assume smooth motion"
# Grey or colour, and the rows of calib.txt that are theirs.
_FOLDERS = (("image_0", "image_1", 0), ("image_2", "image_3", 2), ("image_l", "image_r", 0))
_PERIOD_S = 0.1
# No camera's axis meets its image this near the border: calib.txt is of larger images than these.
_BORDER = 0.1
# Few do so far from the middle both ways (shares of width and height); that of images half as large is 0.25 off.
_ASIDE = 0.15
# Axes right, down, forward of a camera, from forward, left, up.
T_FLU_CAM = se3(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]), np.zeros(3))


@dataclass(frozen=True)
class _Layout:
    """The folders of both cameras' images, and the row of calib.txt of the left one."""

    root: Path
    left: Path
    right: Path
    row: int


uses_images = images_only


def recognises(path: Path) -> bool:
    """Say whether the path has the folders of a rectified pair, as KITTI odometry names them, or one with images."""
    return _layout(path) is not None or any(has_folders(path, left, right) for left, right, _ in _FOLDERS)


def load(path: Path) -> Sequence:
    """Read a sequence with the front end's default settings; see :func:`load_from_images`."""
    return load_from_images(path, DEFAULTS.frontend, SILENT)


def images_of(path: Path, frontend: Frontend) -> ImageRecording:
    """Return the image pairs and their cameras; raises DataError as :func:`load_from_images`."""
    layout = _whole(path)
    return ImageRecording(_listed(layout, _stamps(layout)[0]).pairs, _pair(layout))


def load_from_images(path: Path, frontend: Frontend, progress: Progress) -> Sequence:
    """Read calibration, stamps and poses, and make the tracks of the images.

    Raises DataError where a part is missing or damaged, or the images cannot be used.
    """
    layout = _whole(path)
    pair = _pair(layout)
    stamps, how = _stamps(layout)
    listed = _listed(layout, stamps)
    left = _projections(layout)[0]
    T_cam0_left = se3(np.eye(3), np.array([-left[0, 3] / left[0, 0], 0.0, 0.0]))
    seen = seen_in(layout.root, ImageRecording(listed.pairs, pair), T_FLU_CAM @ T_cam0_left, frontend, progress)
    truth = _truth(layout, stamps, seen.frames_t_ns)
    facts = (NO_MOTION, *seen.facts, *listed.remarks, *how, *_aside(pair))
    return Sequence(
        name=layout.root.name,
        rig=seen.rig,
        noise=unmeasured_motion(),
        frames_t_ns=seen.frames_t_ns,
        observations=seen.observations,
        motion=NoSamples(seen.frames_t_ns),
        provenance=Provenance("kitti-odometry", f"{path}: stereo tracks from the images", facts),
        truth=truth,
    )


def _whole(path: Path) -> _Layout:
    layout = _layout(path)
    if layout is None:
        raise DataError(
            f"{path}: no image_0 and image_1, image_2 and image_3, or image_l and image_r with images; {UNPACK_IMAGES}"
        )
    check_both_cameras(layout.root, layout.left, layout.right)
    return layout


def _pair(layout: _Layout) -> RectifiedPair:
    left, right = _projections(layout)
    baseline_m = (left[0, 3] - right[0, 3]) / left[0, 0]
    if baseline_m == 0.0:
        rows = f"P{layout.row} and P{layout.row + 1}"
        raise DataError(f"{layout.root / 'calib.txt'}: {rows} are the same, so there is no baseline; give each its own")
    if not baseline_m > 0.0:
        raise DataError(f"{layout.root / 'calib.txt'}: the right camera is not to the right of the left; exchange rows")
    pinhole_px, size_px = pinhole_of(left), image_size(layout.left, layout.right)
    cx_px, cy_px = pinhole_px[2:]
    if not all(_BORDER < c / size < 1.0 - _BORDER for c, size in zip((cx_px, cy_px), size_px, strict=True)):
        raise DataError(
            f"{layout.root / 'calib.txt'}: its principal point, {cx_px:g} {cy_px:g}, is not that of images of "
            f"{size_px[0]}x{size_px[1]} px; where these were scaled or cut, do the same to P0 to P3"
        )
    return already_rectified(pinhole_px, float(baseline_m), size_px)


def _aside(pair: RectifiedPair) -> tuple[str, ...]:
    """Return a warning where the principal point is far from the middle of the images both ways.

    Images without motion samples have nothing else that would contradict a calibration of images half as large.
    """
    centre, size_px = (pair.cx_px, pair.cy_px), pair.size_px
    if not all(abs(c / size - 0.5) > _ASIDE for c, size in zip(centre, size_px, strict=True)):
        return ()
    return (
        f"the principal point, {centre[0]:g} {centre[1]:g}, is far from the middle of images of "
        f"{size_px[0]}x{size_px[1]} px: check that calib.txt is of images of this size",
    )


def _listed(layout: _Layout, stamps: IntArray) -> Listed:
    listed = pairs_by_name(layout.left, layout.right, dict(enumerate(stamps.tolist())))
    if not listed.pairs:
        numbers = _numbers(layout)
        if not numbers:
            name = images_in(layout.left)[0].name
            raise DataError(f"{layout.left}: {name} is no number; name the images of an instant alike, as 000000.png")
        raise DataError(
            f"{layout.root}: no image has a stamp: they are numbered {numbers[0]} to {numbers[-1]}, and times.txt has "
            f"{stamps.size}, from number 0 on; cut both or neither"
        )
    check_several_stamps(layout.root / "times.txt", listed)
    return listed


def _layout(path: Path) -> _Layout | None:
    """Return the first pair of folders that both have images, else the first of which one has."""
    root = path.resolve()
    layouts = [_Layout(root, root / left, root / right, row) for left, right, row in _FOLDERS]
    place = first_with_images([(one.left, one.right) for one in layouts])
    return None if place is None else layouts[place]


def _projections(layout: _Layout) -> tuple[Array, Array]:
    """Return the projections (3, 4) of both cameras from calib.txt, whose rows may or may not be named P0, P1, ..."""
    file = layout.root / "calib.txt"
    if not file.exists():
        raise DataError(f"{file}: is missing; put the calib.txt of this sequence there, with the rows P0: to P3:")
    rows: dict[str, Array] = {}
    for number, line in enumerate(read_text_input(file, "KITTI's calib.txt is text").splitlines(), start=1):
        name, colon, rest = line.partition(":")
        columns = (rest if colon else line).split()
        try:
            values = np.array([float(word) for word in columns])
        except ValueError as error:
            raise DataError(
                f"{file}: line {number}: {error}; KITTI odometry's calib.txt has P0: to P3:, twelve numbers each"
            ) from error
        if values.size == 12:
            rows[name.strip() if colon else f"P{len(rows)}"] = values.reshape(3, 4)
    wanted = [f"P{layout.row}", f"P{layout.row + 1}"]
    missing = [name for name in wanted if name not in rows]
    if missing:
        raise DataError(
            f"{file}: missing {', '.join(missing)}, twelve numbers each; it has {', '.join(rows) or 'none'}"
        )
    left, right = (rows[name] for name in wanted)
    for name, P in zip(wanted, (left, right), strict=True):
        if not (np.isfinite(P).all() and P[0, 0] > 0.0 and P[1, 1] > 0.0):
            raise DataError(f"{file}: {name} is no projection: its focal lengths must be positive")
    if not np.allclose(left[:, :3], right[:, :3], rtol=1e-6):
        raise DataError(f"{file}: {wanted[0]} and {wanted[1]} differ in more than the baseline; they are not rectified")
    return left, right


def _stamps(layout: _Layout) -> tuple[IntArray, tuple[str, ...]]:
    """Return the stamp (N,) of each image number, and what must be known of them."""
    file = layout.root / "times.txt"
    if not is_regular(file):
        period_ns = round(_PERIOD_S * 1e9)
        return period_ns * np.arange(_count(layout)), (f"no times.txt: an image every {_PERIOD_S:g} s is assumed",)
    lines = read_text_input(file, "times.txt is text").splitlines()
    seconds = [_seconds(file, number, line) for number, line in enumerate(lines, start=1) if line.strip()]
    return stamps_ns(file, "stamp", np.array(seconds, dtype=np.float64)), ()


def _seconds(file: Path, number: int, line: str) -> float:
    try:
        return float(line)
    except ValueError as error:
        raise DataError(f"{file}: line {number} is {line.strip()!r}; expected one number a line, in seconds") from error


def _numbers(layout: _Layout) -> list[int]:
    """Return the numbers of the left images, in order."""
    return sorted(int(path.stem) for path in images_in(layout.left) if path.stem.isdecimal())


def _count(layout: _Layout) -> int:
    """Return how many images the sequence has, by the last number, for some may be missing."""
    return max(_numbers(layout), default=-1) + 1


def _truth(layout: _Layout, stamps: IntArray, t_ns: IntArray) -> Truth | None:
    """Return the poses of the frames used, as those of the body; None where there are no poses."""
    beside = layout.root.parent.parent / "poses" / f"{layout.root.name}.txt"
    file = next((path for path in (layout.root / "poses.txt", beside) if is_regular(path)), None)
    if file is None:
        return None
    poses = read_poses(file)
    if poses.t_ns is not None:
        raise DataError(
            f"{file}: is a trajectory with stamps ({poses.format}), and KITTI's poses have twelve numbers a line and "
            "none; move it away, and give poses of the body (forward, left, up) in TUM format with --truth"
        )
    T_world_cam = poses.T_world_imu
    if len(T_world_cam) not in (stamps.size, _count(layout)):
        raise DataError(
            f"{file}: {len(T_world_cam)} poses for {stamps.size} images; the file is of another sequence, or not cut "
            "as the images are"
        )
    T_cam_flu = np.linalg.inv(T_FLU_CAM)
    posed = stamps[: len(T_world_cam)]
    used = np.flatnonzero(np.isin(posed, t_ns))
    used = used[np.unique(posed[used], return_index=True)[1]]
    return Truth(stamps[used], T_FLU_CAM @ T_world_cam[used] @ T_cam_flu)
