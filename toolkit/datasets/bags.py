"""Bags of ROS 1 and ROS 2, and MCAP: stereo images, an IMU or an odometer, and perhaps a truth (extra ``bags``).

A ``.bag``, ``.mcap`` or ``.db3``, or the folder of a rosbag2. Topics are guessed from types and names, or said with
``--topics``; the facts tell which are what and which are not used. Tracks are made of the images.

Calibration is that beside the bag where there is any: Kalibr's camchain, or the sensor.yaml files of an ASL folder.
Otherwise lenses and baseline are those of the CameraInfo messages, and the camera stands on the body where /tf_static
has it. Poses of a truth are those of the IMU, or of a frame that /tf_static knows. Sources: REP 103 (camera axes), REP
104 (rectified images; the P of a right camera's CameraInfo has the baseline), REP 105 (frames).
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from toolkit.datasets.io import bag_reader as ros
from toolkit.datasets.io.bag_reader import Bag, Message, Topic, Tree
from toolkit.datasets.io.euroc_calibration import AS_STATED, NO_NOISE, kalibr_noise, lens_of, read_calibration
from toolkit.datasets.io.fields import camera_matrix, joined_imu
from toolkit.datasets.io.image_pairs import images_only, pairs_of_asl, pinhole_of, seen_in
from toolkit.datasets.io.truth import OF_POSITIONS, truth_near, with_truth
from toolkit.datasets.trajectories.covariances import ROS, CovConvention, StatedCovariances
from toolkit.datasets.trajectories.formats import PosesFile, checked_poses, known_poses, states_turns
from toolkit.errors import DataError, no_such
from toolkit.files.reading import is_regular
from toolkit.frontend import (
    Camera,
    ImageRecording,
    RectifiedPair,
    StampedPair,
    already_rectified,
    matched_corners,
    rectified,
)
from toolkit.frontend.cache import ImageSpool
from toolkit.geometry import Array, IntArray, se3
from toolkit.measurements import MotionNoise
from toolkit.models.noise import mems_imu, twist_noise
from toolkit.motion_samples import ImuSamples, MotionSamples, TwistSamples
from toolkit.progress import SILENT, Progress
from toolkit.sequence import Provenance, Truth
from toolkit.sequence import Sequence as Recording
from toolkit.settings import DEFAULTS, Frontend

HAS_TOPICS = True
# Images are rectified already where this many times as many corners meet their row as once the calibration is applied.
_CLEARLY = 2
_RECORD_ONE = (
    "convert the topic that measures the motion to sensor_msgs/Imu (m/s^2, rad/s; PX4's axes are x forward, y right, "
    "z down), or record one with the images"
)
_NAME_ANOTHER = "another topic with --topics imu=TOPIC, or an odometry with --topics twist=TOPIC"

uses_images = images_only


def recognises(path: Path) -> bool:
    """Say whether the path is a bag, from its first bytes or a folder's metadata.yaml."""
    return ros.kind_of(path) is not None


def load(path: Path) -> Recording:
    """Read a bag with the front end's default settings; see :func:`load_from_images`."""
    return load_from_images(path, DEFAULTS.frontend, SILENT)


def images_of(path: Path, frontend: Frontend) -> ImageRecording:
    """Return the image pairs within the motion's time and their cameras; raises as :func:`load_from_images`."""
    spool = ImageSpool(str(path))
    with spool.errors_named():
        mounted, pairs = _read(path, frontend, spool, SILENT)[:2]
    return ImageRecording(pairs, mounted.pair, spool)


def load_from_images(path: Path, frontend: Frontend, progress: Progress) -> Recording:
    """Read motion, calibration and truth, and make the tracks of the images within the motion's time.

    Raises DataError where the bag is damaged, rosbags is not installed, or something an estimator needs is missing.
    """
    spool = ImageSpool(str(path))
    try:
        with spool.errors_named():
            mounted, pairs, motion, truth, facts = _read(path, frontend, spool, progress)
        seen = seen_in(path, ImageRecording(pairs, mounted.pair, spool), mounted.T_imu_left, frontend, progress)
    finally:
        spool.close()
    sequence = Recording(
        name=path.resolve().stem,
        rig=seen.rig,
        noise=mounted.noise,
        frames_t_ns=seen.frames_t_ns,
        observations=seen.observations,
        motion=motion,
        provenance=Provenance("bags", f"{path}: stereo tracks from the images", (*seen.facts, *facts)),
    )
    return sequence if truth is None else with_truth(sequence, *truth_near(truth, seen.frames_t_ns))


