"""Course recordings since 2025 (UC San Diego, ECE 276A): datasetNN.npy, a pickled dict, and datasetNN_imgs.npy.

The dict has ``v_t`` and ``w_t`` (T, 3), ``timestamps`` (T,) s, ``features`` (4, M, T) of uL vL uR vR with -1 where not
seen, ``K_l``, ``K_r``, ``extL_T_imu`` and ``extR_T_imu``. It is read, never unpickled
(:mod:`~toolkit.datasets.io.numpy_files`). Where there are no features, or images are asked for, the tracks are made of
``cam_imgs_L`` and ``cam_imgs_R``.

The extrinsics are called IMU to camera, and files are about that hold camera to IMU, in axes x forward, y left, z up.
A sequence has them as they are called; the audit decides (:mod:`toolkit.audit.conventions`).
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from toolkit.datasets.io.fields import (
    NO_SIGHTINGS,
    Fields,
    camera_matrix,
    check_frame_count,
    rectified_observations,
    stamps_ns,
)
from toolkit.datasets.io.image_pairs import pinhole_of, seen_in
from toolkit.datasets.io.numpy_files import MAGIC, corners_of, read_dict
from toolkit.errors import DataError
from toolkit.files.reading import is_regular, open_input
from toolkit.frontend import Camera, ImageRecording, RectifiedPair, StampedPair, already_rectified, rectified
from toolkit.frontend.cache import ImageSpool
from toolkit.geometry import Array, IntArray, se3, se3_inverse, so3_angle
from toolkit.measurements import StereoRig
from toolkit.models.noise import pixel_covariance, twist_noise
from toolkit.motion_samples import TwistSamples
from toolkit.progress import SILENT, Progress
from toolkit.sequence import EXTRINSIC_UNCERTAIN, NO_FEATURES, Observations, Provenance, Sequence
from toolkit.settings import Frontend, Tracks

_REQUIRED = ("v_t", "w_t", "timestamps", "K_l", "K_r", "extL_T_imu", "extR_T_imu")
_FEATURES, _IMAGES = "features", ("cam_imgs_L", "cam_imgs_R")
_IMAGES_SUFFIX = "_imgs"
# A rectified pair is not turned; calibrated before rectification it seems so by a degree, another pair by more.
_TURNED_RAD, _MOST_TURNED_RAD = 1e-3, 0.05


def recognises(path: Path) -> bool:
    """Say whether the path is a file in NumPy's format for one array, or for one pickle."""
    if not is_regular(path):
        return False
    with open_input(path) as file:
        return file.read(len(MAGIC)) == MAGIC


def load(path: Path) -> Sequence:
    """Read a recording with the tracks it brings; its features are streamed and never held dense.

    Raises DataError where the file is damaged, holds what is no plain data, or a key is missing or not of its shape.
    """
    parts = _parts(path)
    features = parts.stored.get(_FEATURES)
    K = parts.K[0]
    rig = StereoRig(K[0, 0], K[1, 1], K[0, 2], K[1, 2], parts.baseline_m, parts.T_imu_left, pixel_covariance(2))
    if not isinstance(features, np.ndarray):
        return _sequence(parts, rig, NO_SIGHTINGS, (NO_FEATURES,))
    frame, track, corners_px, facts = corners_of(path, _FEATURES, features, parts.t_ns.size)
    left, right = parts.K
    if not np.array_equal(left, right):
        # The right corners become those that the left camera would see from there.
        scale = np.diag(left)[:2] / np.diag(right)[:2]
        corners_px[:, 2:] = (corners_px[:, 2:] - right[:2, 2]) * scale + left[:2, 2]
    return _sequence(parts, rig, rectified_observations(path, frame, track, corners_px), facts)


def uses_images(path: Path, tracks: Tracks) -> bool:
    """Say whether the tracks are made of images: as asked for, or where there are images and no features."""
    if tracks == "simulated":
        raise DataError(f"{path}: tracks are simulated for EuRoC folders only; leave --tracks simulated out")
    return tracks == "images" or (is_regular(_beside(path)) and _FEATURES not in read_dict(path))


def images_of(path: Path, frontend: Frontend) -> ImageRecording:
    parts = _parts(path)
    spool = ImageSpool(str(_beside(path)))
    pairs, size_px = _spooled(parts, spool, SILENT)
    return ImageRecording(pairs, _pair(parts, size_px), spool)


def load_from_images(path: Path, frontend: Frontend, progress: Progress) -> Sequence:
    parts = _parts(path)
    spool = ImageSpool(str(_beside(path)))
    try:
        pairs, size_px = _spooled(parts, spool, progress)
        filmed = ImageRecording(pairs, _pair(parts, size_px), spool)
        seen = seen_in(path, filmed, parts.T_imu_left, frontend, progress)
    finally:
        spool.close()
    return replace(_sequence(parts, seen.rig, seen.observations, seen.facts), frames_t_ns=seen.frames_t_ns)


