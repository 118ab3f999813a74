"""The interface to the rosbags library: the kind of a bag, its topics and their roles, and its messages, one by one.

Messages are read with the library's own definitions of ROS's types and never with those in a bag, because code is
generated from definitions. Any error that a damaged bag makes the library raise becomes a DataError. Formats:
http://wiki.ros.org/Bags/Format/2.0, https://mcap.dev/spec, and the folders and SQLite files of rosbag2.
Topics get their roles as given with ``--topics``, else guessed from types and names.
"""

import heapq
import importlib.util
import re
from collections.abc import Collection, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from functools import cache
from itertools import groupby
from operator import itemgetter
from pathlib import Path
from typing import Any, Literal, NamedTuple

from toolkit.errors import DataError, VislamError, no_such, printable
from toolkit.files.reading import is_regular, open_input

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
_IMAGES, _POSES = (IMAGE, COMPRESSED), (ODOMETRY, POSE, POSE_COV, TRANSFORM)
ROLES: dict[str, tuple[str, ...]] = {
    "left": _IMAGES,
    "right": _IMAGES,
    "left_info": (CAMERA_INFO,),
    "right_info": (CAMERA_INFO,),
    "imu": (IMU,),
    "accel": (IMU,),
    "twist": (ODOMETRY, TWIST, TWIST_COV),
    # A point is taken for a truth only where it is said: it may be a goal.
    "truth": (*_POSES, POINT),
}
# Of a sensor that publishes both by themselves, as RealSense's cameras do.
_GYRO, _ACCEL = "gyro", "accel"
# In the name of a topic whose poses are a truth, and not another system's estimate.
_OF_TRUTH = ("truth", "gt", "groundtruth", "vicon", "mocap", "optitrack", "qualisys", "vrpn", "leica")
_STATIC, _MOVING, _RECTIFIED, _LEAST_IMAGES = "tf_static", "tf", "rect", 2
# Of a message that lists the topics of a bag, which may be hundreds.
_LONGEST = 900
_COMPRESSED_SUFFIX = "/compressed"
# What names and definitions of other types have that measure motion, or hold images, and types that do neither.
_LIKE_IMU = re.compile(r"gyro|accelerometer|angular_velocity|(^|[^a-z])imu", re.IGNORECASE)
_LIKE_IMAGES = re.compile(r"ffmpeg|image|video|theora|h264|h265", re.IGNORECASE)
_OF_ROS = (
    "rcl_interfaces/",
    "rosgraph_msgs/",
    "diagnostic_msgs/",
    "tf2_msgs/",
    "std_msgs/",
    "nav_msgs/",
    "geometry_msgs/",
)
_NONE = "none"


@dataclass(frozen=True)
class Topic:
    """A topic of a bag: its name, the type of its messages, how many there are, and why they cannot be read.

    ``fields`` is the definition of a type that is not read, as far as the bag has it.
    """

    name: str
    type: str
    count: int
    unreadable: str = ""
    fields: str = ""

    def is_like(self, words: re.Pattern[str]) -> bool:
        """Say whether a topic of a type that is not read is called, or holds, something that words are about."""
        is_other = self.type not in KNOWN_TYPES and not self.type.startswith(_OF_ROS)
        return is_other and any(words.search(text) for text in (self.name, self.type, self.fields))

    def __str__(self) -> str:
        why = f", {self.unreadable}" if self.unreadable else ""
        return f"{printable(self.name)} ({printable(self.type).replace('/msg/', '/')}{why})"


# The topics asked for by role, None of a truth that is left out.
Given = dict[str, Topic | None]


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
        if types[0] not in KNOWN_TYPES:
            return Topic(name, " and ".join(types), count, fields=str(connections[0].msgdef.data))
        return Topic(name, " and ".join(types), count, next(filter(None, map(self._why_not, connections)), ""))

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
    remedy = (
        "if they are parts of one recording, let their names end in _0, _1 and so on, as rosbag record --split does"
        if of_ros1
        else "run ros2 bag reindex on the folder"
    )
    names = printable(", ".join(bag.name for bag in bags))[:200]
    raise DataError(
        f"{folder}: holds {len(bags)} bags and no {_METADATA} that joins them: {names}; name one of them, or {remedy}"
    )


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
            raise DataError(
                f"{path}: rosbags does not read such a bag ({why.removesuffix('; please report issue.')}); convert it "
                "with ros2 bag convert or rosbag decompress, or install a newer rosbags"
            ) from error
        of_folder = path.is_file() and _of_rosbag2(path.parent / _METADATA)
        remedy = f"name its folder, which has {_METADATA}, or copy it again" if of_folder else _REMEDY
        raise DataError(f"{path}: damaged, cut off, or a bag that cannot be read ({why}); {remedy}") from error