def _read(
    path: Path, frontend: Frontend, spool: ImageSpool, progress: Progress
) -> tuple[Mounted, tuple[StampedPair, ...], MotionSamples, Truth | None, tuple[str, ...]]:
    """Return the cameras, the image pairs (in the spool), the motion, the truth, and what to know of them."""
    with ros.opened(path) as bag:
        chosen, topics = choose(path, bag.topics, frontend.topics)
        source = recorded(bag, chosen)
        motion, how_moved = _motion_of(source)
        camera = mounted(source, motion)
        truth, whose = _truth(source)
        unstamped = _spool_images(bag, chosen, spool, progress)
    listed = pairs_of_asl(spool.folder).shifted(camera.shift_s)
    if not listed.pairs:
        sides = f"no image of {chosen['left'].name} has one of {chosen['right'].name} within 1 ms"
        remedy = "synchronise the cameras, or correct the stamps"
        raise DataError(f"{path}: {sides} ({listed.stamps} left ones); {remedy}")
    remedy = "; stamp both by one, or name another topic with --topics imu=TOPIC"
    within = listed.within(path, motion.t_ns, "the samples of the motion", remedy)
    camera = _as_filmed(camera, within.pairs, frontend)
    facts = (*within.remarks, *unstamped, *how_moved, *whose, *topics, *camera.facts)
    return camera, within.pairs, motion, truth, facts


def _as_filmed(camera: Mounted, pairs: Sequence[StampedPair], frontend: Frontend) -> Mounted:
    """Return the calibration for images that may be rectified without a topic that says so: their rows decide.

    The bags that kitti2bag writes are such: the lenses of the cameras, and images that were rectified before.
    """
    if camera.as_they_are is None:
        return camera
    calibrated, as_they_are = (matched_corners(pairs, rig, frontend) for rig in (camera.pair, camera.as_they_are))
    if as_they_are <= _CLEARLY * calibrated:
        return camera
    rows = f"{as_they_are} corners have the same row in both as they are, and {calibrated} once rectified"
    fact = f"the images are rectified already: {rows} by the calibration"
    return replace(camera, pair=camera.as_they_are, facts=(*camera.facts, fact))


def _truth(source: Recorded) -> tuple[Truth | None, tuple[str, ...]]:
    """Return the poses of the body, and of what they are; another frame's are moved to it where the tree knows how."""
    topic, messages = source.chosen.get("truth"), source.of(source.chosen.get("truth"))
    if topic is None or not messages:
        return None, ()
    t_ns, rows, values = ros.poses_of(messages, topic.type)
    kept = known_poses(values)
    if not kept.any():
        return None, (f"no pose of {topic.name} is finite: it is left out, and there is no truth",)
    what, lost = Path(f"{source.path}: {topic.name}"), int((~kept).sum())
    T_world_child = checked_poses(what, rows[kept].tolist(), t_ns[kept], values[kept], "message")
    remarks = [f"{lost} of {kept.size} poses of {topic.name} are not finite and left out of the truth"] if lost else []
    body, child = source.body, ros.frame_name(getattr(messages[0].value, "child_frame_id", ""))
    T_child_body = source.tree.between(child, body)
    if not states_turns(values).any():
        remarks.append(f"{topic.name} states no orientation (quaternions of 0 or NaN): {OF_POSITIONS}")
    elif T_child_body is not None:
        T_world_child = T_world_child @ T_child_body
    elif child and child != body:
        unknown = f"the truth's poses are of {child!r}, which no transform connects to {body!r}"
        remarks.append(f"{unknown}: they are assumed to be the body's")
    return Truth(t_ns[kept], T_world_child), tuple(remarks)


