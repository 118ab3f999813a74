"""What ROS messages hold as values: stamps, grey images, poses, the tree of fixed transforms, and the calibration.

The calibration of a bag is of files beside it, or of its CameraInfo messages and the transforms that never change.
Sources: the definitions of sensor_msgs, geometry_msgs and nav_msgs; the P of a right camera's CameraInfo has the
baseline; REP 103 (camera axes), REP 104 (rectified images), REP 105 (frames).
"""

from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from toolkit.datasets.io.bag_reader import (
    IMU,
    ODOMETRY,
    POINT,
    POSE,
    POSE_COV,
    TRANSFORM,
    TWIST,
    TWIST_COV,
    Bag,
    Chosen,
    Message,
    Topic,
)
from toolkit.datasets.io.euroc_calibration import AS_STATED, NO_NOISE, kalibr_noise, lens_of, read_calibration
from toolkit.datasets.io.fields import camera_matrix
from toolkit.datasets.io.image_pairs import pinhole_of
from toolkit.errors import DataError, printable
from toolkit.files.reading import is_regular
from toolkit.frontend import Camera, RectifiedPair, already_rectified, rectified
from toolkit.geometry import Array, IntArray, rotation_from_quaternion, se3, se3_inverse
from toolkit.measurements import NS_PER_S, MotionNoise
from toolkit.models.noise import mems_imu, twist_noise
from toolkit.motion_samples import MotionSamples, TwistSamples

# Of the planar encodings the first plane is the brightness.
_GREY = {
    **dict.fromkeys(("mono8", "8UC1", "nv12", "nv21", "nv24", "i420"), np.uint8),
    **dict.fromkeys(("mono16", "16UC1"), np.uint16),
}
# Channels, and OpenCV's conversion; it names a pattern of Bayer by its second row, ROS by its first. Names that end in
# 16 are of 16 bits.
_COLOURS = {
    "rgb8": (3, "COLOR_RGB2GRAY"),
    **dict.fromkeys(("bgr8", "8UC3"), (3, "COLOR_BGR2GRAY")),
    "rgba8": (4, "COLOR_RGBA2GRAY"),
    "bgra8": (4, "COLOR_BGRA2GRAY"),
    "bayer_rggb8": (1, "COLOR_BayerBG2GRAY"),
    "bayer_bggr8": (1, "COLOR_BayerRG2GRAY"),
    "bayer_gbrg8": (1, "COLOR_BayerGR2GRAY"),
    "bayer_grbg8": (1, "COLOR_BayerGB2GRAY"),
    **dict.fromkeys(("yuv422", "uyvy"), (2, "COLOR_YUV2GRAY_UYVY")),
    **dict.fromkeys(("yuv422_yuy2", "yuyv"), (2, "COLOR_YUV2GRAY_YUY2")),
}
_COLOURS |= {
    f"{name.removesuffix('8')}16": what for name, what in _COLOURS.items() if name.startswith(("rgb", "bgr", "bayer"))
}
_PNG, _JPEG = b"\x89PNG", b"\xff\xd8"
Grey = npt.NDArray[np.uint8] | npt.NDArray[np.uint16]
_PUT_BESIDE = "put Kalibr's camchain.yaml or an ASL folder's cam0/sensor.yaml beside the bag"


def stamp_ns(header: Any, recorded_ns: int) -> int:
    """Return the stamp of a header; where it has none, when the message was recorded."""
    return int(header.stamp.sec) * NS_PER_S + int(header.stamp.nanosec) if is_stamped(header) else recorded_ns


def is_stamped(header: Any) -> bool:
    """Say whether a header has a stamp."""
    return bool(header.stamp.sec or header.stamp.nanosec)


def stamps_ns(messages: Sequence[Message]) -> IntArray:
    """Return the stamps (N,) of messages as :func:`stamp_ns`."""
    return np.array([stamp_ns(message.value.header, message.t_ns) for message in messages], dtype=np.int64)


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
    K, coefficients = _field(info, "K").reshape(3, 3), _field(info, "D")
    if not (K.any() and np.isfinite(K).all() and info.width and info.height):
        raise DataError(f"{what}: is not calibrated (K is zero or the size is missing); {_PUT_BESIDE}")
    name = str(info.distortion_model) if coefficients.any() else "none"
    model, coefficients = lens_of(what, name or "none", coefficients)
    return Camera(pinhole_of(camera_matrix(Path(what), "K", K)), model, coefficients, _size(info))


