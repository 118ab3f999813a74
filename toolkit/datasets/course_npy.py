"""Course recordings since 2025 (UC San Diego, ECE 276A): datasetNN.npy, a pickled dict, and datasetNN_imgs.npy.

The dict has ``v_t`` and ``w_t`` (T, 3), ``timestamps`` (T,) s, ``features`` (4, M, T) of uL vL uR vR with -1 where not
seen, ``K_l``, ``K_r``, ``extL_T_imu`` and ``extR_T_imu``. It is read, never unpickled
(:mod:`~toolkit.datasets.io.numpy_files`). Where there are no features, or images are asked for, the tracks are made of
``cam_imgs_L`` and ``cam_imgs_R``.

The extrinsics are called IMU to camera, and files are about that hold camera to IMU, in axes x forward, y left, z up.
A sequence has them as they are called; the audit decides (:mod:`toolkit.audit.conventions`).
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from toolkit.datasets.io.fields import (
    Fields,
    camera_matrix,
    check_frame_count,
    rectified_observations,
    stamps_ns,
)
from toolkit.datasets.io.image_pairs import seen_in
from toolkit.datasets.io.numpy_files import MAGIC, corners_of, read_dict, sparse_array
from toolkit.errors import DataError
from toolkit.files.reading import is_regular, open_input
from toolkit.frontend import (
    Camera,
    ImageRecording,
    RectifiedPair,
    StampedPair,
    already_rectified,
    rectified,
)
from toolkit.frontend.cache import ImageSpool
from toolkit.geometry import Array, IntArray, se3, se3_inverse, so3_log
from toolkit.measurements import StereoRig
from toolkit.models.noise import pixel_covariance, twist_noise
from toolkit.motion_samples import TwistSamples
from toolkit.progress import SILENT, Progress
from toolkit.sequence import EXTRINSIC_UNCERTAIN, NO_FEATURES, Observations, Provenance, Sequence
from toolkit.settings import Frontend, Tracks

_NOT_SEEN = -1.0
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
    if not isinstance(features, np.ndarray):
        nothing = np.empty(0, dtype=np.int64)
        return _sequence(parts, _rig(parts), Observations(nothing, nothing, np.empty((0, 3))), (NO_FEATURES,))
    return _sequence(parts, _rig(parts), *_sightings(parts, features))


def uses_images(path: Path, tracks: Tracks) -> bool:
    """Say whether the tracks are made of images: as asked for, or where there are images and no features."""
    if tracks == "simulated":
        raise DataError(f"{path}: tracks are simulated for EuRoC folders only; leave --tracks simulated out")
    return tracks == "images" or (is_regular(_beside(path)) and _FEATURES not in read_dict(path))


def images_of(path: Path, frontend: Frontend) -> ImageRecording:
    """Return the image pairs and their cameras; raises DataError where there are none or not one a stamp."""
    parts = _parts(path)
    spool = ImageSpool(str(_beside(path)))
    pairs, size_px = _spooled(parts, spool, SILENT)
    return ImageRecording(pairs, _pair(parts, size_px), spool)


def load_from_images(path: Path, frontend: Frontend, progress: Progress) -> Sequence:
    """Read a recording and make its tracks of the images beside it; raises DataError as :func:`images_of`."""
    parts = _parts(path)
    spool = ImageSpool(str(_beside(path)))
    try:
        pairs, size_px = _spooled(parts, spool, progress)
        pair = _pair(parts, size_px)
        T_imu_left = se3_inverse(parts.fields.rigid("extL_T_imu"))
        seen = seen_in(path, ImageRecording(pairs, pair, spool), T_imu_left, frontend, progress)
    finally:
        spool.close()
    return replace(_sequence(parts, seen.rig, seen.observations, seen.facts), frames_t_ns=seen.frames_t_ns)


@dataclass(frozen=True, eq=False)
class _Parts:
    """What a file holds, its calibration and its stamps (T,)."""

    path: Path
    stored: Mapping[str, Any]
    fields: Fields
    t_ns: IntArray


def _parts(path: Path) -> _Parts:
    stored = read_dict(path)
    if all(key in stored for key in _IMAGES) and "v_t" not in stored:
        raise DataError(f"{path}: the images of a recording alone; name the file beside it without {_IMAGES_SUFFIX}")
    arrays = {key: _array(value) for key, value in stored.items() if key in _REQUIRED}
    fields = Fields(path, {key: value for key, value in arrays.items() if value is not None})
    fields.require(*_REQUIRED)
    t_ns = stamps_ns(path, "timestamps", fields.vector("timestamps"))
    check_frame_count(path, t_ns.size)
    return _Parts(path, stored, fields, t_ns)


def _array(value: Any) -> Any:
    try:
        return np.asarray(value)
    except ValueError:  # a ragged list
        return None


def _sequence(parts: _Parts, rig: StereoRig, seen: Observations, facts: tuple[str, ...]) -> Sequence:
    fields, t_ns = parts.fields, parts.t_ns
    v_mps, w_radps = (fields.array(key, t_ns.size, 3) for key in ("v_t", "w_t"))
    return Sequence(
        name=parts.path.stem,
        rig=rig,
        noise=twist_noise(t_ns, v_mps, w_radps),
        frames_t_ns=t_ns,
        observations=seen,
        motion=TwistSamples(t_ns, v_mps, w_radps),
        provenance=Provenance("course-npy", str(parts.path), (*facts, *_turned(fields), EXTRINSIC_UNCERTAIN)),
    )


def _rig(parts: _Parts) -> StereoRig:
    left = camera_matrix(parts.path, "K_l", parts.fields.constant("K_l", 3, 3))
    T_imu_cam = se3_inverse(parts.fields.rigid("extL_T_imu"))
    return StereoRig(
        left[0, 0], left[1, 1], left[0, 2], left[1, 2], _baseline_m(parts.fields), T_imu_cam, pixel_covariance(2)
    )


def _baseline_m(fields: Fields) -> float:
    """Return how far apart the cameras are: the same number in whatever direction and axes the extrinsics are."""
    left, right = fields.rigid("extL_T_imu"), fields.rigid("extR_T_imu")
    turned_deg = _turned_deg(fields)
    if turned_deg > np.rad2deg(_MOST_TURNED_RAD):
        raise DataError(
            f"{fields.path}: extL_T_imu and extR_T_imu are turned by {turned_deg:.1f} deg, and a rectified pair is "
            "not; rectify the recording"
        )
    baseline_m = float(np.linalg.norm(left[:3, 3] - right[:3, 3]))
    if not baseline_m > 0.0:
        raise DataError(
            f"{fields.path}: extL_T_imu and extR_T_imu are the same, and so without a baseline; correct one"
        )
    return baseline_m


def _turned_deg(fields: Fields) -> float:
    left, right = fields.rigid("extL_T_imu"), fields.rigid("extR_T_imu")
    return float(np.rad2deg(np.linalg.norm(so3_log(left[:3, :3].T @ right[:3, :3]))))


def _turned(fields: Fields) -> Iterator[str]:
    turned_deg = _turned_deg(fields)
    if turned_deg > np.rad2deg(_TURNED_RAD):
        yield f"the extrinsics of the cameras differ by {turned_deg:.2f} deg; the pair is assumed to be rectified"


def _sightings(parts: _Parts, features: np.ndarray) -> tuple[Observations, tuple[str, ...]]:
    sparse = sparse_array(parts.path, _FEATURES, features, (4, None, parts.t_ns.size), _NOT_SEEN)
    frame, track, corners_px, facts = corners_of(sparse)
    return rectified_observations(parts.path, frame, track, _as_one_camera(parts, corners_px)), facts


def _as_one_camera(parts: _Parts, corners_px: Array) -> Array:
    """Return corners (N, 4) px with the right ones as the left camera would see them from there."""
    left, right = (camera_matrix(parts.path, key, parts.fields.constant(key, 3, 3)) for key in ("K_l", "K_r"))
    if np.array_equal(left, right):
        return corners_px
    scale, centres = np.diag(left)[:2] / np.diag(right)[:2], (left[:2, 2], right[:2, 2])
    return np.hstack([corners_px[:, :2], (corners_px[:, 2:] - centres[1]) * scale + centres[0]])


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
                raise DataError(
                    f"{path}: {key}[{place}] is no array (height, width) of uint8; save the images as grey ones"
                )
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
    matrices = [camera_matrix(parts.path, key, parts.fields.constant(key, 3, 3)) for key in ("K_l", "K_r")]
    left, right = (Camera((K[0, 0], K[1, 1], K[0, 2], K[1, 2]), "none", np.zeros(4), size_px) for K in matrices)
    baseline_m = _baseline_m(parts.fields)
    if np.array_equal(matrices[0], matrices[1]):
        return already_rectified(left.pinhole_px, baseline_m, size_px)
    T_right_left = se3(np.eye(3), np.array([-baseline_m, 0.0, 0.0]))
    return rectified(left, right, T_right_left, str(parts.path))