def _spool_images(bag: Bag, chosen: Chosen, spool: ImageSpool, progress: Progress) -> tuple[str, ...]:
    """Write the images of both cameras as an ASL folder has them, the stamp the name; return what to know of stamps."""
    sides = {chosen["left"].name: "cam0", chosen["right"].name: "cam1"}
    for topic, camera in sides.items():
        spool.call(f"{camera}/data", f"{bag.path}: {topic}")
    types = {topic.name: topic.type for topic in (chosen["left"], chosen["right"])}
    total, unstamped = chosen["left"].count + chosen["right"].count, 0
    for done, message in enumerate(bag.messages(sides.keys())):
        what = f"{bag.path}: {message.topic}: message {done}"
        t_ns = ros.stamp_ns(message.value.header, message.t_ns)
        unstamped += not ros.is_stamped(message.value.header)
        name = f"{sides[message.topic]}/data/{t_ns}"
        if types[message.topic] == ros.COMPRESSED:
            ending, content = ros.image_file(message.value, what)
            spool.add(name + ending, content)
        else:
            spool.add_grey(name, ros.grey(message.value, what))
        progress.advance(done + 1, max(total, done + 1), "unpacking images")
    return (f"{unstamped} images have no stamp, and the time of recording is used",) if unstamped else ()


def _motion_of(source: Recorded) -> tuple[MotionSamples, tuple[str, ...]]:
    imu, accel = source.chosen.get("imu"), source.chosen.get("accel")
    if imu is None:
        return _twists(source), ()
    t_ns, gyro = _measured(source, imu, "angular velocity")
    if accel is not None:
        return _joined(source, (imu, t_ns, gyro), accel)
    return ImuSamples(t_ns, _measured(source, imu, "acceleration")[1], gyro), ()


def _twists(source: Recorded) -> TwistSamples:
    path, topic = source.path, source.chosen.get("twist")
    if topic is None:
        others = ", ".join(one.name for one in _usable(source.topics, ROLES["twist"]))
        remedy = f"{_RECORD_ONE}; {_there_are(source.topics)}"
        remedy = f"name one with --topics twist=TOPIC ({others})" if others else remedy
        why = "no sensor_msgs/Imu and no nav_msgs/Odometry that can be read"
        raise DataError(f"{path}: {why}; {remedy}"[:_LONGEST])
    messages = _messages_of(source, topic)
    values = [message.value for message in messages]
    linear, angular = (ros.columns(values, part) for part in ros.VECTORS[topic.type])
    if not (linear.any() or angular.any()):
        raise DataError(f"{path}: {topic.name} states no twist (all are 0); name {_NAME_ANOTHER}")
    return TwistSamples(ros.stamps_ns(messages), linear, angular)


def _joined(source: Recorded, gyro: tuple[Topic, IntArray, Array], accel: Topic) -> tuple[ImuSamples, tuple[str, ...]]:
    """Return the samples of a gyro with the accelerometer's, which has other stamps, interpolated at its own."""
    imu, gyro_t_ns, rates = gyro
    t_ns, values = _measured(source, accel, "acceleration")
    T_gyro_accel = source.tree.between(source.frame_of(imu), source.frame_of(accel))
    values = values if T_gyro_accel is None else values @ T_gyro_accel[:3, :3].T
    joined = joined_imu((gyro_t_ns, rates), (t_ns, values))
    if joined is None:
        raise DataError(f"{source.path}: {imu.name} and {accel.name} have no time in common; name {_NAME_ANOTHER}")
    fact = f"{t_ns.size} samples of {accel.name} are interpolated at the {joined.t_ns.size} of {imu.name}"
    return joined, (fact,)


def _messages_of(source: Recorded, topic: Topic) -> Sequence[Message]:
    if messages := source.of(topic):
        return messages
    raise DataError(f"{source.path}: {topic.name} has no message; name another topic with --topics")


def _measured(source: Recorded, topic: Topic, what: str) -> tuple[IntArray, Array]:
    messages = _messages_of(source, topic)
    part = ros.VECTORS[topic.type][what == "acceleration"]
    values = ros.columns([message.value for message in messages], part)
    # A covariance of -1 says that a value is absent.
    if not values.any() or getattr(messages[0].value, f"{part}_covariance").ravel()[0] == -1.0:
        apart = "the accelerometer's topic with --topics accel=TOPIC, " if what == "acceleration" else ""
        why = f"measures no {what} (its values are 0 or marked as absent)"
        raise DataError(f"{source.path}: {topic.name} {why}; name {apart}{_NAME_ANOTHER}")
    return ros.stamps_ns(messages), values


