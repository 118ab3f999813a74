"""KITTI raw drives: stereo images, synced and rectified or not, with the inertial navigation system's packets (oxts).

A folder with ``image_00/data`` and ``image_01/data`` (or ``image_02`` and ``image_03``), the calib_*.txt of its day in
it or beside it, and ``oxts/data``. Packets at 50 Hz or more are read as an IMU, slower ones as body twists; without any
a smooth motion is assumed. Whether images are rectified shows in their size. Truth and motion are of one instrument.
Axes of the IMU: forward, left, up. Source: Geiger, Lenz, Stiller & Urtasun, "Vision meets robotics: the KITTI dataset"
(IJRR 2013), and the readme of its development kit for the 30 values of a packet.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from toolkit.datasets.io.fields import Fields, check_frame_count, observations
from toolkit.datasets.io.image_checks import check_both_cameras, check_one_clock, check_several_stamps
from toolkit.datasets.io.image_pairs import (
    Listed,
    facts_of,
    image_folder,
    images_in,
    images_only,
    pairs_by_stamps,
    rig_of,
)
from toolkit.datasets.io.kitti_calibration import PairMounting, day_of, mounting
from toolkit.datasets.io.oxts import Packets, read_packets, read_stamps
from toolkit.errors import DataError
from toolkit.frontend import ImageRecording, size_of, track_images
from toolkit.inputs import is_regular
from toolkit.measured_motion import ImuNoise, ImuSamples, MotionNoise, MotionSamples, NoSamples, TwistSamples
from toolkit.models.noise import twist_noise, unmeasured_motion
from toolkit.progress import SILENT, Progress
from toolkit.resampling import NS_PER_S
from toolkit.sequence import Provenance, Sequence, Truth
from toolkit.settings import DEFAULTS, Frontend

CITES = ("geiger2013kitti",)
_SIDES = (("00", "01"), ("02", "03"))
# Between slower packets a car's specific force is not what its samples say.
_IMU_FROM_HZ = 50.0
# The same unit's, as GTSAM's example of drive 2011_10_03_drive_0027 states it.
_IMU_NOISE = ImuNoise(
    accel_noise_density=0.01, gyro_noise_density=1.75e-4, accel_random_walk=1.67e-4, gyro_random_walk=2.91e-6
)


@dataclass(frozen=True)
class _Layout:
    """The folder of a drive and the numbers of its two cameras."""

    root: Path
    sides: tuple[str, str]

    def images(self, side: int) -> Path:
        return image_folder(self.camera(side))

    def camera(self, side: int) -> Path:
        return self.root / f"image_{self.sides[side]}"


uses_images = images_only


def recognises(path: Path) -> bool:
    """Say whether the path is a folder with the images of a raw drive."""
    return _layout(path) is not None


def load(path: Path) -> Sequence:
    """Read a drive with the front end's default settings; see :func:`load_from_images`."""
    return load_from_images(path, DEFAULTS.frontend, SILENT)


def images_of(path: Path, frontend: Frontend) -> ImageRecording:
    """Return the image pairs and their cameras; raises DataError as :func:`load_from_images`."""
    layout = _whole(path)
    return ImageRecording(_listed(layout).pairs, _mounted(layout).pair)


def load_from_images(path: Path, frontend: Frontend, progress: Progress) -> Sequence:
    """Read calibration, stamps and packets, and make the tracks of the images.

    Raises DataError where a part is missing or damaged, or the images cannot be used.
    """
    layout = _whole(path)
    mounted, listed = _mounted(layout), _listed(layout)
    tracks = track_images(listed.pairs, mounted.pair, frontend, progress)
    check_frame_count(layout.root, tracks.t_ns.size)
    packets = read_packets(layout.root / "oxts")
    if packets is not None:
        check_one_clock(layout.root, tracks.t_ns, packets.t_ns, "the oxts packets")
    motion, noise, how = _motion(packets, tracks.t_ns)
    facts = (how, *facts_of(tracks, len(listed.pairs)), *listed.remarks, mounted.source)
    return Sequence(
        name=layout.root.name,
        rig=rig_of(mounted.pair, mounted.T_imu_left),
        noise=noise,
        frames_t_ns=tracks.t_ns,
        observations=observations(tracks.frame, tracks.track_id, tracks.corners_px),
        motion=motion,
        provenance=Provenance("kitti-raw", f"{path}: stereo tracks from the images", facts),
        truth=None if packets is None else _truth(packets),
    )


def _layout(path: Path) -> _Layout | None:
    """Return the first pair of cameras that both have images, else the first of which one has."""
    layouts = [_Layout(path.resolve(), sides) for sides in _SIDES]
    there = [tuple(bool(images_in(one.images(side))) for side in (0, 1)) for one in layouts]
    return next((one for how in (all, any) for one, both in zip(layouts, there, strict=True) if how(both)), None)


def _whole(path: Path) -> _Layout:
    layout = _layout(path)
    if layout is None:
        raise DataError(f"{path}: no image_00/data and image_01/data, or image_02 and image_03, with images")
    check_both_cameras(layout.root, layout.images(0), layout.images(1))
    return layout


def _listed(layout: _Layout) -> Listed:
    left, right = (layout.camera(side) / "timestamps.txt" for side in (0, 1))
    stamps = read_stamps(left)
    right_stamps = read_stamps(right) if is_regular(right) else stamps
    listed = pairs_by_stamps(layout.images(0), layout.images(1), stamps, right_stamps)
    check_several_stamps(left, listed)
    return listed


def _mounted(layout: _Layout) -> PairMounting:
    found = images_in(layout.images(0)) or images_in(layout.images(1))
    size_px = next((size for size in map(_size_or_none, found[:10]) if size is not None), None)
    day: Fields = day_of(layout.root)
    return mounting(day, layout.sides, size_of(found[0]) if size_px is None else size_px)


def _size_or_none(path: Path) -> tuple[int, int] | None:
    try:
        return size_of(path)
    except DataError:
        return None


def _motion(packets: Packets | None, frames_t_ns: np.ndarray) -> tuple[MotionSamples, MotionNoise, str]:
    """Return the motion samples, their noise, and which they are in words."""
    if packets is None:
        how = "no oxts: no motion input, all estimators assume a motion that is smooth"
        return NoSamples(frames_t_ns), unmeasured_motion(), how
    rate_hz = NS_PER_S / float(np.median(np.abs(np.diff(packets.t_ns))))
    if rate_hz >= _IMU_FROM_HZ:
        samples = ImuSamples(packets.t_ns, packets.accel_mps2, packets.w_radps)
        return samples, _IMU_NOISE, f"the oxts packets, {rate_hz:.0f} a second, are read as an IMU"
    v_mps = packets.v_body_mps
    how = f"the oxts packets, {rate_hz:.0f} a second, are too few for an IMU and read as body twists"
    return TwistSamples(packets.t_ns, v_mps, packets.w_radps), twist_noise(packets.t_ns, v_mps, packets.w_radps), how


def _truth(packets: Packets) -> Truth:
    """Return the poses of the same instrument, in order of time."""
    t_ns, first = np.unique(packets.t_ns, return_index=True)
    return Truth(t_ns, packets.T_world_imu[first], packets.v_world[first], independent=False)
