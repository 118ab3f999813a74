"""The interface to the rosbags library: the kind of a bag, its topics, and its messages, one by one.

Messages are read with the library's own definitions of ROS's types and never with those in a bag, because code is
generated from definitions. Any error that a damaged bag makes the library raise becomes a DataError. Formats:
http://wiki.ros.org/Bags/Format/2.0, https://mcap.dev/spec, and the folders and SQLite files of rosbag2.
"""

import importlib.util
import re
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal

from toolkit.errors import DataError, VislamError, printable
from toolkit.files.reading import is_regular, open_input
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
# What writes the missing index, by kind of bag.
_REMEDIES = {
    "ros1": "copy it again, or run rosbag reindex on it",
    "mcap": "copy it again, or run mcap recover on it",
    "sqlite": "copy it again, or run ros2 bag reindex on its folder",
    "folder": "copy it again, or run ros2 bag reindex on it",
}

IMAGE, COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
CAMERA_INFO, IMU, TRANSFORMS = "sensor_msgs/msg/CameraInfo", "sensor_msgs/msg/Imu", (_TF, _OLD_TF)
ODOMETRY = "nav_msgs/msg/Odometry"
TWIST, TWIST_COV = "geometry_msgs/msg/TwistStamped", "geometry_msgs/msg/TwistWithCovarianceStamped"
POSE, TRANSFORM = "geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/TransformStamped"
POSE_COV = "geometry_msgs/msg/PoseWithCovarianceStamped"
KNOWN_TYPES = frozenset(
    {IMAGE, COMPRESSED, CAMERA_INFO, IMU, *TRANSFORMS, ODOMETRY, TWIST, TWIST_COV, POSE, POSE_COV, TRANSFORM}
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


@dataclass(frozen=True, eq=False)
class Message:
    """A message as the library decodes it, its topic, and when it was recorded (ns)."""

    topic: str
    t_ns: int
    value: Any


@dataclass(frozen=True, eq=False)
class Held:
    """The messages of the topics that are small enough to be held in memory, in the order of recording."""

    by_topic: Mapping[str, list[Message]]

    def of(self, topic: Topic | None) -> list[Message]:
        """Return the messages of a topic; none where there is no such topic."""
        return [] if topic is None else self.by_topic.get(topic.name, [])


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
    """An open bag, of which each reader reads a part; one where it is whole."""

    def __init__(self, path: Path, kind: Kind, readers: Sequence[Any]) -> None:
        self.path = path
        self._readers = readers
        self._kind = kind
        self._of_ros1 = kind == "ros1"
        with _guarded(path, kind):
            self._connections = [connection for reader in readers for connection in reader.connections]
            self.topics = tuple(self._topic(name) for name in sorted({c.topic for c in self._connections}))

    def messages(self, topics: Collection[str]) -> Iterator[Message]:
        """Yield the messages of some topics in the order of recording; raises DataError where one is damaged."""
        for reader in self._readers:
            with _guarded(self.path, self._kind):
                connections = [connection for connection in reader.connections if connection.topic in topics]
            yield from self._messages(reader, connections) if connections else ()

    def _messages(self, reader: Any, connections: Sequence[Any]) -> Iterator[Message]:
        coming = iter(reader.messages(connections))
        while True:
            with _guarded(self.path, self._kind):
                found = next(coming, None)
                if found is None:
                    return
                connection, t_ns, raw = found
                message = Message(connection.topic, t_ns, self._decoder(connection)(raw, connection.msgtype))
            yield message

    def _topic(self, name: str) -> Topic:
        connections = [connection for connection in self._connections if connection.topic == name]
        types = sorted({connection.msgtype for connection in connections})
        count = sum(connection.msgcount or 0 for connection in connections)
        unreadable = "" if types[0] not in KNOWN_TYPES else self._why_not(connections)
        return Topic(name, types[0] if len(types) == 1 else " and ".join(types), count, unreadable)

    def _why_not(self, connections: list[Any]) -> str:
        """Return why messages of a known type cannot be read, nothing where they can."""
        for connection in connections:
            encoding = self._encoding(connection)
            if encoding not in ("cdr", "ros1"):
                return f"encoded as {printable(encoding)}"
            digest, store = connection.digest, _store(encoding == "ros1")
            if digest and digest != _digest(store, connection.msgtype, of_ros1=self._of_ros1):
                return "of another definition than ROS's"
        return ""

    def _decoder(self, connection: Any) -> Callable[[bytes, str], Any]:
        of_ros1 = self._encoding(connection) == "ros1"
        store = _store(of_ros1)
        decode: Callable[[bytes, str], Any] = store.deserialize_ros1 if of_ros1 else store.deserialize_cdr
        return decode

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
    paths = [path]
    if kind == "folder" and not _of_rosbag2(path / _METADATA):
        paths = _parts(path)
        path = paths[0] if len(paths) == 1 else path
        kind = kind_of(paths[0])
        assert kind is not None
    with ExitStack() as closing:
        readers = []
        for part in paths:
            with _guarded(part, kind):
                readers.append(_reader(kind)(part))
                readers[-1].open()
                closing.callback(readers[-1].close)
        _check_order(paths, readers)
        yield Bag(path, kind, readers)


def _parts(folder: Path) -> list[Path]:
    """Return the one bag in a folder without metadata.yaml, or the parts of one that ROS 1 has split, in their order.

    Raises DataError where there are several that are no such parts.
    """
    bags = _files_alone(folder)
    if len(bags) == 1:
        return bags
    names, kinds = printable(", ".join(bag.name for bag in bags))[:200], {kind_of(bag) for bag in bags}
    if kinds != {"ros1"}:
        raise DataError(
            f"{folder}: holds {len(bags)} bags and no {_METADATA} that joins them: {names}; name one of them, or run "
            "ros2 bag reindex on the folder"
        )
    places = {int(found[1]): bag for bag in bags if (found := _PART.search(bag.stem))}
    if sorted(places) != list(range(len(bags))):
        raise DataError(
            f"{folder}: holds {len(bags)} bags: {names}; name one of them, or, if they are parts of one recording, let "
            "their names end in _0, _1 and so on, as rosbag record --split does"
        )
    return [places[place] for place in range(len(bags))]


def parts_beside(path: Path) -> tuple[str, ...]:
    """Return a remark on what lies beside one part of a bag that ROS 1 has split; none where nothing does."""
    if path.is_dir() or path.suffix != ".bag" or _PART.search(path.stem) is None:
        return ()
    others = [one.name for one in path.parent.glob("*.bag") if one.name != path.name and _PART.search(one.stem)]
    if not others:
        return ()
    return (f"read alone; {printable(', '.join(sorted(others)))[:200]} beside it may go on: name the folder for all",)


def _check_order(parts: Sequence[Path], readers: Sequence[Any]) -> None:
    """Raise DataError where a part of a bag begins before the one ahead of it ends."""
    for (before, earlier), (part, later) in pairwise(zip(parts, readers, strict=True)):
        if later.message_count and later.start_time < earlier.end_time:
            overlap_s = (earlier.end_time - later.start_time) / NS_PER_S
            raise DataError(
                f"{part}: begins {overlap_s:.3g} s before {before.name} ends, so they are not parts of one recording; "
                "name one of them"
            )


def _reader(kind: Kind) -> Any:
    """Return the class that reads a kind of bag, whatever the file is called."""
    if kind == "ros1":
        from rosbags.rosbag1 import Reader as Reader1

        return Reader1
    if kind == "folder":
        from rosbags.rosbag2 import Reader as Reader2

        return Reader2
    from rosbags.rosbag2.storage_mcap import McapReader
    from rosbags.rosbag2.storage_sqlite3 import Sqlite3Reader

    return McapReader if kind == "mcap" else Sqlite3Reader


@cache
def _store(of_ros1: bool) -> Any:
    """Return the definitions of ROS's messages."""
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
def _guarded(path: Path, kind: Kind) -> Iterator[None]:
    """Raise as DataError whatever the library raises: of a damaged bag that can be anything."""
    try:
        yield
    except VislamError:
        raise
    except Exception as error:
        why = printable(" ".join(str(error).split()))[:200] or type(error).__name__
        if _NOT_SUPPORTED in why:
            raise DataError(
                f"{path}: rosbags does not read such a bag ({why.removesuffix('; please report issue.')}); convert it "
                "with ros2 bag convert or rosbag decompress, or install a newer rosbags"
            ) from error
        of_folder = kind in ("mcap", "sqlite") and _of_rosbag2(path.parent / _METADATA)
        remedy = f"name its folder, which has {_METADATA}, or copy it again" if of_folder else _REMEDIES[kind]
        raise DataError(f"{path}: damaged, cut off, or a bag that cannot be read ({why}); {remedy}") from error
