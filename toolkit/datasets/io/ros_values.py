"""What ROS messages hold as values: stamps, grey images, cameras, poses, and the tree of fixed transforms.

Sources: the definitions of sensor_msgs, geometry_msgs and nav_msgs; REP 103 (camera axes), REP 105 (frames).
"""

from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from toolkit.datasets.io.fields import camera_matrix
from toolkit.errors import DataError, printable
from toolkit.frontend import Camera, Pinhole
from toolkit.frontend.cameras import Distortion
from toolkit.geometry import Array, rotation_from_quaternion, se3, se3_inverse
from toolkit.measurements import NS_PER_S

# Of the planar encodings the first plane is the brightness.
_GREY = {
    "mono8": np.uint8,
    "8UC1": np.uint8,
    "mono16": np.uint16,
    "16UC1": np.uint16,
    "nv12": np.uint8,
    "nv21": np.uint8,
    "nv24": np.uint8,
    "i420": np.uint8,
}
# Channels, and OpenCV's conversion. Names that end in 16 are of 16 bits.
_COLOURS = {
    "rgb8": (3, "COLOR_RGB2GRAY"),
    "bgr8": (3, "COLOR_BGR2GRAY"),
    "8UC3": (3, "COLOR_BGR2GRAY"),
    "rgba8": (4, "COLOR_RGBA2GRAY"),
    "bgra8": (4, "COLOR_BGRA2GRAY"),
    # OpenCV names a pattern by its second row, ROS by its first.
    "bayer_rggb8": (1, "COLOR_BayerBG2GRAY"),
    "bayer_bggr8": (1, "COLOR_BayerRG2GRAY"),
    "bayer_gbrg8": (1, "COLOR_BayerGR2GRAY"),
    "bayer_grbg8": (1, "COLOR_BayerGB2GRAY"),
    "yuv422": (2, "COLOR_YUV2GRAY_UYVY"),
    "yuv422_yuy2": (2, "COLOR_YUV2GRAY_YUY2"),
    "uyvy": (2, "COLOR_YUV2GRAY_UYVY"),
    "yuyv": (2, "COLOR_YUV2GRAY_YUY2"),
}
_COLOURS |= {
    f"{name.removesuffix('8')}16": what for name, what in _COLOURS.items() if name.startswith(("rgb", "bgr", "bayer"))
}
_PNG, _JPEG = b"\x89PNG", b"\xff\xd8"
# Of plumb_bob and rational_polynomial OpenCV takes the coefficients as they stand.
_MODELS: dict[str, tuple[Distortion, tuple[int, ...]]] = {
    "plumb_bob": ("radtan", (4, 5)),
    "radtan": ("radtan", (4, 5)),
    "rational_polynomial": ("radtan", (8, 12, 14)),
    "equidistant": ("equidistant", (4,)),
    "fisheye": ("equidistant", (4,)),
    "kannala_brandt4": ("equidistant", (4,)),
    "none": ("none", (0, 4, 5)),
}

Grey = npt.NDArray[np.uint8] | npt.NDArray[np.uint16]


def stamp_ns(header: Any, recorded_ns: int) -> int:
    """Return the stamp of a header; where it has none, when the message was recorded."""
    return int(header.stamp.sec) * NS_PER_S + int(header.stamp.nanosec) if is_stamped(header) else recorded_ns


def is_stamped(header: Any) -> bool:
    """Say whether a header has a stamp."""
    return bool(header.stamp.sec or header.stamp.nanosec)


def grey(message: Any, what: str) -> Grey:
    """Return the grey values (height, width) of an Image; raises DataError where its encoding or size cannot be."""
    encoding, height, width = str(message.encoding), int(message.height), int(message.width)
    if encoding in _GREY:
        return _rows(message, what, height, width, 1, np.dtype(_GREY[encoding]))[..., 0]
    if encoding not in _COLOURS:
        known = ", ".join((*_GREY, *_COLOURS))
        raise DataError(f"{what}: images are encoded as {printable(encoding)[:50] or 'nothing'}; there are {known}")
    import cv2

    channels, conversion = _COLOURS[encoding]
    dtype = np.dtype(np.uint16 if encoding.endswith("16") else np.uint8)
    raw = np.ascontiguousarray(_rows(message, what, height, width, channels, dtype), dtype=dtype)
    return np.asarray(cv2.cvtColor(raw, getattr(cv2, conversion)), dtype=dtype)


def _rows(message: Any, what: str, height: int, width: int, channels: int, dtype: np.dtype[Any]) -> npt.NDArray[Any]:
    """Return pixels (height, width, channels) of an image whose rows may be longer than they."""
    step, row = int(message.step), width * channels * dtype.itemsize
    data = np.asarray(message.data, dtype=np.uint8)
    if not (height > 0 and width > 0 and step >= row and data.size >= height * step):
        raise DataError(
            f"{what}: an image of {width}x{height} px has {data.size} bytes in rows of {step}; it is cut off"
        )
    pixels = np.ascontiguousarray(data[: height * step].reshape(height, step)[:, :row])
    return pixels.view(dtype.newbyteorder(">" if message.is_bigendian else "<")).reshape(height, width, channels)


def image_file(message: Any, what: str) -> tuple[str, bytes]:
    """Return the ending and the content of the file that a CompressedImage is; raises DataError where it is none.

    One without content is returned as it is: the front end names it, and leaves it out where others are sound.
    """
    content = bytes(message.data)
    if content.startswith(_PNG) or not content:
        return ".png", content
    if content.startswith(_JPEG):
        return ".jpg", content
    raise DataError(
        f"{what}: compressed images are {printable(str(message.format))[:50]}, expected PNG or JPEG; republish them as "
        "one of these, or as raw images"
    )