def _field(info: Any, name: str) -> Array:
    """Return a field of a CameraInfo, which ROS 1 writes large and ROS 2 small."""
    return np.asarray(getattr(info, name if hasattr(info, name) else name.lower()), dtype=np.float64)


def _size(info: Any) -> tuple[int, int]:
    return int(info.width), int(info.height)


# Where messages have their vectors, by type: of an IMU rates and specific force, of others linear and angular velocity.
VECTORS = {
    IMU: ("angular_velocity", "linear_acceleration"),
    ODOMETRY: ("twist.twist.linear", "twist.twist.angular"),
    TWIST: ("twist.linear", "twist.angular"),
    TWIST_COV: ("twist.twist.linear", "twist.twist.angular"),
}
_POSES = {
    ODOMETRY: ("pose.pose.position", "pose.pose.orientation"),
    POSE: ("pose.position", "pose.orientation"),
    POSE_COV: ("pose.pose.position", "pose.pose.orientation"),
    TRANSFORM: ("transform.translation", "transform.rotation"),
}


def columns(values: Sequence[Any], part: str, axes: str = "xyz") -> Array:
    """Return a part of messages (N, 3), or a quaternion (N, 4) with the axes xyzw."""
    get = attrgetter(*(f"{part}.{axis}" for axis in axes))
    return np.array([get(value) for value in values], dtype=np.float64).reshape(-1, len(axes))


def poses_of(messages: Sequence[Message], message_type: str) -> tuple[IntArray, IntArray, Array]:
    """Return stamps (N,) ns, each once and in order, of which message each is, and x y z qx qy qz qw (N, 7).

    A point's quaternion is NaN.
    """
    t_ns, rows = np.unique(stamps_ns(messages), return_index=True)
    values = [messages[row].value for row in rows.tolist()]
    if message_type == POINT:
        return t_ns, rows, np.hstack([columns(values, "point"), np.full((len(values), 4), np.nan)])
    at, turn = _POSES[message_type]
    return t_ns, rows, np.hstack([columns(values, at), columns(values, turn, "xyzw")])


def frame_name(name: Any) -> str:
    """Return the name of a frame without the slash that ROS 1 may write before it."""
    return str(name).lstrip("/")


_joint: Callable[[Any], tuple[float, ...]] = attrgetter(
    *(f"transform.translation.{axis}" for axis in "xyz"), *(f"transform.rotation.{axis}" for axis in "xyzw")
)


def fixed(transforms: Iterable[Any]) -> list[Any]:
    """Return those of many transforms that never change, each once."""
    first: dict[tuple[str, str], Any] = {}
    moved: set[tuple[str, str]] = set()
    for transform in transforms:
        edge = (frame_name(transform.header.frame_id), frame_name(transform.child_frame_id))
        if _joint(first.setdefault(edge, transform)) != _joint(transform):
            moved.add(edge)
    return [transform for edge, transform in first.items() if edge not in moved]


class Tree:
    """The fixed transforms of a robot."""

    def __init__(self, transforms: Iterable[Any]) -> None:
        self._next: dict[str, dict[str, Array]] = {}
        for transform in transforms:
            parent, child = frame_name(transform.header.frame_id), frame_name(transform.child_frame_id)
            values = np.array(_joint(transform))
            quaternion = values[3:]
            if not np.isclose(np.linalg.norm(quaternion), 1.0, atol=1e-2):
                continue  # no rotation, as an unset message
            T_parent_child = se3(rotation_from_quaternion(quaternion), values[:3])
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


# Calibration ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Mounted:
    """The pair of cameras, where the left one stands on the body, the motion's noise, and where all this is from.

    ``as_they_are`` is the pair that images make which come rectified already, where that is possible; ``shift_s`` is
    added to the stamps of images.
    """

    pair: RectifiedPair
    T_imu_left: Array
    noise: MotionNoise
    facts: tuple[str, ...]
    as_they_are: RectifiedPair | None = None
    shift_s: float = 0.0


