"""UTIAS recordings (Matlab): KITTI drives tracked by KLT, and "Starry Night" with motion capture.

Published with Clement, Peretroukhin, Lambert & Kelly, "The Battle for Filter Supremacy: A Comparative Study of the
Multi-State Constraint Kalman Filter and the Sliding Window Filter" (CRV 2015). C_c_v takes the vehicle frame to
the camera's, rho_v_c_v is the camera's position in the vehicle frame, and the rotation vector theta takes the
vehicle frame to the world, C_vi = R(theta)^T; with these the truth reprojects the next frame to a median of
0.3-0.8 px (1.9 px indoors), and with any of the alternatives to more.
"""

import io
import warnings
from pathlib import Path

import numpy as np
import numpy.typing as npt

from toolkit.datasets.io.fields import Fields, check_frame_count, rectified_observations, rigid, stamps_ns
from toolkit.errors import DataError
from toolkit.files.reading import is_regular, open_input, read_input
from toolkit.geometry import Array, IntArray, se3, so3_exp
from toolkit.measurements import NS_PER_S, StereoRig, TwistNoise
from toolkit.models.noise import GYRO_RANDOM_WALK, pixel_covariance, twist_noise, white_sigma
from toolkit.motion_samples import TwistSamples
from toolkit.sequence import Observations, Provenance, Sequence, Truth

CITES = ("clement2015battle", "geiger2013kitti")
_NOT_SEEN = -1.0
_REQUIRED = (
    *("y_k_j", "v_vk_vk_i", "w_vk_vk_i", "t", "r_i_vk_i", "theta_vk_i"),
    *("C_c_v", "rho_v_c_v", "fu", "fv", "cu", "cv", "b"),
)
_MEASURED_VARIANCES = ("v_var", "w_var", "y_var")
_INS_FACTS = ("truth and twists come from the same INS: add noise to the twists for a meaningful comparison",)
_MOTION_CAPTURE_FACTS = (
    "truth is motion capture, independent of the twists; noise variances were measured against it",
    "a track is one of a few landmarks that return after they were lost",
)


def recognises(path: Path) -> bool:
    if not is_regular(path):
        return False
    with open_input(path) as stream:
        return stream.read(6) == b"MATLAB"


def load(path: Path) -> Sequence:
    """Read a recording with its truth; where twists go on after the last frame they are cut there.

    A twist stands for the interval after its stamp: paired so, the twist errors of the indoor recording have exactly
    the variances it states. Raises DataError where the file is damaged, or a key is missing or not of its shape.
    """
    fields = Fields(path, _read_matlab(path))
    fields.require(*_REQUIRED)
    t_ns = stamps_ns(path, "t", fields.vector("t"))
    check_frame_count(path, t_ns.size)
    measured = all(key in fields for key in _MEASURED_VARIANCES)
    v_mps, w_radps = _rows(fields, "v_vk_vk_i", t_ns.size), _rows(fields, "w_vk_vk_i", t_ns.size)
    return Sequence(
        name=path.stem,
        rig=_rig(fields, _measured_pixels(fields) if measured else pixel_covariance(2)),
        noise=_measured_noise(fields, t_ns, v_mps, w_radps) if measured else twist_noise(t_ns, v_mps, w_radps),
        frames_t_ns=t_ns,
        observations=_sightings(fields, t_ns.size),
        motion=TwistSamples(t_ns, v_mps, w_radps, pairing="start"),
        provenance=Provenance("utias-mat", str(path), _MOTION_CAPTURE_FACTS if measured else _INS_FACTS),
        truth=_truth(fields, t_ns, independent=measured),
    )


def _read_matlab(path: Path) -> dict[str, npt.NDArray[np.generic]]:
    import scipy.io

    content = io.BytesIO(read_input(path))
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # damaged bytes are refused by the checks of the fields
            variables = scipy.io.loadmat(content)  # type: ignore[arg-type]  # a file object is allowed
    except NotImplementedError as error:
        raise DataError(f"{path}: Matlab 7.3 files are not read; save it with -v7") from error
    except Exception as error:  # scipy's reader meets damaged bytes with errors of many kinds
        raise DataError(f"{path}: not a whole Matlab file ({type(error).__name__}); copy or save it again") from error
    return {key: value for key, value in variables.items() if isinstance(value, np.ndarray)}


def _rows(fields: Fields, key: str, frame_count: int) -> Array:
    """Return the first rows (frame_count, 3) of an array stored as (3, at least frame_count)."""
    columns = fields.array(key, 3, None)
    if columns.shape[1] < frame_count:
        raise DataError(f"{fields.path}: {key} has {columns.shape[1]} columns for {frame_count} stamps in t")
    return columns[:, :frame_count].T


def _rig(fields: Fields, cov_uv_px2: Array) -> StereoRig:
    R_imu_cam = fields.constant("C_c_v", 3, 3).T
    T_imu_cam = rigid(fields.path, "C_c_v", se3(R_imu_cam, fields.constant("rho_v_c_v", 3, 1)[:, 0]))
    fu, fv, b = (fields.positive(key) for key in ("fu", "fv", "b"))
    return StereoRig(fu, fv, fields.number("cu"), fields.number("cv"), b, T_imu_cam, cov_uv_px2)


def _truth(fields: Fields, t_ns: IntArray, independent: bool) -> Truth:
    theta, position = (_rows(fields, key, t_ns.size) for key in ("theta_vk_i", "r_i_vk_i"))
    if not np.isfinite([theta, position]).all():
        raise DataError(f"{fields.path}: theta_vk_i or r_i_vk_i is not finite; cut the recording to its truth")
    return Truth(t_ns, se3(so3_exp(theta), position), independent=independent)


def _sightings(fields: Fields, frame_count: int) -> Observations:
    features = fields.array("y_k_j", 4, frame_count, None)
    frame, track_id = np.nonzero((features != _NOT_SEEN).any(axis=0))
    corners_px = features[:, frame, track_id].T
    corners_px = np.where(corners_px == _NOT_SEEN, np.nan, corners_px)
    return rectified_observations(fields.path, frame, track_id, corners_px)


def _measured_noise(fields: Fields, t_ns: IntArray, v_mps: Array, w_radps: Array) -> TwistNoise:
    """Return densities of twists of measured variance, each held over one median step: sigma sqrt(dt).

    Where the samples scatter more than the file states, because noise was added to them, their scatter is used.
    """
    root_dt = np.sqrt(np.median(np.diff(t_ns)) / NS_PER_S)
    v_sigma = np.maximum(np.sqrt(fields.constant("v_var", 3, 1)[:, 0]), white_sigma(v_mps))
    w_sigma = np.maximum(np.sqrt(fields.constant("w_var", 3, 1)[:, 0]), white_sigma(w_radps))
    return TwistNoise(v_sigma * root_dt, w_sigma * root_dt, np.full(3, GYRO_RANDOM_WALK))


def _measured_pixels(fields: Fields) -> Array:
    """Return the covariance (3, 3) px^2 from the variances of uL, vL, uR, vR measured on known landmarks.

    The errors of vL and vR there are common to both (calibration, not tracking): measured on the 20 known
    landmarks the variance of their mean is that of each, so here it is not halved.
    """
    u_left, v_left, u_right, v_right = fields.constant("y_var", 4, 1)[:, 0]
    return np.diag([u_left, u_right, 0.5 * (v_left + v_right)])
