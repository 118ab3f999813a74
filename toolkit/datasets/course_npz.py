"""Course recordings (UC San Diego, ECE 276A): npz with twists, stereo features 4 x M x T, and their calibration.

Two generations of key names are read: ``angular_velocity`` with ``imu_T_cam`` (camera -> IMU), and
``rotational_velocity`` with ``cam_T_imu`` (IMU -> camera). Faults of a file are kept for the audit to find.
"""

from pathlib import Path

import numpy as np

from toolkit.datasets.io.fields import (
    NO_SIGHTINGS,
    Fields,
    camera_matrix,
    check_frame_count,
    rectified_observations,
    stamps_ns,
)
from toolkit.datasets.io.numpy_files import NpzArchive, holds_arrays, opened
from toolkit.errors import DataError, nearest
from toolkit.geometry import Array, se3_inverse
from toolkit.measurements import StereoRig
from toolkit.models.noise import pixel_covariance, twist_noise
from toolkit.motion_samples import TwistSamples
from toolkit.sequence import NO_FEATURES, Observations, Provenance, Sequence

CITES = ("geiger2013kitti",)
# Two spellings of one quantity differ by the digits they were written with.
_ALIKE = 1e-4
_REQUIRED = ("time_stamps", "linear_velocity", "angular_velocity|rotational_velocity", "K", "b", "imu_T_cam|cam_T_imu")
_NAMES = {"features"}.union(*(keys.split("|") for keys in _REQUIRED))


def recognises(path: Path) -> bool:
    """Say whether the path is an npz with at least one of the format's keys."""
    return holds_arrays(path, _NAMES)


def load(path: Path) -> Sequence:
    """Read a recording; its features are streamed and never held dense.

    Raises DataError where the archive is damaged, or a key is missing or not of its shape.
    """
    with opened(path) as archive:
        fields = archive.fields("features")
        fields.require(*_REQUIRED)
        t_ns = stamps_ns(path, "time_stamps", fields.vector("time_stamps"))
        check_frame_count(path, t_ns.size)
        seen, facts = _sightings(path, archive, t_ns.size)
    rates = "angular_velocity" if "angular_velocity" in fields else "rotational_velocity"
    v_mps = fields.array("linear_velocity", 3, t_ns.size).T
    w_radps = fields.array(rates, 3, t_ns.size).T
    if "angular_velocity" in fields and "rotational_velocity" in fields:
        other = fields.array("rotational_velocity", 3, t_ns.size).T
        _check_alike(fields, "angular_velocity", w_radps, "rotational_velocity", other)
    return Sequence(
        name=path.stem,
        rig=_rig(fields),
        noise=twist_noise(t_ns, v_mps, w_radps),
        frames_t_ns=t_ns,
        observations=seen,
        motion=TwistSamples(t_ns, v_mps, w_radps),
        provenance=Provenance("course-npz", str(path), facts),
    )


def _rig(fields: Fields) -> StereoRig:
    K = camera_matrix(fields.path, "K", fields.constant("K", 3, 3))
    T_imu_cam = fields.rigid("imu_T_cam") if "imu_T_cam" in fields else se3_inverse(fields.rigid("cam_T_imu"))
    if "imu_T_cam" in fields and "cam_T_imu" in fields:
        _check_alike(fields, "imu_T_cam", T_imu_cam, "cam_T_imu", se3_inverse(fields.rigid("cam_T_imu")))
    return StereoRig(K[0, 0], K[1, 1], K[0, 2], K[1, 2], fields.positive("b"), T_imu_cam, pixel_covariance(2))


def _check_alike(fields: Fields, one: str, of_one: Array, other: str, of_other: Array) -> None:
    if not np.allclose(of_one, of_other, atol=_ALIKE, equal_nan=True):
        raise DataError(f"{fields.path}: it has both {one} and {other}, and they differ: delete the one that is wrong")


def _sightings(path: Path, archive: NpzArchive, frame_count: int) -> tuple[Observations, tuple[str, ...]]:
    if "features" not in archive.keys:
        # Without features it is a recording of odometry alone, and nobody may take theirs for that by an oversight.
        if close := nearest("features", set(archive.keys) - _NAMES):
            raise DataError(f"{path}: missing features (rename {close}?); without image features leave {close} out")
        return NO_SIGHTINGS, (NO_FEATURES,)
    frame, track, corners_px, facts = archive.corners("features", frame_count)
    return rectified_observations(path, frame, track, corners_px), facts
