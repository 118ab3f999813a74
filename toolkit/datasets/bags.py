"""Bags of ROS 1 and ROS 2, and MCAP: stereo images, an IMU or an odometer, and perhaps a truth (extra ``bags``).

A ``.bag``, ``.mcap`` or ``.db3``, or the folder of a rosbag2. Topics are guessed from types and names, or said with
``--topics``; the facts tell which are what and which are not used. Tracks are made of the images.

Calibration is that beside the bag where there is any: Kalibr's camchain, or the sensor.yaml files of an ASL folder.
Otherwise lenses and baseline are those of the CameraInfo messages, and the camera stands on the body where /tf_static
has it. Poses of a truth are those of the IMU, or of a frame that /tf_static knows.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from toolkit.datasets.io import bag_reader, ros_values
from toolkit.datasets.io.bag_reader import COMPRESSED, Bag, Chosen, Message, Topic, choose
from toolkit.datasets.io.fields import check_frame_count, joined_imu
from toolkit.datasets.io.image_pairs import Listed, images_only, pairs_of_asl, seen_in
from toolkit.datasets.io.ros_values import Mounted, Recorded, mounted, recorded
from toolkit.datasets.io.truth import OF_POSITIONS, truth_near, with_truth
from toolkit.datasets.trajectories.covariances import ROS, CovConvention, StatedCovariances
from toolkit.datasets.trajectories.formats import PosesFile, checked_poses, known_poses, states_turns
from toolkit.errors import DataError, no_such
from toolkit.frontend import ImageRecording, StampedPair, matched_corners
from toolkit.frontend.cache import ImageSpool
from toolkit.geometry import Array, IntArray
from toolkit.measurements import NS_PER_S
from toolkit.motion_samples import ImuSamples, MotionSamples, TwistSamples
from toolkit.progress import SILENT, Progress
from toolkit.sequence import Provenance, Truth
from toolkit.sequence import Sequence as Recording
from toolkit.settings import DEFAULTS, Frontend

HAS_TOPICS = True
# Images are rectified already where this many times as many corners meet their row as once the calibration is applied.
_CLEARLY = 2
_NAME_ANOTHER = "another topic with --topics imu=TOPIC, or an odometry with --topics twist=TOPIC"

uses_images = images_only


def recognises(path: Path) -> bool:
    """Say whether the path is a bag, from its first bytes or a folder's metadata.yaml."""
    return bag_reader.kind_of(path) is not None


def load(path: Path) -> Recording:
    """Read a bag with the front end's default settings; see :func:`load_from_images`."""
    return load_from_images(path, DEFAULTS.frontend, SILENT)


def images_of(path: Path, frontend: Frontend) -> ImageRecording:
    """Return the image pairs within the motion's time and their cameras; raises as :func:`load_from_images`."""
    spool = ImageSpool(str(path))
    with spool.errors_named():
        filmed = _read(path, frontend, spool, SILENT)
    return ImageRecording(filmed.pairs, filmed.mounted.pair, spool)


def load_from_images(path: Path, frontend: Frontend, progress: Progress) -> Recording:
    """Read motion, calibration and truth, and make the tracks of the images within the motion's time.

    Raises DataError where the bag is damaged, rosbags is not installed, or something an estimator needs is missing.
    """
    spool = ImageSpool(str(path))
    try:
        with spool.errors_named():
            read = _read(path, frontend, spool, progress)
        filmed = ImageRecording(read.pairs, read.mounted.pair, spool)
        seen = seen_in(path, filmed, read.mounted.T_imu_left, frontend, progress)
    finally:
        spool.close()
    facts = (*seen.facts, *read.remarks, *read.chosen.facts, *read.mounted.facts)
    sequence = Recording(
        name=path.resolve().stem,
        rig=seen.rig,
        noise=read.mounted.noise,
        frames_t_ns=seen.frames_t_ns,
        observations=seen.observations,
        motion=read.motion,
        provenance=Provenance("bags", f"{path}: stereo tracks from the images", facts),
    )
    return sequence if read.truth is None else with_truth(sequence, truth_near(read.truth, seen.frames_t_ns))


@dataclass(frozen=True, eq=False)
class _Read:
    """What a bag holds; images are in the spool."""

    chosen: Chosen
    motion: MotionSamples
    mounted: Mounted
    pairs: tuple[StampedPair, ...]
    truth: Truth | None
    remarks: tuple[str, ...]