@dataclass(frozen=True, eq=False)
class _Parts:
    """What a file holds: stamps (T,), twists (T, 3), both camera matrices, where the left one stands, the baseline."""

    path: Path
    stored: Mapping[str, Any]
    t_ns: IntArray
    v_mps: Array
    w_radps: Array
    K: tuple[Array, ...]
    T_imu_left: Array
    baseline_m: float
    facts: tuple[str, ...]


def _parts(path: Path) -> _Parts:
    stored = read_dict(path)
    if all(key in stored for key in _IMAGES) and "v_t" not in stored:
        raise DataError(f"{path}: the images of a recording alone; name the file beside it without {_IMAGES_SUFFIX}")
    arrays = {key: _array(value) for key, value in stored.items() if key in _REQUIRED}
    fields = Fields(path, {key: value for key, value in arrays.items() if value is not None})
    fields.require(*_REQUIRED)
    t_ns = stamps_ns(path, "timestamps", fields.vector("timestamps"))
    check_frame_count(path, t_ns.size)
    v_mps, w_radps = (fields.array(key, t_ns.size, 3) for key in ("v_t", "w_t"))
    matrices = (camera_matrix(path, key, fields.constant(key, 3, 3)) for key in ("K_l", "K_r"))
    left, right = (fields.rigid(key) for key in ("extL_T_imu", "extR_T_imu"))
    turned_rad = float(so3_angle(left[:3, :3].T @ right[:3, :3]))
    turned = f"{np.rad2deg(turned_rad):.2f} deg"
    if turned_rad > _MOST_TURNED_RAD:
        raise DataError(f"{path}: extL_T_imu and extR_T_imu are turned by {turned}: no pair; rectify the recording")
    # The same number in whatever direction and axes the extrinsics are.
    baseline_m = float(np.linalg.norm(left[:3, 3] - right[:3, 3]))
    if not baseline_m > 0.0:
        raise DataError(f"{path}: extL_T_imu and extR_T_imu are the same, and so without a baseline; correct one")
    fact = f"the extrinsics of the cameras differ by {turned}; the pair is assumed to be rectified"
    facts = (fact,) if turned_rad > _TURNED_RAD else ()
    return _Parts(path, stored, t_ns, v_mps, w_radps, tuple(matrices), se3_inverse(left), baseline_m, facts)


def _array(value: Any) -> Any:
    try:
        return np.asarray(value)
    except ValueError:  # a ragged list
        return None


def _sequence(parts: _Parts, rig: StereoRig, seen: Observations, facts: tuple[str, ...]) -> Sequence:
    return Sequence(
        name=parts.path.stem,
        rig=rig,
        noise=twist_noise(parts.t_ns, parts.v_mps, parts.w_radps),
        frames_t_ns=parts.t_ns,
        observations=seen,
        motion=TwistSamples(parts.t_ns, parts.v_mps, parts.w_radps),
        provenance=Provenance("course-npy", str(parts.path), (*facts, *parts.facts, EXTRINSIC_UNCERTAIN)),
    )


def _beside(path: Path) -> Path:
    return path.with_name(f"{path.stem}{_IMAGES_SUFFIX}{path.suffix}")


def _spooled(parts: _Parts, spool: ImageSpool, progress: Progress) -> tuple[tuple[StampedPair, ...], tuple[int, int]]:
    """Write the images of both cameras to the spool, and return the pairs and the size (width, height) px."""
    path, count = _beside(parts.path), parts.t_ns.size
    stored = read_dict(path)
    sides: list[list[np.ndarray]] = []
    for key in _IMAGES:
        images = stored.get(key)
        if not isinstance(images, list):
            raise DataError(f"{path}: {key} is missing or no list of images; it has {', '.join(stored) or 'nothing'}")
        if len(images) != count:
            raise DataError(f"{path}: {key} has {len(images)} images and {parts.path.name} {count} timestamps")
        for place, image in enumerate(images):
            is_image = isinstance(image, np.ndarray) and image.ndim == 2 and image.dtype == np.uint8
            if not is_image or 0 in image.shape:
                raise DataError(f"{path}: {key}[{place}] is no array (H, W) of uint8; save the images as grey ones")
        sides.append(images)
    pairs = []
    for place, (left, right) in enumerate(zip(*sides, strict=True)):
        names = (f"{side}/{place:06d}" for side in ("left", "right"))
        kept = [spool.add_grey(name, image) for name, image in zip(names, (left, right), strict=True)]
        pairs.append(StampedPair(int(parts.t_ns[place]), *kept))
        progress.advance(place + 1, count, "unpacking images")
    height, width = sides[0][0].shape
    return tuple(sorted(pairs, key=lambda pair: pair.t_ns)), (width, height)


def _pair(parts: _Parts, size_px: tuple[int, int]) -> RectifiedPair:
    """Return the cameras as a rectified pair; where they differ in K alone, the images are made alike."""
    left, right = (Camera(pinhole_of(K), "none", np.zeros(4), size_px) for K in parts.K)
    if np.array_equal(parts.K[0], parts.K[1]):
        return already_rectified(left.pinhole_px, parts.baseline_m, size_px)
    T_right_left = se3(np.eye(3), np.array([-parts.baseline_m, 0.0, 0.0]))
    return rectified(left, right, T_right_left, str(parts.path))
