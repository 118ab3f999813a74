"""Two calibrated cameras made one rectified pair: maps that undistort and rectify images, and the pair's calibration.

After rectification both image planes are parallel to the baseline, so that a point has the same row in both images.
Models of distortion: radial-tangential (Brown 1966) and equidistant (Kannala & Brandt 2006), as Kalibr and OpenCV
have them.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from toolkit.errors import DataError
from toolkit.geometry import Array, BoolArray, se3_inverse, so3_angle
from toolkit.measurements import StereoRig

Image = npt.NDArray[np.uint8]
Pinhole = tuple[float, float, float, float]
Distortion = Literal["none", "radtan", "equidistant"]
# A rectified pair sees nearly what its cameras see; cameras that look apart by more are no stereo pair.
_MOST_TURNED_RAD = 0.5
# No two cameras are so near each other.
_SAME_PLACE_M = 1e-6
# Bilinear interpolation at the border of what a camera sees mixes in what it does not see.
_BORDER_PX = 3


@dataclass(frozen=True, eq=False)
class Camera:
    """A camera: (fx, fy, cx, cy) px, the model and coefficients (n,) of its distortion, and (width, height) px."""

    pinhole_px: Pinhole
    distortion: Distortion
    coefficients: Array
    size_px: tuple[int, int]

    @property
    def K(self) -> Array:
        fx, fy, cx, cy = self.pinhole_px
        return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


@dataclass(frozen=True, eq=False)
class Maps:
    """Where each pixel of a rectified image is in the camera's, as cv2.remap takes it, and whether it is seen."""

    columns: npt.NDArray[np.int16]
    rows: npt.NDArray[np.uint16]
    seen: BoolArray


@dataclass(frozen=True, eq=False)
class RectifiedPair:
    """The calibration of rectified images, and the maps of both cameras; no maps where images come rectified.

    ``R_rect_cam`` (3, 3) turns left-camera coordinates into the rectified camera's. ``raw_size_px`` is the size that
    images must have, ``size_px`` what they have once rectified.
    """

    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float
    baseline_m: float
    raw_size_px: tuple[int, int]
    size_px: tuple[int, int]
    R_rect_cam: Array
    maps: tuple[Maps, Maps] | None = None

    @property
    def stereo_rig(self) -> StereoRig:
        """Return it as a rig in the camera's own axes; the noise of a place is a pixel, of v, a mean, half of that."""
        pinhole_px = (self.fx_px, self.fy_px, self.cx_px, self.cy_px)
        return StereoRig(*pinhole_px, self.baseline_m, np.eye(4), np.diag([1.0, 1.0, 0.5]))

    def apply(self, image: Image, side: int) -> Image:
        if self.maps is None:
            return image
        import cv2

        maps = self.maps[side]
        return np.asarray(cv2.remap(image, maps.columns, maps.rows, cv2.INTER_LINEAR), dtype=np.uint8)

    def seen(self, side: int) -> BoolArray:
        """Return which pixels (height, width) of a rectified image the camera sees."""
        width, height = self.size_px
        if self.maps is None:
            seen = np.zeros((height, width), dtype=bool)
            seen[_BORDER_PX:-_BORDER_PX, _BORDER_PX:-_BORDER_PX] = True
            return seen
        return self.maps[side].seen


def already_rectified(pinhole_px: Pinhole, baseline_m: float, size: tuple[int, int]) -> RectifiedPair:
    """Return the pair of images that come rectified: they pass through as they are."""
    return RectifiedPair(*pinhole_px, baseline_m, raw_size_px=size, size_px=size, R_rect_cam=np.eye(3))


