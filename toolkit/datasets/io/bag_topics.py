"""Assigns the topics of a bag to their roles: as given with ``--topics``, else guessed from types and names."""

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from toolkit.datasets.io.bag_reader import (
    CAMERA_INFO,
    COMPRESSED,
    IMAGE,
    IMU,
    KNOWN_TYPES,
    ODOMETRY,
    POSE,
    POSE_COV,
    TRANSFORM,
    TRANSFORMS,
    TWIST,
    TWIST_COV,
    Topic,
)
from toolkit.errors import DataError, no_such

_IMAGES, _POSES = (IMAGE, COMPRESSED), (ODOMETRY, POSE, POSE_COV, TRANSFORM)
ROLES: dict[str, tuple[str, ...]] = {
    "left": _IMAGES,
    "right": _IMAGES,
    "left_info": (CAMERA_INFO,),
    "right_info": (CAMERA_INFO,),
    "imu": (IMU,),
    "accel": (IMU,),
    "twist": (ODOMETRY, TWIST, TWIST_COV),
    "truth": _POSES,
}
# What distinguishes the names of the two cameras of a pair, left first: as words of their own, or anywhere.
_SIDES = (("0", "1"), ("1", "2"), ("l", "r"))
_SIDES_ANYWHERE = (("left", "right"), ("Left", "Right"))
# Of a sensor that publishes both by themselves, as RealSense's cameras do.
_GYRO, _ACCEL = "gyro", "accel"
# In the name of a topic whose poses are a truth, and not another system's estimate.
_OF_TRUTH = ("truth", "gt", "groundtruth", "vicon", "mocap", "optitrack", "qualisys", "vrpn", "leica")
_STATIC, _MOVING, _RECTIFIED, _LEAST_IMAGES = "tf_static", "tf", "rect", 2
# Of a message that lists the topics of a bag, which may be hundreds.
_LONGEST = 900
_COMPRESSED_SUFFIX = "/compressed"


@dataclass(frozen=True)
class Chosen:
    """The topics of a recording by role, None where there is none, and remarks on the choice.

    ``accel`` is there where the accelerometer has a topic by itself, and ``imu`` is the gyro's; ``moving`` are the
    transforms that may change, and ``other_imus`` those that were not chosen.
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
    truth = given.get("truth") or _truth(usable)
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
    )
    return replace(chosen, facts=_facts(topics, chosen, given))


def _requested(path: Path, topics: Sequence[Topic], requested: str | None) -> dict[str, Topic]:
    """Return the topics asked for by role, as in left=/cam0/image_raw,imu=/imu0."""
    by_name, given = {topic.name: topic for topic in topics}, {}
    for part in filter(None, (text.strip() for text in (requested or "").split(","))):
        role, equals, name = (text.strip() for text in part.partition("="))
        if not equals or role not in ROLES:
            raise DataError(f"--topics: {no_such('role', role, ROLES)}; write left=/cam0/image_raw,right=...,imu=...")
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
        if left in given and given[left] == given.get(right):
            raise DataError(f"{path}: --topics names {given[left].name} as {left} and {right}; a pair has a topic each")
    return given


def _pair(path: Path, topics: Sequence[Topic], usable: Sequence[Topic], given: dict[str, Topic]) -> tuple[Topic, Topic]:
    """Return the topics of the left and the right images."""
    if "left" in given and "right" in given:
        return given["left"], given["right"]
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
    """Return the message for a bag in which no two topics of images are a pair by their names."""
    there = ", ".join(map(str, topics)) or "no topics"
    if not images:
        why = "holds no images that can be read, and the tracks are made of them"
    elif len(images) == 1:
        why = f"holds images of one camera, {images[0].name}, and the tracks are made of a stereo pair's"
    else:
        why = "no two topics of images are a stereo pair by their names; name them with --topics left=TOPIC,right=TOPIC"
    return f"{path}: {why}; there are {there}"[:_LONGEST]


def _are_sides(one: str, two: str) -> bool:
    """Say whether two names differ in nothing but the side of a pair, the left one first."""
    return any(_differ_by(one, two, left, right) for left, right in _SIDES) or any(
        two in (one[: at.start()] + right + one[at.end() :] for at in re.finditer(left, one))
        for left, right in _SIDES_ANYWHERE
    )


def _differ_by(one: str, two: str, word: str, other: str) -> bool:
    """Say whether a name becomes another where a word in it is exchanged."""
    return two in (one[:at] + other + one[at + len(word) :] for at in _places(one, word))


def _imu(imus: Sequence[Topic]) -> Topic | None:
    """Return the IMU with the most messages; gyros whose accelerometers publish by themselves only for want of one."""
    gyros = [topic for topic in imus if _partner(topic, imus)]
    halves = {topic for gyro in gyros for topic in (gyro, _partner(gyro, imus))}
    return _most(topic for topic in imus if topic not in halves) or _most(gyros)


def _partner(gyro: Topic | None, imus: Sequence[Topic]) -> Topic | None:
    """Return the accelerometer that has the name of a gyro but for that word."""
    if gyro is None:
        return None
    return next((topic for topic in imus if _differ_by(gyro.name.lower(), topic.name.lower(), _GYRO, _ACCEL)), None)


def _places(text: str, part: str) -> Iterable[int]:
    """Yield where a part stands in a text as a word of its own, letters and digits apart."""
    at = text.find(part)
    while at >= 0:
        before, after = text[at - 1 : at], text[at + len(part) : at + len(part) + 1]
        same_kind = str.isdigit if part.isdigit() else str.isalpha
        if not (same_kind(before) or same_kind(after)):
            yield at
        at = text.find(part, at + 1)


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
    named = [topic for topic in _of_types(usable, _POSES) if any(_has_word(topic.name, word) for word in _OF_TRUTH)]
    return _most(named)


def _has_word(name: str, word: str) -> bool:
    return any(True for _ in _places(name.lower(), word))


def _of_types(topics: Iterable[Topic], types: tuple[str, ...]) -> list[Topic]:
    return [topic for topic in topics if topic.type in types]


def _most(topics: Iterable[Topic]) -> Topic | None:
    """Return the topic with the most messages, the first by name of several."""
    return max(sorted(topics, key=lambda topic: topic.name), key=lambda topic: topic.count, default=None)


def _facts(topics: Sequence[Topic], chosen: Chosen, given: dict[str, Topic]) -> tuple[str, ...]:
    """Return remarks on the topics by role, given or guessed, and on those that are not used."""
    found = {role: topic for role in ROLES if (topic := getattr(chosen, role)) is not None}
    named = [f"{role} {topic.name}{'' if role in given else ' (guessed)'}" for role, topic in found.items()]
    used = {topic.name for topic in (*found.values(), *chosen.transforms)}
    left_out = [str(topic) for topic in topics if topic.name not in used]
    facts = [f"topics: {', '.join(named)}"]
    if left_out:
        facts.append(f"topics not used: {', '.join(left_out)}")
    return tuple(facts)