# Roles of topics -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Chosen:
    """The topics of a recording by role, None where there is none, and remarks on the choice.

    ``accel`` is there where the accelerometer has a topic by itself, and ``imu`` is the gyro's; ``moving`` are the
    transforms that may change, ``other_imus`` those that were not chosen, and ``like_imus`` those of types that are not
    read.
    """

    left: Topic
    right: Topic
    left_info: Topic | None
    right_info: Topic | None
    imu: Topic | None
    accel: Topic | None
    twist: Topic | None
    truth: Topic | None
    transforms: tuple[Topic, ...]
    moving: tuple[Topic, ...]
    other_imus: tuple[str, ...]
    other_twists: tuple[str, ...]
    like_imus: tuple[str, ...] = ()
    facts: tuple[str, ...] = ()

    @property
    def rectified(self) -> bool:
        """Whether the images come rectified, as ROS says it in the last words of a topic's name."""
        return any(_RECTIFIED in word for word in self.left.name.split("/")[-2:])


def choose(path: Path, topics: Sequence[Topic], requested: str | None) -> Chosen:
    """Return the topics by role; raises DataError where a requested one, or a pair of images, is missing."""
    given = _requested(path, topics, requested)
    usable = [topic for topic in topics if topic.type in KNOWN_TYPES and not topic.unreadable and topic.count]
    left, right = _pair(path, topics, usable, given)
    truth = given.get("truth", _truth(usable))
    imus = _of_types(usable, (IMU,))
    imu = given.get("imu") or (None if "twist" in given else _imu(imus))
    accel = given.get("accel") or _partner(imu, imus)
    odometry = [topic for topic in _of_types(usable, (ODOMETRY,)) if topic != truth]
    chosen = Chosen(
        left=left,
        right=right,
        left_info=given.get("left_info") or _info(usable, left),
        right_info=given.get("right_info") or _info(usable, right),
        imu=imu,
        accel=accel,
        twist=given.get("twist") or (None if imu else _most(odometry)),
        truth=truth,
        transforms=tuple(topic for topic in _of_types(usable, TRANSFORMS) if topic.name.endswith(_STATIC)),
        moving=tuple(topic for topic in _of_types(usable, TRANSFORMS) if topic.name.rpartition("/")[2] == _MOVING),
        other_imus=tuple(topic.name for topic in imus if topic not in (imu, accel)),
        other_twists=tuple(topic.name for topic in _of_types(usable, ROLES["twist"])),
        like_imus=tuple(str(one) for one in topics if one.is_like(_LIKE_IMU) or (one.type == IMU and one.unreadable)),
    )
    return replace(chosen, facts=_facts(topics, chosen, given))


def _requested(path: Path, topics: Sequence[Topic], requested: str | None) -> Given:
    """Return the topics asked for by role, as in left=/cam0/image_raw,imu=/imu0; None of a truth that is left out."""
    by_name = {topic.name: topic for topic in topics}
    given: Given = {}
    for part in filter(None, (text.strip() for text in (requested or "").split(","))):
        role, equals, name = (text.strip() for text in part.partition("="))
        if not equals or role not in ROLES:
            raise DataError(f"--topics: {no_such('role', role, ROLES)}; write left=/cam0/image_raw,right=...,imu=...")
        if (role, name) == ("truth", _NONE):
            given[role] = None
            continue
        if name not in by_name:
            raise DataError(f"{path}: {no_such('topic', name, by_name)}"[:_LONGEST])
        topic = by_name[name]
        if topic.type not in ROLES[role] or topic.unreadable:
            wanted = " or ".join(kind.replace("/msg/", "/") for kind in ROLES[role])
            raise DataError(f"{path}: {topic} cannot be {role}, which is {wanted}")
        if role in given:
            raise DataError(f"{path}: --topics names {role} twice; leave one out")
        given[role] = topic
    for left, right in (("left", "right"), ("left_info", "right_info")):
        same = given.get(left)
        if same is not None and same == given.get(right):
            raise DataError(f"{path}: --topics names {same.name} as {left} and {right}; a pair has a topic each")
    return given


def _pair(path: Path, topics: Sequence[Topic], usable: Sequence[Topic], given: Given) -> tuple[Topic, Topic]:
    left, right = given.get("left"), given.get("right")
    if left is not None and right is not None:
        return left, right
    images = [topic for topic in _of_types(usable, _IMAGES) if topic.count >= _LEAST_IMAGES]
    pairs = [(one, two) for one in images for two in images if _are_sides(one.name, two.name)]
    pairs = [(one, two) for one, two in pairs if given.get("left", one) == one and given.get("right", two) == two]
    if not pairs:
        raise DataError(_no_pair(path, topics, images))
    # Rectified images need no calibration of a lens; of raw and compressed ones raw ones are whole.
    return min(
        pairs, key=lambda pair: (_RECTIFIED not in pair[0].name, pair[0].type != IMAGE, -pair[0].count, pair[0].name)
    )