# Roles of topics -----------------------------------------------------------------------------------------------------

_IMAGES, _TRUTHS = (ros.IMAGE, ros.COMPRESSED), (ros.ODOMETRY, ros.POSE, ros.POSE_COV, ros.TRANSFORM)
ROLES: dict[str, tuple[str, ...]] = {
    "left": _IMAGES,
    "right": _IMAGES,
    "left_info": (ros.CAMERA_INFO,),
    "right_info": (ros.CAMERA_INFO,),
    "imu": (ros.IMU,),
    "accel": (ros.IMU,),
    "twist": (ros.ODOMETRY, ros.TWIST, ros.TWIST_COV),
    # A point is taken for a truth only where it is said: it may be a goal.
    "truth": (*_TRUTHS, ros.POINT),
}
# Of a sensor that publishes both by themselves, as RealSense's cameras do.
_GYRO, _ACCEL = "gyro", "accel"
_STATIC, _MOVING, _RECTIFIED, _LEAST_IMAGES = "tf_static", "tf", "rect", 2
# Of a message that lists the topics of a bag, which may be hundreds.
_LONGEST = 900
_COMPRESSED_SUFFIX = "/compressed"
# The topics asked for by role, None of a truth that is left out.
Given = dict[str, Topic | None]
# The topics of a recording by role. Where the accelerometer has one by itself, as ``accel``, ``imu`` is the gyro's.
Chosen = Mapping[str, Topic]


def choose(path: Path, topics: Sequence[Topic], requested: str | None) -> tuple[Chosen, tuple[str, ...]]:
    """Return the topics by role, and which these are and which not used.

    Raises DataError where a requested one, or a pair of images, is missing.
    """
    given = _requested(path, topics, requested)
    left, right = _stereo(path, topics, given)
    imus = _usable(topics, (ros.IMU,))
    imu = given.get("imu") or (None if "twist" in given else _imu(imus))
    truth = given.get("truth", _most(one for one in _usable(topics, _TRUTHS) if _OF_TRUTH.search(one.name)))
    odometry = [topic for topic in _usable(topics, (ros.ODOMETRY,)) if topic != truth]
    found = {
        "left": left,
        "right": right,
        "left_info": given.get("left_info") or _info(topics, left),
        "right_info": given.get("right_info") or _info(topics, right),
        "imu": imu,
        "accel": given.get("accel") or _partner(imu, imus),
        "twist": given.get("twist") or (None if imu else _most(odometry)),
        "truth": truth,
    }
    chosen = {role: topic for role, topic in found.items() if topic is not None}
    named = [f"{role} {topic.name}{'' if role in given else ' (guessed)'}" for role, topic in chosen.items()]
    used = {topic.name for topic in (*chosen.values(), *_transforms(topics, _STATIC))}
    left_out = ", ".join(str(topic) for topic in topics if topic.name not in used)
    facts = (f"topics: {', '.join(named)}", *((f"topics not used: {left_out}",) if left_out else ()))
    return chosen, facts


def _transforms(topics: Sequence[Topic], name: str) -> list[Topic]:
    """Return the topics of transforms whose last word is a name: tf_static, or tf, which may change."""
    return [one for one in _usable(topics, ros.TRANSFORMS) if one.name.rpartition("/")[2] == name]


def _requested(path: Path, topics: Sequence[Topic], requested: str | None) -> Given:
    """Return the topics asked for by role, as in left=/cam0/image_raw,imu=/imu0; None of a truth that is left out."""
    by_name = {topic.name: topic for topic in topics}
    given: Given = {}
    for part in filter(None, (text.strip() for text in (requested or "").split(","))):
        role, equals, name = (text.strip() for text in part.partition("="))
        if not equals or role not in ROLES:
            raise DataError(f"--topics: {no_such('role', role, ROLES)}; write left=/cam0/image_raw,right=...,imu=...")
        if (role, name) == ("truth", "none"):
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


