"""Which topics of a bag are what: as asked for with ``--topics``, else guessed from their types and names."""

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
    TRANSFORM,
    TRANSFORMS,
    Topic,
)
from toolkit.errors import DataError, no_such

_IMAGES, _POSES = (IMAGE, COMPRESSED), (ODOMETRY, POSE, TRANSFORM)
ROLES: dict[str, tuple[str, ...]] = {
    "left": _IMAGES,
    "right": _IMAGES,
    "left_info": (CAMERA_INFO,),
    "right_info": (CAMERA_INFO,),
    "imu": (IMU,),
    "twist": (ODOMETRY,),
    "truth": _POSES,
}
# What distinguishes the names of the two cameras of a pair, left first.
_SIDES = (("left", "right"), ("0", "1"), ("1", "2"), ("l", "r"), ("Left", "Right"))
# In the name of a topic whose poses are a truth, and not another system's estimate.
_OF_TRUTH = ("truth", "gt", "groundtruth", "vicon", "mocap", "optitrack", "qualisys", "leica")
_STATIC, _RECTIFIED, _LEAST_IMAGES = "tf_static", "rect", 2
# Of a message that lists the topics of a bag, which may be hundreds.
_LONGEST = 900
_COMPRESSED_SUFFIX = "/compressed"


@dataclass(frozen=True)
class Chosen:
    """The topics of a recording by what they are; None where there is none, and what must be known of the choice."""

    left: Topic
    right: Topic
    left_info: Topic | None
    right_info: Topic | None
    imu: Topic | None
    twist: Topic | None
    truth: Topic | None
    transforms: tuple[Topic, ...]
    facts: tuple[str, ...] = ()

    @property
    def rectified(self) -> bool:
        """Whether the images come rectified, as ROS says it in the last words of a topic's name."""
        return any(_RECTIFIED in word for word in self.left.name.split("/")[-2:])


def choose(path: Path, topics: Sequence[Topic], asked: str | None) -> Chosen:
    """Return which topics are what; raises DataError where one asked for, or a pair of images, is not there."""
    given = _asked(path, topics, asked)
    usable = [topic for topic in topics if topic.type in KNOWN_TYPES and not topic.unreadable and topic.count]
    left, right = _pair(path, topics, usable, given)
    truth = given.get("truth") or _truth(usable)
    imu = given.get("imu") or (None if "twist" in given else _most(_of_types(usable, (IMU,))))
    odometry = [topic for topic in _of_types(usable, (ODOMETRY,)) if topic != truth]
    chosen = Chosen(
        left=left,
        right=right,
        left_info=given.get("left_info") or _info(usable, left),
        right_info=given.get("right_info") or _info(usable, right),
        imu=imu,
        twist=given.get("twist") or (None if imu else _most(odometry)),
        truth=truth,
        transforms=tuple(topic for topic in _of_types(usable, (TRANSFORMS,)) if topic.name.endswith(_STATIC)),
    )
    return replace(chosen, facts=_facts(topics, chosen, given))


def _asked(path: Path, topics: Sequence[Topic], asked: str | None) -> dict[str, Topic]:
    """Return the topics asked for by role, as in left=/cam0/image_raw,imu=/imu0."""
    by_name, given = {topic.name: topic for topic in topics}, {}
    for part in filter(None, (text.strip() for text in (asked or "").split(","))):
        role, equals, name = (text.strip() for text in part.partition("="))
        if not equals or role not in ROLES:
            raise DataError(f"--topics: {no_such('role', role, ROLES)}; write left=/cam0/image_raw,right=...,imu=...")
        if name not in by_name:
            raise DataError(f"{path}: {no_such('topic', name, by_name)}"[:_LONGEST])
        topic = by_name[name]
        if topic.type not in ROLES[role] or topic.unreadable:
            wanted = " or ".join(kind.replace("/msg/", "/") for kind in ROLES[role])
            raise DataError(f"{path}: {topic} cannot be {role}, which is {wanted}")
        given[role] = topic
    return given


def _pair(path: Path, topics: Sequence[Topic], usable: Sequence[Topic], given: dict[str, Topic]) -> tuple[Topic, Topic]:
    """Return the topics of the left and the right images."""
    if "left" in given and "right" in given:
        return given["left"], given["right"]
    images = [topic for topic in _of_types(usable, _IMAGES) if topic.count >= _LEAST_IMAGES]
    pairs = [(one, two) for one in images for two in images if _are_sides(one.name, two.name)]
    pairs = [(one, two) for one, two in pairs if given.get("left", one) == one and given.get("right", two) == two]
    if not pairs:
        there = ", ".join(map(str, topics)) or "nothing"
        raise DataError(
            f"{path}: no two topics of images are a stereo pair by their names; say which with --topics "
            f"left=TOPIC,right=TOPIC; there are {there}"[:_LONGEST]
        )
    # Rectified images need no calibration of a lens; of raw and compressed ones raw ones are whole.
    return min(
        pairs, key=lambda pair: (_RECTIFIED not in pair[0].name, pair[0].type != IMAGE, -pair[0].count, pair[0].name)
    )


def _are_sides(one: str, two: str) -> bool:
    """Say whether two names differ in nothing but the side of a pair, the left one first."""
    return one != two and any(
        two in (one[:at] + right + one[at + len(left) :] for at in _places(one, left)) for left, right in _SIDES
    )


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
        if f"{namespace}/camera_info" in infos:
            return infos[f"{namespace}/camera_info"]
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
    """Return which topics are what, said or guessed, and those that are not used."""
    found = {role: topic for role in ROLES if (topic := getattr(chosen, role)) is not None}
    named = [f"{role} {topic.name}{'' if role in given else ' (guessed)'}" for role, topic in found.items()]
    used = {topic.name for topic in (*found.values(), *chosen.transforms)}
    left_out = [str(topic) for topic in topics if topic.name not in used]
    facts = [f"topics: {', '.join(named)}"]
    if left_out:
        facts.append(f"topics not used: {', '.join(left_out)}")
    return tuple(facts)