def camera(info: Any, what: str) -> Camera:
    """Return the camera of a CameraInfo; raises DataError where it is not calibrated or its lens is not known."""
    K = camera_matrix_of(info, what)
    name, coefficients = str(info.distortion_model) or "none", np.asarray(_field(info, "D"), dtype=np.float64)
    if name not in _MODELS:
        raise DataError(f"{what}: distortion_model {printable(name)[:50]} is unknown; there are {', '.join(_MODELS)}")
    model, counts = _MODELS[name]
    # Some programs fill up with zeros.
    count = next((n for n in counts if np.trim_zeros(coefficients, "b").size <= n <= coefficients.size), None)
    if not coefficients.any():
        model, coefficients = "none", np.zeros(4)
    elif count is None or not np.isfinite(coefficients).all():
        wanted = " or ".join(map(str, counts))
        raise DataError(f"{what}: {coefficients.size} distortion coefficients, expected {wanted} of {name}")
    size_px = (int(info.width), int(info.height))
    return Camera((K[0, 0], K[1, 1], K[0, 2], K[1, 2]), model, coefficients[:count], size_px)


def camera_matrix_of(info: Any, what: str) -> Array:
    """Return K (3, 3) of a CameraInfo."""
    K = np.asarray(_field(info, "K"), dtype=np.float64).reshape(3, 3)
    if not (K.any() and np.isfinite(K).all() and info.width and info.height):
        raise DataError(
            f"{what}: is not calibrated (K is zero or the size is missing); put a calibration beside the bag"
        )
    return camera_matrix(Path(what), "K", K)


@dataclass(frozen=True, eq=False)
class Rectification:
    """What a CameraInfo says of rectified images: R_rect_cam (3, 3), fx, fy, cx, cy, and how far right the camera is.

    That is from the origin of the rectified axes: 0 for most left cameras, and where nothing is stated.
    """

    R_rect_cam: Array
    pinhole_px: Pinhole
    right_m: float


def rectification(info: Any) -> Rectification:
    """Return how the images of a CameraInfo are rectified."""
    P = np.asarray(_field(info, "P"), dtype=np.float64).reshape(3, 4)
    right_m = -float(P[0, 3] / P[0, 0]) if P[0, 0] > 0.0 else 0.0
    pinhole_px = (float(P[0, 0]), float(P[1, 1]), float(P[0, 2]), float(P[1, 2]))
    R_rect_cam = np.asarray(_field(info, "R"), dtype=np.float64).reshape(3, 3)
    return Rectification(R_rect_cam if R_rect_cam.any() else np.eye(3), pinhole_px, right_m)


def _field(info: Any, name: str) -> Any:
    """Return a field of a CameraInfo, which ROS 1 writes large and ROS 2 small."""
    return getattr(info, name) if hasattr(info, name) else getattr(info, name.lower())


def pose_of(value: Any) -> tuple[list[float], str]:
    """Return x y z qx qy qz qw of an Odometry, Pose(WithCovariance)Stamped or TransformStamped, and whose frame."""
    if hasattr(value, "transform"):
        at, turn, child = value.transform.translation, value.transform.rotation, str(value.child_frame_id)
    else:
        pose = getattr(value.pose, "pose", value.pose)
        at, turn, child = pose.position, pose.orientation, str(getattr(value, "child_frame_id", ""))
    return [at.x, at.y, at.z, turn.x, turn.y, turn.z, turn.w], frame_name(child)


def frame_name(name: Any) -> str:
    """Return the name of a frame without the slash that ROS 1 may write before it."""
    return str(name).lstrip("/")


def fixed(transforms: Iterable[Any]) -> list[Any]:
    """Return those of many transforms that never change, each once."""
    first: dict[tuple[str, str], Any] = {}
    moved: set[tuple[str, str]] = set()
    for transform in transforms:
        edge = (frame_name(transform.header.frame_id), frame_name(transform.child_frame_id))
        if pose_of(first.setdefault(edge, transform)) != pose_of(transform):
            moved.add(edge)
    return [transform for edge, transform in first.items() if edge not in moved]


class Tree:
    """The fixed transforms of a robot."""

    def __init__(self, transforms: Iterable[Any]) -> None:
        self._next: dict[str, dict[str, Array]] = {}
        for transform in transforms:
            values, child = pose_of(transform)
            parent = frame_name(transform.header.frame_id)
            quaternion = np.array(values[3:])
            if not np.isclose(np.linalg.norm(quaternion), 1.0, atol=1e-2):
                continue  # no rotation, as an unset message
            T_parent_child = se3(rotation_from_quaternion(quaternion), np.array(values[:3]))
            self._next.setdefault(parent, {})[child] = T_parent_child
            self._next.setdefault(child, {})[parent] = se3_inverse(T_parent_child)

    def between(self, a: str, b: str) -> Array | None:
        """Return T_a_b (4, 4); None where nothing connects the two."""
        reached, waiting = {a: np.eye(4)}, deque([a])
        while waiting:
            at = waiting.popleft()
            for near, T_at_near in self._next.get(at, {}).items():
                if near not in reached:
                    reached[near] = reached[at] @ T_at_near
                    waiting.append(near)
        return reached.get(b) if a and b else None
