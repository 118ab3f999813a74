"""The interface to the rosbags library: the kind of a bag, its topics, its messages one by one, and what they hold.

Messages are read with the library's own definitions of ROS's types and never with those in a bag, because code is
generated from definitions. Any error that a damaged bag makes the library raise becomes a DataError. Formats:
http://wiki.ros.org/Bags/Format/2.0, https://mcap.dev/spec, and the folders and SQLite files of rosbag2; sensor_msgs,
geometry_msgs and nav_msgs; frames are REP 105's.
"""

import heapq
import importlib.util
import re
from collections import deque
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import cache
from itertools import groupby
from operator import attrgetter, itemgetter
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from toolkit.errors import DataError, VislamError, printable
from toolkit.files.reading import is_regular, open_input
from toolkit.geometry import Array, IntArray, rotation_from_quaternion, se3, se3_inverse
from toolkit.measurements import NS_PER_S

Kind = Literal["ros1", "mcap", "sqlite", "folder"]
_MAGIC: dict[bytes, Kind] = {b"#ROSBAG V": "ros1", b"\x89MCAP0\r\n": "mcap"}
_SQLITE, _ROS_TABLES = b"SQLite format 3\0", (b"topics", b"messages")
_METADATA, _IN_METADATA = "metadata.yaml", b"rosbag2_bagfile_information"
_LOOKED_AT = 1 << 16
# The second is what tf called the same message before tf2.
_TF, _OLD_TF, _TF_DEFINITION = (
    "tf2_msgs/msg/TFMessage",
    "tf/msg/tfMessage",
    "geometry_msgs/TransformStamped[] transforms",
)
_ENDINGS = (".mcap", ".db3", ".bag")
# How rosbag record --split ends the names of the parts.
_PART = re.compile(r"_(\d+)$")
# The library's messages about a storage, a compression or a version of bags that it does not know.
_NOT_SUPPORTED = "not supported"
_REMEDY = "copy it again, or write its index anew: rosbag reindex, ros2 bag reindex on its folder, mcap recover"

IMAGE, COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
CAMERA_INFO, IMU, TRANSFORMS = "sensor_msgs/msg/CameraInfo", "sensor_msgs/msg/Imu", (_TF, _OLD_TF)
ODOMETRY = "nav_msgs/msg/Odometry"
TWIST, TWIST_COV = "geometry_msgs/msg/TwistStamped", "geometry_msgs/msg/TwistWithCovarianceStamped"
POSE, TRANSFORM = "geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/TransformStamped"
POSE_COV = "geometry_msgs/msg/PoseWithCovarianceStamped"
POINT = "geometry_msgs/msg/PointStamped"
KNOWN_TYPES = frozenset(
    {IMAGE, COMPRESSED, CAMERA_INFO, IMU, *TRANSFORMS, ODOMETRY, TWIST, TWIST_COV, POSE, POSE_COV, TRANSFORM, POINT}
)


@dataclass(frozen=True)
class Topic:
    """A topic of a bag: its name, the type of its messages, how many there are, and why they cannot be read."""

    name: str
    type: str
    count: int
    unreadable: str = ""

    def __str__(self) -> str:
        why = f", {self.unreadable}" if self.unreadable else ""
        return f"{printable(self.name)} ({printable(self.type).replace('/msg/', '/')}{why})"


class Message(NamedTuple):
    """A message as the library decodes it, its topic, and when it was recorded (ns)."""

    topic: str
    t_ns: int
    value: Any


def kind_of(path: Path) -> Kind | None:
    """Return the kind of bag a path is, from its content; None where it is none."""
    if path.is_dir():
        return "folder" if _of_rosbag2(path / _METADATA) or _files_alone(path) else None
    if not is_regular(path):
        return None
    with open_input(path) as file:
        begin = file.read(_LOOKED_AT)
    if begin.startswith(_SQLITE):
        return "sqlite" if all(table in begin for table in _ROS_TABLES) else None
    return next((kind for magic, kind in _MAGIC.items() if begin.startswith(magic)), None)