def _stereo(path: Path, topics: Sequence[Topic], given: Given) -> tuple[Topic, Topic]:
    left, right = given.get("left"), given.get("right")
    if left is not None and right is not None:
        return left, right
    images = [topic for topic in _usable(topics, _IMAGES) if topic.count >= _LEAST_IMAGES]
    both = ((one, two) for one in images for two in images)
    pairs = [(one, two) for one, two in both if any(_differ_by(one.name, two.name, *side) for side in _SIDES)]
    pairs = [(one, two) for one, two in pairs if given.get("left", one) == one and given.get("right", two) == two]
    if not pairs:
        raise DataError(_no_pair(path, topics, images))
    # Rectified images need no calibration of a lens; of raw and compressed ones raw ones are whole.
    return min(
        pairs,
        key=lambda pair: (_RECTIFIED not in pair[0].name, pair[0].type != ros.IMAGE, -pair[0].count, pair[0].name),
    )


def _no_pair(path: Path, topics: Sequence[Topic], images: Sequence[Topic]) -> str:
    if not images:
        why = "holds no images that can be read; write them as sensor_msgs/Image, as image_transport republish does"
    elif len(images) == 1:
        why = f"holds images of one camera, {images[0].name}, and the tracks are made of a stereo pair's"
    else:
        why = "no two topics of images are a stereo pair by their names; name them with --topics left=TOPIC,right=TOPIC"
    return f"{path}: {why}; {_there_are(topics)}"[:_LONGEST]


def _there_are(topics: Sequence[Topic]) -> str:
    """Return a list of topics, first those that are not read, which may hold what lacks."""
    in_order = sorted(topics, key=lambda topic: topic.type in ros.KNOWN_TYPES and not topic.unreadable)
    return f"there are {', '.join(map(str, in_order)) or 'no topics'}"


def _alone(word: str) -> str:
    """Return the pattern of a word as a word of its own, letters and digits apart."""
    same_kind = r"\d" if word.isdigit() else r"[^\W\d_]"
    return rf"(?<!{same_kind}){word}(?!{same_kind})"


# In the name of a topic whose poses are a truth, and not another system's estimate.
_TRACKERS = ("truth", "gt", "groundtruth", "vicon", "mocap", "optitrack", "qualisys", "vrpn", "leica")
_OF_TRUTH = re.compile("|".join(map(_alone, _TRACKERS)), re.IGNORECASE)
# What distinguishes the names of the two cameras of a pair, left first: as words of their own, or anywhere.
_SIDES = ((_alone("0"), "1"), (_alone("1"), "2"), (_alone("l"), "r"), ("left", "right"), ("Left", "Right"))


def _differ_by(one: str, two: str, pattern: str, other: str) -> bool:
    """Say whether a name becomes another where one place that a pattern fits is exchanged."""
    return two in (one[: at.start()] + other + one[at.end() :] for at in re.finditer(pattern, one))


def _imu(imus: Sequence[Topic]) -> Topic | None:
    """Return the IMU with the most messages; gyros whose accelerometers publish by themselves only for want of one."""
    gyros = [topic for topic in imus if _partner(topic, imus)]
    halves = {topic for gyro in gyros for topic in (gyro, _partner(gyro, imus))}
    return _most(topic for topic in imus if topic not in halves) or _most(gyros)


def _partner(gyro: Topic | None, imus: Sequence[Topic]) -> Topic | None:
    """Return the accelerometer that has the name of a gyro but for that word."""
    name = "" if gyro is None else gyro.name.lower()
    return next((topic for topic in imus if _differ_by(name, topic.name.lower(), _alone(_GYRO), _ACCEL)), None)


def _info(topics: Sequence[Topic], image: Topic) -> Topic | None:
    """Return the calibration that stands beside a topic of images, as ROS names it: in the same namespace."""
    base = image.name.removesuffix(_COMPRESSED_SUFFIX)
    infos = {topic.name: topic for topic in _usable(topics, (ros.CAMERA_INFO,))}
    namespace = base
    while namespace:
        namespace = namespace.rpartition("/")[0]
        for name in (f"{namespace}/camera_info", f"{namespace}/info/camera_info"):
            if name in infos:
                return infos[name]
    return None


