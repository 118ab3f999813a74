"""Calibration of an ASL folder: its sensor.yaml files, Kalibr's camchain, or as published for all EuRoC recordings.

Where tracks are simulated camera 1 serves for the baseline only: that pair is rectified, with the left camera as it is
mounted. Real images are rectified with both cameras.

The stated white noise is that of the sensor at rest: in flight every recording's white densities are multiplied by the
same two numbers (docs/images.md). A simulated IMU errs as it states.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from toolkit.datasets.io.fields import Fields, read_fields, rigid
from toolkit.errors import DataError, printable
from toolkit.files.reading import is_regular, open_input
from toolkit.frontend.cameras import Camera, Distortion, Pinhole, check_beside
from toolkit.geometry import Array, se3_inverse
from toolkit.measurements import ImuNoise, StereoRig
from toolkit.models.noise import mems_imu
from toolkit.simulation.filming import is_simulated
from toolkit.simulation.scenarios import stereo_cov_px2

PIXEL_SIGMA_PX = 0.5
ACCEL_FACTOR, GYRO_FACTOR = 8.0, 3.0
_INFLATED = (
    f"white noise of the accelerometer and the gyro assumed to be {ACCEL_FACTOR:g} and {GYRO_FACTOR:g} times the "
    "stated one, as measured in flight against the truth"
)
AS_STATED = "the noise of the IMU is as its file states it"
_DENSITIES = {
    "accel_noise_density": "accelerometer_noise_density",
    "gyro_noise_density": "gyroscope_noise_density",
    "accel_random_walk": "accelerometer_random_walk",
    "gyro_random_walk": "gyroscope_random_walk",
}
# The sensor of all eleven recordings (Burri et al. 2016), to the digits of their sensor.yaml files.
_T_IMU_CAM0 = np.array(
    [
        [0.0148655429818, -0.999880929698, 0.00414029679422, -0.0216401454975],
        [0.999557249008, 0.0149672133247, 0.025715529948, -0.064676986768],
        [-0.0257744366974, 0.00375618835797, 0.999660727178, 0.00981073058949],
        [0.0, 0.0, 0.0, 1.0],
    ]
)
_CAM1_IN_IMU_M = np.array([-0.0198435579556, 0.0453689425024, 0.00786212447038])
_PINHOLE_PX = (458.654, 457.296, 367.215, 248.375)
_SIZE_PX = (752, 480)
_STATED_NOISE = ImuNoise(
    accel_noise_density=2e-3, gyro_noise_density=1.6968e-4, accel_random_walk=3e-3, gyro_random_walk=1.9393e-5
)
# Of plumb_bob (k1 k2 p1 p2, and with five also k3) and rational_polynomial OpenCV takes the coefficients as they stand.
_LENSES: dict[str, tuple[Distortion, tuple[int, ...]]] = {
    **dict.fromkeys(("radial-tangential", "radtan", "plumb_bob"), ("radtan", (4, 5))),
    "rational_polynomial": ("radtan", (8, 12, 14)),
    **dict.fromkeys(("equidistant", "fisheye", "kannala_brandt4"), ("equidistant", (4,))),
    "none": ("none", ()),
}
NO_NOISE = "no noise of the IMU is stated: that of a MEMS unit in motion is assumed (noise.motion_scale scales it)"
_SHIFT, _SAME_SHIFT_S = "timeshift_cam_imu", 1e-3
_USED = {
    *("T_BS", "T_cam_imu", "T_cn_cnm1", "camera_model", "distortion_model", "distortion_coefficients"),
    *("distortion_coeffs", "intrinsics", "resolution", _SHIFT, *_DENSITIES.values()),
}
_OF_NO_EFFECT = {"rostopic", "cam_overlaps", "comment", "sensor_type", "rate_hz", "update_rate", "model"}
# Whose calibration a file is that is not read, by names in it, and how much of it is looked at; files that are named.
_SYSTEMS = {
    "Basalt": (b'"T_imu_cam"', b'"value0"'),
    "VINS": (b"body_T_cam0", b"cam0_calib"),
    "ORB-SLAM3": (b"Camera1.fx", b"Camera.fx", b"ORBextractor"),
    "OpenVINS": (b"relative_config_imucam",),
}
_LOOKED_AT, _NAMED, _KINDS = 1 << 16, 3, ("*.yaml", "*.yml", "*.json")
_COEFFICIENTS = ("distortion_coefficients", "distortion_coeffs")


@dataclass(frozen=True, eq=False)
class AslCalibration:
    """The rig of simulated tracks, the image size, the IMU's noise, and where all this is from.

    ``cameras`` are those of real images, None where they are not known; ``T_right_left`` (4, 4) takes coordinates of
    the left one to the right one, ``T_imu_left`` to the IMU. ``shift_s`` is added to stamps of images, and ``shifted``
    says so; ``unused`` says which keys of the files are not used.
    """

    rig: StereoRig
    size_px: tuple[int, int]
    noise: ImuNoise
    source: str
    noise_source: str
    T_imu_left: Array
    T_right_left: Array
    cameras: tuple[Camera, Camera] | None = None
    shift_s: float = 0.0
    shifted: tuple[str, ...] = ()
    unused: tuple[str, ...] = ()


def published() -> AslCalibration:
    """Return the calibration that came with every recording of the set."""
    T_left_right = np.eye(4)
    T_left_right[:3, 3] = _T_IMU_CAM0[:3, :3].T @ (_CAM1_IN_IMU_M - _T_IMU_CAM0[:3, 3])
    return AslCalibration(
        _simulated_rig(_PINHOLE_PX, float(np.linalg.norm(_CAM1_IN_IMU_M - _T_IMU_CAM0[:3, 3])), _T_IMU_CAM0),
        _SIZE_PX,
        _in_flight(_STATED_NOISE),
        "the folder has no sensor.yaml: calibration as published with all EuRoC recordings",
        _INFLATED,
        _T_IMU_CAM0,
        se3_inverse(T_left_right),
    )


def read_calibration(root: Path, mav0: Path) -> AslCalibration:
    """Read Kalibr's camchain where there is one, else the sensor.yaml of both cameras and the IMU.

    Extrinsics are made relative to the IMU. Raises DataError where a file is missing, damaged or incomplete, or the
    right camera is not right of the left one.
    """
    chains = (path for folder in (root, mav0, root / "dso") for path in sorted(folder.glob("*camchain*.yaml")))
    camchain = next(chains, None)
    return _of_sensor_files(mav0, is_simulated(root)) if camchain is None else _of_kalibr(camchain, root, mav0)


def _of_sensor_files(mav0: Path, simulated: bool) -> AslCalibration:
    if (mav0 / "cam0").is_dir() and not (mav0 / "cam1").is_dir():
        raise DataError(f"{mav0 / 'cam1/sensor.yaml'}: cannot be read: there is cam0 and no cam1; stereo needs both")
    files = [mav0 / sensor / "sensor.yaml" for sensor in ("cam0", "cam1", "imu0")]
    lacking = [file for file in files if not is_regular(file)]
    if lacking:
        raise DataError(_no_calibration(mav0, lacking))
    left, right, imu = map(read_fields, files)
    left.require("T_BS.data", "intrinsics", "resolution")
    stated, unused = _stated_noise(imu)
    T_imu_left = se3_inverse(extrinsic(imu)) @ extrinsic(left)
    T_left_right = se3_inverse(extrinsic(left)) @ extrinsic(right)
    check_beside(se3_inverse(T_left_right), str(right.path), extrinsic(left) @ se3_inverse(extrinsic(right)))
    noise = (stated, AS_STATED) if simulated else (_in_flight(stated), _INFLATED)
    found = _calibration(left, right, (T_imu_left, T_left_right), noise, "the folder's sensor.yaml files")
    return replace(found, unused=(*_unused(left), *_unused(right), *unused))


def _no_calibration(mav0: Path, lacking: list[Path]) -> str:
    missing = ", ".join(str(file.relative_to(mav0)) for file in lacking)
    there = [file for folder in (mav0.parent, mav0) for kind in _KINDS for file in folder.glob(kind)]
    others = [f"{printable(file.name)}{_of_system(file)} is not read" for file in sorted(set(there))[:_NAMED]]
    return (
        f"{mav0}: missing {missing}, and there is no *camchain*.yaml of Kalibr's that states it{'; ' if others else ''}"
        f"{', '.join(others)}; write the calibration as docs/images.md describes"
    )


def _of_system(file: Path) -> str:
    with open_input(file) as opened:
        content = opened.read(_LOOKED_AT)
    return next((f" of {system}" for system, names in _SYSTEMS.items() if any(n in content for n in names)), "")


def _unused(sensor: Fields, name: str = "") -> Iterator[str]:
    """Yield a remark on keys of a sensor that state something which is not used: more than zeros or the identity."""
    known = _USED | _OF_NO_EFFECT
    others = {
        key.partition(".")[0]: array for key, array in sensor.arrays.items() if key.partition(".")[0] not in known
    }
    states = [key for key, array in others.items() if not _is_nothing(array)]
    if states:
        prefix = f"{name}." if name else ""
        where = sensor.path.name if name else f"{sensor.path.parent.name}/{sensor.path.name}"
        yield f"not used of {where}: {', '.join(prefix + printable(key) for key in states)}"


def _is_nothing(array: npt.NDArray[np.generic]) -> bool:
    if array.dtype.kind not in "fiu":
        return False
    return not array.any() or (array.ndim == 2 and np.array_equal(array, np.eye(len(array))))


def _shift(left: Fields, right: Fields) -> tuple[float, tuple[str, ...]]:
    """Return the time from the cameras' clock to the IMU's that Kalibr states, and what to know of it."""
    stated = [side.number(_SHIFT) for side in (left, right) if _SHIFT in side]
    shift_s, other_s = (stated[0], stated[-1]) if stated else (0.0, 0.0)
    remarks = []
    if shift_s:
        remarks.append(f"{1e3 * shift_s:+.3f} ms are added to the stamps of images: {_SHIFT} in {left.path.name}")
    if abs(other_s - shift_s) > _SAME_SHIFT_S:
        other = f"{1e3 * other_s:+.3f} ms"
        remarks.append(f"{left.path.name} states another {_SHIFT} for cam1, {other}; cam0's is that of both")
    return shift_s, tuple(remarks)


def _of_kalibr(camchain: Path, root: Path, mav0: Path) -> AslCalibration:
    """Read cam0 and cam1 of a camchain; the noise is that of Kalibr's IMU file, as it stands, or of sensor.yaml."""
    fields = read_fields(camchain)
    if not any(key.startswith("cam1.") for key in fields.arrays):
        raise DataError(f"{camchain}: holds one camera, and stereo needs two; calibrate cam0 and cam1 together")
    if "cam0.intrinsics" in fields and "cam0.T_cam_imu" not in fields:
        remedy = "take the camchain that Kalibr writes when it calibrates cameras and IMU"
        raise DataError(f"{camchain}: has no cam0.T_cam_imu, so it is of cameras alone; {remedy}")
    fields.require("cam0.T_cam_imu", "cam1.T_cam_imu|cam1.T_cn_cnm1")
    left, right = (_part(fields, name) for name in ("cam0", "cam1"))
    T_imu_left = se3_inverse(left.rigid("T_cam_imu"))
    mounted = "T_cam_imu" in right
    T_right_left = right.rigid("T_cam_imu") @ T_imu_left if mounted else right.rigid("T_cn_cnm1")
    sensor = mav0 / "imu0/sensor.yaml"
    stated = kalibr_noise(camchain.parent, root, mav0) or (is_regular(sensor) and _stated_noise(read_fields(sensor)))
    noise, unused = stated or (mems_imu(), ())
    T_left_right = se3_inverse(T_right_left)
    check_beside(T_right_left, str(camchain))
    how = (noise, AS_STATED if stated else NO_NOISE)
    found = _calibration(left, right, (T_imu_left, T_left_right), how, str(camchain.relative_to(root)))
    return replace(found, unused=(*_unused(left, "cam0"), *_unused(right, "cam1"), *unused))