def _read(path: Path, frontend: Frontend, spool: ImageSpool, progress: Progress) -> _Read:
    with bag_reader.opened(path) as bag:
        chosen = choose(path, bag.topics, frontend.topics)
        source = recorded(bag, chosen)
        motion, how_moved = _motion_of(source)
        camera = mounted(source, motion)
        truth, whose = _truth(source)
        unstamped = _spool_images(bag, chosen, spool, progress)
    listed = pairs_of_asl(spool.folder).shifted(camera.shift_s)
    within = listed.within(motion.t_ns)
    if not within.pairs:
        raise DataError(f"{path}: {_why_no_pairs(chosen, listed, motion)}")
    check_frame_count(path, len(within.pairs))
    camera = _as_filmed(camera, within.pairs, frontend)
    remarks = (*within.remarks, *unstamped, *how_moved, *whose)
    return _Read(chosen, motion, camera, within.pairs, truth, remarks)


def _why_no_pairs(chosen: Chosen, listed: Listed, motion: MotionSamples) -> str:
    if not listed.pairs:
        return (
            f"no image of {chosen.left.name} has one of {chosen.right.name} within 1 ms ({listed.stamps} left ones); a "
            "stereo pair is taken at one instant: synchronise the cameras, or correct the stamps"
        )
    moved = chosen.imu or chosen.twist
    ranges = ((listed.pairs[0].t_ns, listed.pairs[-1].t_ns), (int(motion.t_ns.min()), int(motion.t_ns.max())))
    images, measured = (f"{first / NS_PER_S:.3f} to {last / NS_PER_S:.3f} s" for first, last in ranges)
    return (
        f"by their stamps the images are of {images} and {moved.name if moved else 'the motion'} of {measured}: two "
        "clocks; stamp both by one, or name another topic with --topics imu=TOPIC"
    )


def _as_filmed(camera: Mounted, pairs: Sequence[StampedPair], frontend: Frontend) -> Mounted:
    """Return the calibration for images that may be rectified without a topic that says so: their rows decide.

    The bags that kitti2bag writes are such: the lenses of the cameras, and images that were rectified before.
    """
    if camera.as_they_are is None:
        return camera
    calibrated, as_they_are = (matched_corners(pairs, rig, frontend) for rig in (camera.pair, camera.as_they_are))
    if as_they_are <= _CLEARLY * calibrated:
        return camera
    fact = (
        f"the images are rectified already: {as_they_are} corners have the same row in both as they are, and "
        f"{calibrated} once rectified by the calibration"
    )
    return replace(camera, pair=camera.as_they_are, facts=(*camera.facts, fact))


def _truth(source: Recorded) -> tuple[Truth | None, tuple[str, ...]]:
    """Return the poses of the body, and of what they are; another frame's are moved to it where the tree knows how."""
    topic, messages = source.chosen.truth, source.of(source.chosen.truth)
    if topic is None or not messages:
        return None, ()
    t_ns, rows, values = ros_values.poses_of(messages, topic.type)
    kept = known_poses(values)
    if not kept.any():
        return None, (f"no pose of {topic.name} is finite: it is left out, and there is no truth",)
    what, lost = Path(f"{source.path}: {topic.name}"), int((~kept).sum())
    T_world_child = checked_poses(what, rows[kept].tolist(), t_ns[kept], values[kept], "message")
    remarks = [f"{lost} of {kept.size} poses of {topic.name} are not finite and left out of the truth"] if lost else []
    body, child = source.body, ros_values.frame_name(getattr(messages[0].value, "child_frame_id", ""))
    T_child_body = source.tree.between(child, body)
    if not states_turns(values).any():
        remarks.append(f"{topic.name} states no orientation (quaternions of 0 or NaN): {OF_POSITIONS}")
    elif T_child_body is not None:
        T_world_child = T_world_child @ T_child_body
    elif child and child != body:
        remarks.append(
            f"the truth's poses are of {child!r}, which no transform connects to {body!r}: they are assumed to be the "
            "body's"
        )
    return Truth(t_ns[kept], T_world_child), tuple(remarks)