def _usable(topics: Iterable[Topic], types: tuple[str, ...]) -> list[Topic]:
    return [topic for topic in topics if topic.type in types and topic.count and not topic.unreadable]


def _most(topics: Iterable[Topic]) -> Topic | None:
    """Return the topic with the most messages, the first by name of several."""
    return max(sorted(topics, key=lambda topic: topic.name), key=lambda topic: topic.count, default=None)


# Calibration ---------------------------------------------------------------------------------------------------------

_PUT_BESIDE = "put Kalibr's camchain.yaml or an ASL folder's cam0/sensor.yaml beside the bag"


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
    topics: Sequence[Topic]
    chosen: Chosen
    held: Mapping[str, Sequence[Message]]
    tree: Tree
    in_tf: bool = False

    def of(self, topic: Topic | None) -> Sequence[Message]:
        return () if topic is None else self.held.get(topic.name, ())

    def frame_of(self, topic: Topic | None, *, of_child: bool = False) -> str:
        """Return the frame of a topic's first message; of an odometry that of the child, which its twist is in."""
        if not self.of(topic):
            return ""
        value = self.of(topic)[0].value
        child = getattr(value, "child_frame_id", "") if of_child else ""
        return ros.frame_name(child or value.header.frame_id)

    @property
    def body(self) -> str:
        """The frame of the IMU, or the one whose twists are measured."""
        imu = self.chosen.get("imu")
        return self.frame_of(self.chosen.get("twist"), of_child=True) if imu is None else self.frame_of(imu)

    @property
    def T_imu_left(self) -> Array | None:
        return self.tree.between(self.body, self.frame_of(self.chosen["left"]))


def recorded(bag: Bag, chosen: Chosen) -> Recorded:
    """Read what a bag holds but its images; /tf is read where /tf_static does not join the body and the camera."""
    fixed, changing = _transforms(bag.topics, _STATIC), _transforms(bag.topics, _MOVING)
    wanted = (*map(chosen.get, ("imu", "accel", "twist", "truth")), *fixed)
    held: dict[str, list[Message]] = {}
    for message in bag.messages({topic.name for topic in wanted if topic is not None}):
        held.setdefault(message.topic, []).append(message)
    for topic in map(chosen.get, ("left_info", "right_info", "left", "right")):
        if topic is not None:
            held[topic.name] = list(islice(bag.messages({topic.name}), 1))
    static = [one for topic in fixed for message in held.get(topic.name, ()) for one in message.value.transforms]
    found = Recorded(bag.path, bag.topics, chosen, held, Tree(static))
    if not changing or found.T_imu_left is not None:
        return found
    moving = (one for message in bag.messages({topic.name for topic in changing}) for one in message.value.transforms)
    by_tf = replace(found, tree=Tree([*ros.fixed(moving), *static]), in_tf=True)
    return found if by_tf.T_imu_left is None else by_tf


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
    T_imu_left, left = source.T_imu_left, source.frame_of(source.chosen["left"])
    # An IMU does not have the axes of a camera: if both name the same frame, the name is wrong for one of them.
    if T_imu_left is None or (source.chosen.get("imu") is not None and source.body == left):
        raise DataError(_not_joined(source))
    pair, as_they_are, how = _pair(source)
    stated = kalibr_noise(*_folders_beside(source.path))
    noise = () if twist else (NO_NOISE if stated is None else AS_STATED,)
    tf = "the transforms of /tf that never change" if source.in_tf else "/tf_static"
    notes = (f"calibration from {how} and {tf}", *noise)
    return Mounted(pair, T_imu_left, twist or (stated[0] if stated else mems_imu()), notes, as_they_are)