def kalibr_noise(*folders: Path) -> tuple[ImuNoise, tuple[str, ...]] | None:
    """Return the noise that Kalibr's IMU file in one of some folders states, and remarks; None where there is none.

    Raises DataError where it is damaged or incomplete.
    """
    file = next((path for folder in folders for path in sorted(folder.glob("imu*.yaml"))), None)
    return None if file is None else _stated_noise(read_fields(file))


def _stated_noise(fields: Fields) -> tuple[ImuNoise, tuple[str, ...]]:
    """Return the densities that a file states, at its top or under imu0, and remarks on what it states besides."""
    name = "imu0" if any(key.startswith("imu0.") for key in fields.arrays) else ""
    imu = _part(fields, name) if name else fields
    imu.require(*_DENSITIES.values())
    return ImuNoise(**{ours: imu.positive(theirs) for ours, theirs in _DENSITIES.items()}), tuple(_unused(imu, name))


def _calibration(
    left: Fields, right: Fields, mounted: tuple[Array, Array], noise: tuple[ImuNoise, str], source: str
) -> AslCalibration:
    """Return what files say of both cameras; ``mounted`` is T_imu_left and T_left_right, ``noise`` has its source."""
    T_imu_left, T_left_right = mounted
    width_px, height_px = left.constant("resolution", 2)
    rig = _simulated_rig(_pinhole_of(left), float(np.linalg.norm(T_left_right[:3, 3])), T_imu_left)
    whole = all("distortion_model" in side and "intrinsics" in side for side in (left, right))
    cameras = (_camera_of(left), _camera_of(right)) if whole else None
    shift_s, shifted = _shift(left, right)
    return AslCalibration(
        *(rig, (int(width_px), int(height_px)), noise[0], f"calibration from {source}", noise[1]),
        T_imu_left=T_imu_left,
        T_right_left=se3_inverse(T_left_right),
        cameras=cameras,
        shift_s=shift_s,
        shifted=shifted,
    )