@dataclass(frozen=True, eq=False)
class Recorded:
    """What a bag holds but its images: messages by topic, of cameras the first, and the fixed transforms.

    ``in_tf`` says that /tf connects the frames of body and camera, and not /tf_static.
    """

    path: Path
    chosen: Chosen
    held: Mapping[str, Sequence[Message]]
    tree: Tree
    in_tf: bool = False

    def of(self, topic: Topic | None) -> Sequence[Message]:
        """Return the messages of a topic in the order of recording; none where there is no such topic."""
        return () if topic is None else self.held.get(topic.name, ())

    def frame_of(self, topic: Topic | None, *, of_child: bool = False) -> str:
        """Return the frame of a topic's first message; of an odometry that of the child, which its twist is in."""
        if not self.of(topic):
            return ""
        value = self.of(topic)[0].value
        child = getattr(value, "child_frame_id", "") if of_child else ""
        return frame_name(child or value.header.frame_id)

    @property
    def body(self) -> str:
        """The frame of the IMU, or the one whose twists are measured."""
        imu = self.chosen.imu
        return self.frame_of(self.chosen.twist, of_child=True) if imu is None else self.frame_of(imu)

    @property
    def T_imu_left(self) -> Array | None:
        """Where the left camera stands on the body, None where no transform says it."""
        return self.tree.between(self.body, self.frame_of(self.chosen.left))


def recorded(bag: Bag, chosen: Chosen) -> Recorded:
    """Read what a bag holds but its images; /tf is read where /tf_static does not join the body and the camera."""
    wanted = (chosen.imu, chosen.accel, chosen.twist, chosen.truth, *chosen.transforms)
    held: dict[str, list[Message]] = {}
    for message in bag.messages({topic.name for topic in wanted if topic is not None}):
        held.setdefault(message.topic, []).append(message)
    for topic in (chosen.left_info, chosen.right_info, chosen.left, chosen.right):
        if topic is not None:
            held[topic.name] = list(islice(bag.messages({topic.name}), 1))
    static = [one for topic in chosen.transforms for message in held.get(topic.name, ()) for one in _joints(message)]
    found = Recorded(bag.path, chosen, held, Tree(static))
    if not chosen.moving or found.T_imu_left is not None:
        return found
    moving = (one for message in bag.messages({topic.name for topic in chosen.moving}) for one in _joints(message))
    by_tf = replace(found, tree=Tree([*fixed(moving), *static]), in_tf=True)
    return found if by_tf.T_imu_left is None else by_tf


def _joints(message: Message) -> Sequence[Any]:
    transforms: Sequence[Any] = message.value.transforms
    return transforms


def mounted(source: Recorded, motion: MotionSamples) -> Mounted:
    """Return the calibration: from files beside the bag, or from its own messages.

    Raises DataError where there is none, it is incomplete, or the pose of the camera on the body is unknown.
    """
    folder = _calibration_folder(source.path)
    twist = twist_noise(motion.t_ns, motion.v_mps, motion.w_radps) if isinstance(motion, TwistSamples) else None
    if folder is not None:
        root, mav0 = folder
        calibration = read_calibration(root, mav0)
        if calibration.cameras is None:
            raise DataError(f"{mav0}: the calibration lacks distortion_model or intrinsics of a camera; add them")
        pair = rectified(*calibration.cameras, calibration.T_right_left, str(mav0))
        noise = () if twist else (calibration.noise_source,)
        notes = (f"{calibration.source}, beside the bag", *noise, *calibration.shifted, *calibration.unused)
        return Mounted(pair, calibration.T_imu_left, twist or calibration.noise, notes, shift_s=calibration.shift_s)
    T_imu_left, left = source.T_imu_left, source.frame_of(source.chosen.left)
    # An IMU does not have the axes of a camera: if both name the same frame, the name is wrong for one of them.
    if T_imu_left is None or (source.chosen.imu is not None and source.body == left):
        raise DataError(_not_joined(source))
    pair, as_they_are, how = _pair(source)
    stated = kalibr_noise(*_folders_beside(source.path))
    noise = () if twist else (NO_NOISE if stated is None else AS_STATED,)
    tf = "the transforms of /tf that never change" if source.in_tf else "/tf_static"
    notes = (f"calibration from {how} and {tf}", *noise)
    return Mounted(pair, T_imu_left, twist or (stated[0] if stated else mems_imu()), notes, as_they_are)