def rectified(left: Camera, right: Camera, T_right_left: Array, where: str) -> RectifiedPair:
    """Rectify two cameras; ``T_right_left`` (4, 4) takes left-camera coordinates to the right camera's.

    Both are turned by half of what they differ by, then together until the baseline is their x-axis (Bouguet, as
    cv2.stereoRectify). Raises DataError where they are no stereo pair, naming ``where`` the calibration is written.
    """
    import cv2

    _check_pair(left, right, T_right_left, where)
    # OpenCV wants contiguous arrays, and the translation as a column.
    turn, shift = np.ascontiguousarray(T_right_left[:3, :3]), np.ascontiguousarray(T_right_left[:3, 3:4])
    coefficients = [c.coefficients if c.distortion == "radtan" else np.zeros(4) for c in (left, right)]
    R_rect_left, R_rect_right, projection_left, projection_right, *_ = cv2.stereoRectify(
        left.K, coefficients[0], right.K, coefficients[1], left.size_px, turn, shift, alpha=0
    )
    baseline_m = -float(projection_right[0, 3] / projection_right[0, 0])
    K = np.array(projection_left[:, :3], dtype=np.float64)
    if "equidistant" in (left.distortion, right.distortion):
        # A pinhole with the resolution that wide-angle cameras have in the middle of their view.
        (width, height), focal_px = left.size_px, float(np.mean([left.pinhole_px[:2], right.pinhole_px[:2]]))
        K = np.array([[focal_px, 0.0, 0.5 * (width - 1)], [0.0, focal_px, 0.5 * (height - 1)], [0.0, 0.0, 1.0]])
    maps = (_maps(left, np.asarray(R_rect_left), K), _maps(right, np.asarray(R_rect_right), K))
    fx, fy, cx, cy = (float(x) for x in (K[0, 0], K[1, 1], K[0, 2], K[1, 2]))
    return RectifiedPair(fx, fy, cx, cy, baseline_m, left.size_px, left.size_px, np.array(R_rect_left), maps)


def _check_pair(left: Camera, right: Camera, T_right_left: Array, where: str) -> None:
    if left.size_px != right.size_px:
        sizes = " and ".join(f"{width}x{height}" for width, height in (left.size_px, right.size_px))
        raise DataError(f"{where}: the cameras have images of {sizes} px, and a pair needs one size; record both alike")
    turned = float(so3_angle(T_right_left[:3, :3]))
    if turned > _MOST_TURNED_RAD:
        raise DataError(
            f"{where}: the cameras look {np.rad2deg(turned):.0f} deg apart, and a stereo pair looks the same way; "
            "correct the extrinsics, or name two cameras that are a pair"
        )
    check_beside(T_right_left, where)


def check_beside(T_right_left: Array, where: str, if_inverted: Array | None = None) -> None:
    """Raise DataError unless the right camera stands to the right of the left one, as for :func:`rectified`.

    ``if_inverted`` (4, 4) is where it would be if the pose of each were the inverse of what it is called.
    """
    x, y, z = se3_inverse(T_right_left)[:3, 3] + 0.0  # and no -0
    aside = max(abs(y), abs(z))
    if max(abs(x), aside) < _SAME_PLACE_M:
        raise DataError(
            f"{where}: both cameras stand in the same place, so there is no baseline; correct the extrinsics, or "
            "name two cameras"
        )
    if x >= aside:
        return
    side, remedy = ("left" if -x > aside else "above, below or behind"), "exchange them, or correct the extrinsics"
    if -x <= aside and if_inverted is not None and if_inverted[0, 3] > np.abs(if_inverted[1:3, 3]).max():
        remedy = "each T_BS looks like the inverse of one: invert both"
    raise DataError(f"{where}: the right camera stands {side} of the left one, at {x:.3g} {y:.3g} {z:.3g} m; {remedy}")


def _maps(camera: Camera, R_rect_cam: Array, K: Array) -> Maps:
    import cv2

    make = cv2.fisheye.initUndistortRectifyMap if camera.distortion == "equidistant" else cv2.initUndistortRectifyMap
    u, v = make(camera.K, camera.coefficients, R_rect_cam, K, camera.size_px, cv2.CV_32FC1)
    columns, rows = cv2.convertMaps(u, v, cv2.CV_16SC2)
    width, height = camera.size_px
    inside = (u > 0.0) & (u < width - 1.0) & (v > 0.0) & (v < height - 1.0)
    size = 2 * _BORDER_PX + 1
    seen = cv2.erode(inside.astype(np.uint8), np.ones((size, size), np.uint8), borderValue=0)
    return Maps(np.asarray(columns), np.asarray(rows), np.asarray(seen > 0))