def _simulated_rig(pinhole_px: Pinhole, baseline_m: float, T_imu_left: Array) -> StereoRig:
    return StereoRig(*pinhole_px, baseline_m, T_imu_left, stereo_cov_px2(PIXEL_SIGMA_PX))


def extrinsic(sensor: Fields) -> Array:
    """Return T_body_sensor (4, 4) of a sensor.yaml."""
    sensor.require("T_BS.data")
    return rigid(sensor.path, "T_BS", sensor.constant("T_BS.data", 16).reshape(4, 4))


def _in_flight(stated: ImuNoise) -> ImuNoise:
    """Return what the densities stated for a sensor at rest become in flight (measured, see the module)."""
    return replace(
        stated,
        accel_noise_density=ACCEL_FACTOR * stated.accel_noise_density,
        gyro_noise_density=GYRO_FACTOR * stated.gyro_noise_density,
    )


def _camera_of(fields: Fields) -> Camera:
    """Return the camera of a sensor.yaml, or of one camera of a camchain (:func:`_part`)."""
    fx, fy, cx, cy = _pinhole_of(fields)
    width, height = fields.constant("resolution", 2).tolist()
    if not (fx > 0.0 and fy > 0.0 and 0.0 < cx < width and 0.0 < cy < height):
        raise DataError(f"{fields.path}: intrinsics {fx:g} {fy:g} {cx:g} {cy:g} are not of {width:g}x{height:g} px")
    name = str(fields.arrays["distortion_model"])
    given = next((key for key in _COEFFICIENTS if key in fields), None)
    if given is None and name != "none" and name in _LENSES:
        fields.require("|".join(_COEFFICIENTS))
    coefficients = np.zeros(0) if given is None else fields.vector(given)
    return Camera(
        (fx, fy, cx, cy), *lens_of(str(fields.path), name, coefficients, given or ""), (int(width), int(height))
    )