def _not_joined(source: Recorded) -> str:
    frames = f"{source.body!r} and {source.frame_of(source.chosen['left'])!r}"
    others = [one.name for one in _usable(source.topics, (ros.IMU,)) if one not in source.chosen.values()]
    other = f", or name another Imu with --topics imu=TOPIC ({', '.join(others)})" if others else ""
    tf = "/tf_static and no fixed transform of /tf" if _transforms(source.topics, _MOVING) else "/tf_static"
    why = f"the camera's pose on the body is unknown: no {tf} connects the frames {frames}"
    return f"{source.path}: {why}; {_PUT_BESIDE}{other}"


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
    T_right_left = source.tree.between(*(source.frame_of(source.chosen[side]) for side in ("right", "left")))
    # As ROS says it in the last words of a topic's name.
    if any(_RECTIFIED in word for word in source.chosen["left"].name.split("/")[-2:]):
        if not baseline_m > 0.0 and T_right_left is not None:
            baseline_m = float(np.linalg.norm(T_right_left[:3, 3]))
        if not (baseline_m > 0.0 and pinhole_px[0] > 0.0):
            lacks = "no baseline (Tx is 0), and no /tf_static joins the two cameras"
            lacks = lacks if pinhole_px[0] > 0.0 else "no focal length"
            remedy = f"correct P, or {_PUT_BESIDE} and name the raw images"
            raise DataError(f"{what[1]}: the images are rectified, and P states {lacks}; {remedy}")
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
    found = {side: source.chosen.get(f"{side}_info") for side in ("left", "right")}
    for side, topic in found.items():
        if not source.of(topic):
            lacking = f"there is no sensor_msgs/CameraInfo beside {source.chosen[side].name}"
            remedy = f"name it with --topics left_info=TOPIC,right_info=TOPIC, or {_PUT_BESIDE}"
            raise DataError(f"{source.path}: {lacking}; {remedy}")
    topics = [topic for topic in found.values() if topic is not None]
    return topics, [source.of(topic)[0].value for topic in topics]


# Trajectories --------------------------------------------------------------------------------------------------------

_WITH_COVARIANCES = (ros.ODOMETRY, ros.POSE_COV)
_OF_POSES = (*_WITH_COVARIANCES, ros.POSE, ros.TRANSFORM)


def read_topic(path: Path, name: str | None, cov_convention: CovConvention | None = None) -> PosesFile:
    """Read the poses of a topic of a bag, of the only one where none is named, with the covariances it has.

    The convention of covariances is ROS's (position first, turns about the fixed axes) unless another is given, for
    programs that write theirs into ROS's messages. Raises DataError where the bag is damaged, rosbags is not installed,
    or it has no such topic.
    """
    with ros.opened(path) as bag:
        topic = _topic_of_poses(path, bag.topics, name)
        messages = list(bag.messages({topic.name}))
    t_ns, rows, values = ros.poses_of(messages, topic.type)
    T_world_body = checked_poses(Path(f"{path}: {topic.name}"), rows.tolist(), t_ns, values)
    stated = None
    if topic.type in _WITH_COVARIANCES:
        cov = np.array([messages[row].value.pose.covariance for row in rows.tolist()], dtype=float).reshape(-1, 6, 6)
        cov = 0.5 * (cov + np.swapaxes(cov, 1, 2))
        # A covariance of zeros, or of -1, says that there is none.
        unknown = (np.einsum("nii->ni", cov) <= 0.0).all(axis=1)
        cov[unknown] = np.nan
        stated = None if unknown.all() else StatedCovariances(cov, None)
    file = PosesFile(path, f"{topic.type.replace('/msg/', '/')} of a bag", t_ns, T_world_body, None, stated)
    return file.with_convention(cov_convention or ROS)


def _topic_of_poses(path: Path, topics: Sequence[Topic], name: str | None) -> Topic:
    usable = [topic for topic in topics if topic.type in _OF_POSES and topic.count and not topic.unreadable]
    by_name = {topic.name: topic for topic in usable}
    if name in by_name:
        return by_name[name]
    if name is not None:
        raise DataError(f"{path}: {no_such('topic of poses', name, by_name)}")
    for of_kind in ([topic for topic in usable if topic.type in _WITH_COVARIANCES], usable):
        if len(of_kind) == 1:
            return of_kind[0]
    there = ", ".join(map(str, usable)) or "none"
    raise DataError(f"{path}: name the topic of the poses, as in {path.name}:/odom; there are {there}")