def _no_pair(path: Path, topics: Sequence[Topic], images: Sequence[Topic]) -> str:
    there = ", ".join(map(str, topics)) or "no topics"
    if not images:
        why = "holds no images that can be read, and the tracks are made of them"
        packed = [str(topic) for topic in topics if topic.is_like(_LIKE_IMAGES)]
        if packed:
            may = f"{' and '.join(packed)} may hold some"
            why += f"; {may}: write them as sensor_msgs/Image with image_transport republish"
    elif len(images) == 1:
        why = f"holds images of one camera, {images[0].name}, and the tracks are made of a stereo pair's"
    else:
        why = "no two topics of images are a stereo pair by their names; name them with --topics left=TOPIC,right=TOPIC"
    return f"{path}: {why}; there are {there}"[:_LONGEST]


def _alone(word: str) -> str:
    """Return the pattern of a word as a word of its own, letters and digits apart."""
    same_kind = r"\d" if word.isdigit() else r"[^\W\d_]"
    return rf"(?<!{same_kind}){word}(?!{same_kind})"


# What distinguishes the names of the two cameras of a pair, left first: as words of their own, or anywhere.
_SIDES = ((_alone("0"), "1"), (_alone("1"), "2"), (_alone("l"), "r"), ("left", "right"), ("Left", "Right"))


def _differ_by(one: str, two: str, pattern: str, other: str) -> bool:
    """Say whether a name becomes another where one place that a pattern fits is exchanged."""
    return two in (one[: at.start()] + other + one[at.end() :] for at in re.finditer(pattern, one))


def _are_sides(one: str, two: str) -> bool:
    """Say whether two names differ in nothing but the side of a pair, the left one first."""
    return any(_differ_by(one, two, left, right) for left, right in _SIDES)


def _imu(imus: Sequence[Topic]) -> Topic | None:
    """Return the IMU with the most messages; gyros whose accelerometers publish by themselves only for want of one."""
    gyros = [topic for topic in imus if _partner(topic, imus)]
    halves = {topic for gyro in gyros for topic in (gyro, _partner(gyro, imus))}
    return _most(topic for topic in imus if topic not in halves) or _most(gyros)


def _partner(gyro: Topic | None, imus: Sequence[Topic]) -> Topic | None:
    """Return the accelerometer that has the name of a gyro but for that word."""
    name = "" if gyro is None else gyro.name.lower()
    return next((topic for topic in imus if _differ_by(name, topic.name.lower(), _alone(_GYRO), _ACCEL)), None)


def _info(usable: Sequence[Topic], image: Topic) -> Topic | None:
    """Return the calibration that stands beside a topic of images, as ROS names it: in the same namespace."""
    base = image.name.removesuffix(_COMPRESSED_SUFFIX)
    infos = {topic.name: topic for topic in _of_types(usable, (CAMERA_INFO,))}
    namespace = base
    while namespace:
        namespace = namespace.rpartition("/")[0]
        for name in (f"{namespace}/camera_info", f"{namespace}/info/camera_info"):
            if name in infos:
                return infos[name]
    return None


def _truth(usable: Sequence[Topic]) -> Topic | None:
    words = re.compile("|".join(map(_alone, _OF_TRUTH)), re.IGNORECASE)
    return _most(topic for topic in _of_types(usable, _POSES) if words.search(topic.name))


def _of_types(topics: Iterable[Topic], types: tuple[str, ...]) -> list[Topic]:
    return [topic for topic in topics if topic.type in types]


def _most(topics: Iterable[Topic]) -> Topic | None:
    """Return the topic with the most messages, the first by name of several."""
    return max(sorted(topics, key=lambda topic: topic.name), key=lambda topic: topic.count, default=None)


def _facts(topics: Sequence[Topic], chosen: Chosen, given: Given) -> tuple[str, ...]:
    found = {role: topic for role in ROLES if (topic := getattr(chosen, role)) is not None}
    named = [f"{role} {topic.name}{'' if role in given else ' (guessed)'}" for role, topic in found.items()]
    used = {topic.name for topic in (*found.values(), *chosen.transforms)}
    left_out = [str(topic) for topic in topics if topic.name not in used]
    facts = [f"topics: {', '.join(named)}"]
    if left_out:
        facts.append(f"topics not used: {', '.join(left_out)}")
    return tuple(facts)