def _pinhole_of(fields: Fields) -> Pinhole:
    """Return (fx, fy, cx, cy) px of a camera; raises DataError where they are missing or of another model."""
    fields.require("intrinsics", "resolution")
    model = str(fields.arrays["camera_model"]) if "camera_model" in fields else "pinhole"
    if model != "pinhole":
        raise DataError(f"{fields.path}: camera_model {model}; images are rectified of pinhole cameras only")
    given = fields.vector("intrinsics")
    if given.size != 4 or not np.isfinite(given).all():
        raise DataError(f"{fields.path}: intrinsics has {given.size} values, expected four finite ones, fx, fy, cx, cy")
    fx, fy, cx, cy = given.tolist()
    return fx, fy, cx, cy


def _part(fields: Fields, name: str) -> Fields:
    """Return what a file says under a name, as ``cam0`` of a camchain; raises DataError where it says nothing."""
    inner = {key[len(name) + 1 :]: array for key, array in fields.arrays.items() if key.startswith(f"{name}.")}
    if not inner:
        raise DataError(f"{fields.path}: holds no {name}; it has {', '.join(sorted(fields.arrays)) or 'nothing'}")
    return Fields(fields.path, inner)


def lens_of(what: str, name: str, coefficients: Array, key: str = "distortion") -> tuple[Distortion, Array]:
    """Return the model of a lens, by any name it has, and its coefficients; raises DataError where they do not fit."""
    if name not in _LENSES:
        raise DataError(f"{what}: distortion_model {printable(name)[:50]} is unknown; there are {', '.join(_LENSES)}")
    model, counts = _LENSES[name]
    if model == "none":
        return model, np.zeros(4)
    # Some programs fill up with zeros.
    count = next((n for n in counts if np.trim_zeros(coefficients, "b").size <= n <= coefficients.size), None)
    if count is None or not np.isfinite(coefficients).all():
        wanted = " or ".join(map(str, counts))
        raise DataError(f"{what}: {key} has {coefficients.size} values, expected {wanted} finite ones of {name}")
    return model, coefficients[:count]