def place_in_bag(path: Path) -> tuple[Path, str | None] | None:
    """Return the bag that a path is, or names with a topic, as in ``run.bag:/odom``; None where it is neither."""
    name, colon, topic = str(path).partition(":/")
    if colon and not path.exists():
        return Path(name), f"/{topic}"
    return (path, None) if path.exists() and kind_of(path) is not None else None


def _of_rosbag2(metadata: Path) -> bool:
    if not is_regular(metadata):
        return False
    with open_input(metadata) as file:
        return _IN_METADATA in file.read(_LOOKED_AT)


def _files_alone(folder: Path) -> list[Path]:
    """Return the bags in a folder that holds nothing else but YAML files and folders of them; none where it does."""
    files = sorted(path for path in folder.iterdir() if not path.name.startswith("."))
    bags = [path for path in files if path.suffix in _ENDINGS and is_regular(path) and kind_of(path) is not None]
    return bags if all(path in bags or _of_calibration(path) for path in files) else []


def _of_calibration(path: Path) -> bool:
    """Say whether a path is what calibration consists of: a YAML file, or a folder of such files alone."""
    return path.suffix == ".yaml" or (path.is_dir() and all(inside.suffix == ".yaml" for inside in path.iterdir()))


class Bag:
    """An open bag; of one that ROS 1 has split each reader reads a part."""

    def __init__(self, path: Path, readers: Sequence[Any], *, of_ros1: bool) -> None:
        self.path = path
        self._readers, self._of_ros1 = readers, of_ros1
        connections = sorted((one for reader in readers for one in reader.connections), key=lambda one: one.topic)
        self.topics = tuple(self._topic(name, list(of_it)) for name, of_it in groupby(connections, lambda c: c.topic))

    def messages(self, topics: Collection[str]) -> Iterator[Message]:
        """Yield the messages of some topics in the order of recording; raises DataError where one is damaged."""
        with _guarded(self.path):
            wanted = [(reader, [c for c in reader.connections if c.topic in topics]) for reader in self._readers]
            parts = (reader.messages(connections) for reader, connections in wanted if connections)
            for connection, t_ns, raw in heapq.merge(*parts, key=itemgetter(1)):
                of_ros1 = self._encoding(connection) == "ros1"
                store = _store(of_ros1)
                value = (store.deserialize_ros1 if of_ros1 else store.deserialize_cdr)(raw, connection.msgtype)
                yield Message(connection.topic, t_ns, value)

    def _topic(self, name: str, connections: Sequence[Any]) -> Topic:
        types = sorted({connection.msgtype for connection in connections})
        count = sum(connection.msgcount or 0 for connection in connections)
        why_not = next(filter(None, map(self._why_not, connections)), "") if types[0] in KNOWN_TYPES else ""
        return Topic(name, " and ".join(types), count, why_not)

    def _why_not(self, connection: Any) -> str:
        """Return why messages of a known type cannot be read, nothing where they can."""
        encoding = self._encoding(connection)
        if encoding not in ("cdr", "ros1"):
            return f"encoded as {printable(encoding)}"
        other = connection.digest and connection.digest != _digest(
            _store(encoding == "ros1"), connection.msgtype, of_ros1=self._of_ros1
        )
        return "of another definition than ROS's" if other else ""

    def _encoding(self, connection: Any) -> str:
        return "ros1" if self._of_ros1 else str(getattr(connection.ext, "serialization_format", "cdr"))


@contextmanager
def opened(path: Path) -> Iterator[Bag]:
    """Open a bag; raises DataError where it is damaged, or the library is not installed."""
    kind = kind_of(path)
    if kind is None:
        raise DataError(f"{path}: is no bag of ROS 1 or 2 and no MCAP")
    if importlib.util.find_spec("rosbags") is None:
        raise DataError(f'{path}: bags are read with the package rosbags; pip install "vislam-toolkit[bags]"')
    parts = [path] if kind != "folder" or _of_rosbag2(path / _METADATA) else _parts(path)
    kinds = {part: kind_of(part) for part in parts}
    path = parts[0] if len(parts) == 1 else path
    with ExitStack() as closing:
        readers = []
        for part, of_part in kinds.items():
            with _guarded(part):
                readers.append(_reader(of_part)(part))
                readers[-1].open()
                closing.callback(readers[-1].close)
        with _guarded(path):
            bag = Bag(path, readers, of_ros1="ros1" in kinds.values())
        yield bag