def _spool_images(bag: Bag, chosen: Chosen, spool: ImageSpool, progress: Progress) -> tuple[str, ...]:
    """Write the images of both cameras as an ASL folder has them, the stamp the name; return what to know of stamps."""
    sides = {chosen.left.name: "cam0", chosen.right.name: "cam1"}
    for topic, camera in sides.items():
        spool.call(f"{camera}/data", f"{bag.path}: {topic}")
    types = {topic.name: topic.type for topic in (chosen.left, chosen.right)}
    total, unstamped = chosen.left.count + chosen.right.count, 0
    for done, message in enumerate(bag.messages(sides.keys())):
        what = f"{bag.path}: {message.topic}: message {done}"
        t_ns = ros_values.stamp_ns(message.value.header, message.t_ns)
        unstamped += not ros_values.is_stamped(message.value.header)
        name = f"{sides[message.topic]}/data/{t_ns}"
        if types[message.topic] == COMPRESSED:
            ending, content = ros_values.image_file(message.value, what)
            spool.add(name + ending, content)
        else:
            spool.add_grey(name, ros_values.grey(message.value, what))
        progress.advance(done + 1, max(total, done + 1), "unpacking images")
    return (f"{unstamped} images have no stamp, and the time of recording is used",) if unstamped else ()


def _motion_of(source: Recorded) -> tuple[MotionSamples, tuple[str, ...]]:
    imu, accel = source.chosen.imu, source.chosen.accel
    if imu is None:
        return _twists(source), ()
    t_ns, gyro = _measured(source, imu, "angular velocity")
    if accel is not None:
        return _joined(source, (imu, t_ns, gyro), accel)
    return ImuSamples(t_ns, _measured(source, imu, "acceleration")[1], gyro), ()


def _twists(source: Recorded) -> TwistSamples:
    path, topic = source.path, source.chosen.twist
    if topic is None:
        others = ", ".join(source.chosen.other_twists)
        missing = "no sensor_msgs/Imu and no nav_msgs/Odometry, so nothing measures the motion"
        if source.chosen.like_imus and not others:
            raise DataError(
                f"{path}: no sensor_msgs/Imu and no nav_msgs/Odometry that can be read; "
                f"{', '.join(source.chosen.like_imus)} may measure the motion: convert it to sensor_msgs/Imu (m/s^2, "
                "rad/s; its axes, PX4's x forward, y right, z down, are those that the camera stands on)"
            )
        remedy = f"name one with --topics twist=TOPIC ({others})" if others else "record one with the images"
        raise DataError(f"{path}: {missing}; {remedy}")
    messages = _messages_of(source, topic)
    values = [message.value for message in messages]
    linear, angular = (ros_values.columns(values, part) for part in ros_values.VECTORS[topic.type])
    if not (linear.any() or angular.any()):
        raise DataError(f"{path}: {topic.name} states no twist (all are 0); name {_NAME_ANOTHER}")
    return TwistSamples(ros_values.stamps_ns(messages), linear, angular)


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
    messages = source.of(topic)
    if not messages:
        raise DataError(f"{source.path}: {topic.name} has no message; name another topic with --topics")
    return messages


def _measured(source: Recorded, topic: Topic, what: str) -> tuple[IntArray, Array]:
    """Return stamps (N,) and what an Imu measures (N, 3)."""
    messages = _messages_of(source, topic)
    part = ros_values.VECTORS[topic.type][what == "acceleration"]
    values = ros_values.columns([message.value for message in messages], part)
    covariance = getattr(messages[0].value, f"{part}_covariance")
    if not values.any() or float(np.asarray(covariance).ravel()[0]) == -1.0:
        apart = "the accelerometer's topic with --topics accel=TOPIC, " if what == "acceleration" else ""
        raise DataError(
            f"{source.path}: {topic.name} measures no {what} (its values are 0 or marked as absent); name {apart}"
            f"{_NAME_ANOTHER}"
        )
    return ros_values.stamps_ns(messages), values


# Trajectories --------------------------------------------------------------------------------------------------------

_WITH_COVARIANCES = (bag_reader.ODOMETRY, bag_reader.POSE_COV)
_OF_POSES = (*_WITH_COVARIANCES, bag_reader.POSE, bag_reader.TRANSFORM)


def read_topic(path: Path, name: str | None, cov_convention: CovConvention | None = None) -> PosesFile:
    """Read the poses of a topic of a bag, of the only one where none is named, with the covariances it has.

    The convention of covariances is ROS's (position first, turns about the fixed axes) unless another is given, for
    programs that write theirs into ROS's messages. Raises DataError where the bag is damaged, rosbags is not installed,
    or it has no such topic.
    """
    with bag_reader.opened(path) as bag:
        topic = _topic_of_poses(path, bag.topics, name)
        messages = list(bag.messages({topic.name}))
    t_ns, rows, values = ros_values.poses_of(messages, topic.type)
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
