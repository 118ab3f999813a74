"""A camera as calibration files state it, by Kalibr's names or EuRoC's, made one for the front end."""

import numpy as np

from toolkit.datasets.io.fields import Fields
from toolkit.errors import DataError
from toolkit.frontend.cameras import Camera, Distortion, Pinhole

_MODELS: dict[str, Distortion] = {
    "radial-tangential": "radtan",
    "radtan": "radtan",
    "plumb_bob": "radtan",
    "equidistant": "equidistant",
    "none": "none",
}
# Of radtan: k1 k2 p1 p2, and with five also k3.
_COUNTS: dict[Distortion, tuple[int, ...]] = {"radtan": (4, 5), "equidistant": (4,), "none": (0, 4, 5)}
_COEFFICIENTS = "distortion_coefficients|distortion_coeffs"


def camera_of(fields: Fields) -> Camera:
    """Return the camera of a sensor.yaml, or of one camera of a camchain (:func:`part`).

    Raises DataError where a field is missing or impossible, or the model is one that images are not rectified with.
    """
    fx, fy, cx, cy = pinhole_of(fields)
    width, height = fields.constant("resolution", 2).tolist()
    if not (fx > 0.0 and fy > 0.0 and 0.0 < cx < width and 0.0 < cy < height):
        raise DataError(
            f"{fields.path}: intrinsics {fx:g} {fy:g} {cx:g} {cy:g} are not of a {width:g}x{height:g} image"
        )
    distortion, coefficients = _distortion(fields)
    return Camera((fx, fy, cx, cy), distortion, coefficients, (int(width), int(height)))


def pinhole_of(fields: Fields) -> Pinhole:
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


def part(fields: Fields, name: str) -> Fields:
    """Return what a file says under a name, as ``cam0`` of a camchain; raises DataError where it says nothing."""
    inner = {key[len(name) + 1 :]: array for key, array in fields.arrays.items() if key.startswith(f"{name}.")}
    if not inner:
        raise DataError(f"{fields.path}: holds no {name}; it has {', '.join(sorted(fields.arrays)) or 'nothing'}")
    return Fields(fields.path, inner)


def _distortion(fields: Fields) -> tuple[Distortion, np.ndarray]:
    given = str(fields.arrays["distortion_model"]) if "distortion_model" in fields else "none"
    if given not in _MODELS:
        raise DataError(f"{fields.path}: distortion_model {given} is unknown; there are {', '.join(_MODELS)}")
    model = _MODELS[given]
    if model == "none":
        return model, np.zeros(4)
    fields.require(_COEFFICIENTS)
    key = fields.first_of(*_COEFFICIENTS.split("|"))
    coefficients = fields.vector(key)
    if coefficients.size not in _COUNTS[model] or not np.isfinite(coefficients).all():
        wanted = " or ".join(map(str, _COUNTS[model]))
        raise DataError(
            f"{fields.path}: {key} has {coefficients.size} values, expected {wanted} finite ones of {given}"
        )
    return model, coefficients