def _parts(folder: Path) -> list[Path]:
    """Return the one bag in a folder without metadata.yaml, or the parts of one that ROS 1 has split."""
    bags = _files_alone(folder)
    of_ros1 = {kind_of(bag) for bag in bags} == {"ros1"}
    numbers = sorted(int(found[1]) for bag in bags if (found := _PART.search(bag.stem)))
    if len(bags) == 1 or (of_ros1 and numbers == list(range(len(bags)))):
        return bags
    of_split = "if they are parts of one recording, let their names end in _0, _1 and so on"
    remedy = of_split if of_ros1 else "run ros2 bag reindex on the folder"
    names = printable(", ".join(bag.name for bag in bags))[:200]
    held = f"{len(bags)} bags and no {_METADATA} that joins them: {names}"
    raise DataError(f"{folder}: holds {held}; name one of them, or {remedy}")


def _reader(kind: Kind | None) -> Any:
    """Return the class that reads a kind of bag, whatever the file is called."""
    from rosbags import rosbag1, rosbag2
    from rosbags.rosbag2.storage_mcap import McapReader
    from rosbags.rosbag2.storage_sqlite3 import Sqlite3Reader

    return {"ros1": rosbag1.Reader, "folder": rosbag2.Reader, "mcap": McapReader, "sqlite": Sqlite3Reader}[str(kind)]


@cache
def _store(of_ros1: bool) -> Any:
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC if of_ros1 else Stores.ROS2_HUMBLE)
    for name in TRANSFORMS:
        if name not in store.types:
            store.register(get_types_from_msg(_TF_DEFINITION, name))
    return store


@cache
def _digest(store: Any, message_type: str, *, of_ros1: bool) -> str:
    """Return what bags state of a type's definition: MD5 in ROS 1, RIHS in ROS 2."""
    return str(store.generate_msgdef(message_type)[1] if of_ros1 else store.hash_rihs01(message_type))


@contextmanager
def _guarded(path: Path) -> Iterator[None]:
    """Raise as DataError whatever the library raises: of a damaged bag that can be anything."""
    try:
        yield
    except VislamError:
        raise
    except Exception as error:
        why = printable(" ".join(str(error).split()))[:200] or type(error).__name__
        if _NOT_SUPPORTED in why:
            remedy = "convert it with ros2 bag convert or rosbag decompress, or install a newer rosbags"
            why = why.removesuffix("; please report issue.")
            raise DataError(f"{path}: rosbags does not read such a bag ({why}); {remedy}") from error
        of_folder = path.is_file() and _of_rosbag2(path.parent / _METADATA)
        remedy = f"name its folder, which has {_METADATA}, or copy it again" if of_folder else _REMEDY
        raise DataError(f"{path}: damaged, cut off, or a bag that cannot be read ({why}); {remedy}") from error


# Values of messages ---------------------------------------------------------------------------------------------------

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


def stamp_ns(header: Any, recorded_ns: int) -> int:
    """Return the stamp of a header; where it has none, when the message was recorded."""
    return int(header.stamp.sec) * NS_PER_S + int(header.stamp.nanosec) if is_stamped(header) else recorded_ns


def is_stamped(header: Any) -> bool:
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
        raise DataError(f"{what}: {width}x{height} px have {data.size} bytes in rows of {step}; it is cut off")
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
    kind, remedy = printable(str(message.format))[:50], "republish them as one of these, or as raw images"
    raise DataError(f"{what}: compressed images are {kind}, expected PNG or JPEG; {remedy}")


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