def _not_joined(source: Recorded) -> str:
    others = ", ".join(source.chosen.other_imus)
    other = f", or name another Imu with --topics imu=TOPIC ({others})" if others else ""
    tf = "/tf_static and no fixed transform of /tf" if source.chosen.moving else "/tf_static"
    return (
        f"{source.path}: the camera's pose on the body is unknown: no {tf} connects the frames "
        f"{source.body!r} and {source.frame_of(source.chosen.left)!r}; {_PUT_BESIDE}{other}"
    )


def _calibration_folder(path: Path) -> tuple[Path, Path] | None:
    """Return the folder of calibration files beside a bag, or in the folder that it is, and that of its sensors."""
    for root in _folders_beside(path):
        if any(root.glob("*camchain*.yaml")):
            return root, root
        for mav0 in (root, root / "mav0"):
            if is_regular(mav0 / "cam0/sensor.yaml"):
                return root, mav0
    return None


def _folders_beside(path: Path) -> tuple[Path, ...]:
    """Return where files about a bag may lie: in the folder that it is, and in that where it is."""
    resolved = path.resolve()
    return (resolved, resolved.parent) if resolved.is_dir() else (resolved.parent,)


def _pair(source: Recorded) -> tuple[RectifiedPair, RectifiedPair | None, str]:
    """Return the pair of cameras of the CameraInfo messages, that of images which come rectified, and the topics."""
    topics, infos = _infos(source)
    what, size_px = [f"{source.path}: {topic.name}" for topic in topics], _size(infos[0])
    how = " and ".join(topic.name for topic in topics)
    turns, projections = ([_field(info, name).reshape(3, -1) for info in infos] for name in "RP")
    R_rect_left, R_rect_right = (R if R.any() else np.eye(3) for R in turns)
    # How far right each camera is of the origin of the rectified axes; 0 where nothing is stated.
    left_m, right_m = (-float(P[0, 3] / P[0, 0]) if P[0, 0] > 0.0 else 0.0 for P in projections)
    pinhole_px, baseline_m = pinhole_of(projections[0]), right_m - left_m
    T_right_left = source.tree.between(*(source.frame_of(one) for one in (source.chosen.right, source.chosen.left)))
    if source.chosen.rectified:
        if not baseline_m > 0.0 and T_right_left is not None:
            baseline_m = float(np.linalg.norm(T_right_left[:3, 3]))
        if not (baseline_m > 0.0 and pinhole_px[0] > 0.0):
            lacks = "no baseline (Tx is 0), and no /tf_static joins the two cameras"
            lacks = lacks if pinhole_px[0] > 0.0 else "no focal length"
            raise DataError(
                f"{what[1]}: the images are rectified, and P states {lacks}; correct P, or {_PUT_BESIDE} and name the "
                "raw images"
            )
        # The frame of an image is the camera's own; R turns it into the rectified one's.
        return replace(already_rectified(pinhole_px, baseline_m, size_px), R_rect_cam=R_rect_left), None, how
    left, right = (camera(info, text) for info, text in zip(infos, what, strict=True))
    as_they_are = None
    if baseline_m > 0.0:
        # In rectified axes the right camera stands on x; R turns each camera's own axes into them.
        T_right_left = se3(R_rect_right.T @ R_rect_left, R_rect_right.T @ np.array([-baseline_m, 0.0, 0.0]))
        as_they_are = already_rectified(pinhole_px, baseline_m, size_px)
    if T_right_left is None:
        raise DataError(f"{what[1]}: P has no baseline, and /tf_static does not join the two cameras; {_PUT_BESIDE}")
    return rectified(left, right, T_right_left, f"{source.path}: {how}"), as_they_are, how


def _infos(source: Recorded) -> tuple[list[Topic], list[Any]]:
    """Return the topics of both calibrations and their first messages; raises DataError where one is missing."""
    chosen, topics, infos = source.chosen, [], []
    for image, topic in ((chosen.left, chosen.left_info), (chosen.right, chosen.right_info)):
        messages = source.of(topic)
        if topic is None or not messages:
            raise DataError(
                f"{source.path}: there is no sensor_msgs/CameraInfo beside {image.name}; name it with --topics "
                f"left_info=TOPIC,right_info=TOPIC, or {_PUT_BESIDE}"
            )
        infos.append(messages[0].value)
        topics.append(topic)
    return topics, infos
