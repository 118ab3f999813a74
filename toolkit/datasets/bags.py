"""Bags of ROS 1 and ROS 2, and MCAP: stereo images, an IMU or an odometer, and perhaps a truth (extra ``bags``).

A ``.bag``, ``.mcap`` or ``.db3``, or the folder of a rosbag2. Topics are guessed from types and names, or said with
``--topics``; the facts tell which are what and which are not used. Tracks are made of the images.

Calibration is that beside the bag where there is any: Kalibr's camchain, or the sensor.yaml files of an ASL folder.
Otherwise lenses and baseline are those of the CameraInfo messages, and the camera stands on the body where /tf_static
has it. Poses of a truth are those of the IMU, or of a frame that /tf_static knows.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from toolkit.datasets.io import bag_reader, ros_values
from toolkit.datasets.io.bag_reader import COMPRESSED, Bag, Topic
from toolkit.datasets.io.bag_topics import Chosen, choose
from toolkit.datasets.io.euroc_calibration import kalibr_noise, read_calibration
from toolkit.datasets.io.fields import check_frame_count, observations
from toolkit.datasets.io.image_pairs import facts_of, images_only, pairs_of_asl, rig_of
from toolkit.datasets.io.image_spool import ImageSpool
from toolkit.datasets.io.truth_at_frames import truth_near
from toolkit.datasets.io.truth_file import with_truth
from toolkit.datasets.trajectories.poses import checked_poses
from toolkit.errors import DataError
from toolkit.frontend import ImageRecording, RectifiedPair, StampedPair, already_rectified, rectified, track_images
from toolkit.geometry import Array, IntArray, se3
from toolkit.inputs import is_regular
from toolkit.measured_motion import ImuSamples, MotionNoise, MotionSamples, TwistSamples
from toolkit.models.noise import mems_imu, twist_noise
from toolkit.progress import SILENT, Progress
from toolkit.sequence import Provenance, Sequence, Truth
from toolkit.settings import DEFAULTS, Frontend

_NO_NOISE = "no noise of the IMU is stated: that of a MEMS unit in motion is taken (noise.motion_scale scales it)"

_STATED = "the noise of the IMU is as its file states it"
_PUT_BESIDE = "put Kalibr's camchain.yaml or an ASL folder's cam0/sensor.yaml beside the bag"

uses_images = images_only


def recognises(path: Path) -> bool:
    """Say whether the path is a bag, from its first bytes or a folder's metadata.yaml."""
    return bag_reader.kind_of(path) is not None


def load(path: Path) -> Sequence:
    """Read a bag with the front end's default settings; see :func:`load_from_images`."""
    return load_from_images(path, DEFAULTS.frontend, SILENT)


def images_of(path: Path, frontend: Frontend) -> ImageRecording:
    """Return the image pairs within the motion's time and their cameras; raises as :func:`load_from_images`."""
    spool = ImageSpool()
    filmed = _read(path, frontend.topics, spool, SILENT)
    return ImageRecording(filmed.pairs, filmed.mounted.pair, spool)


def load_from_images(path: Path, frontend: Frontend, progress: Progress) -> Sequence:
    """Read motion, calibration and truth, and make the tracks of the images within the motion's time.

    Raises DataError where the bag is damaged, rosbags is not installed, or something an estimator needs is missing.
    """
    spool = ImageSpool()
    try:
        read = _read(path, frontend.topics, spool, progress)
        tracks = track_images(read.pairs, read.mounted.pair, frontend, progress)
    finally:
        spool.close()
    check_frame_count(path, tracks.t_ns.size)
    facts = (*facts_of(tracks, len(read.pairs)), *read.remarks, *read.chosen.facts, *read.mounted.facts)
    sequence = Sequence(
        name=path.resolve().stem,
        rig=rig_of(read.mounted.pair, read.mounted.T_imu_left),
        noise=read.mounted.noise,
        frames_t_ns=tracks.t_ns,
        observations=observations(tracks.frame, tracks.track_id, tracks.corners_px),
        motion=read.motion,
        provenance=Provenance("bags", f"{path}: stereo tracks from the images", facts),
    )
    return sequence if read.truth is None else with_truth(sequence, truth_near(read.truth, tracks.t_ns))


@dataclass(frozen=True, eq=False)
class _Mounted:
    """The pair of cameras, where the left one stands on the body, the motion's noise, and where all this is from."""

    pair: RectifiedPair
    T_imu_left: Array
    noise: MotionNoise
    facts: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class _Read:
    """What a bag holds; images are in the spool."""

    chosen: Chosen
    motion: MotionSamples
    mounted: _Mounted
    pairs: tuple[StampedPair, ...]
    truth: Truth | None
    remarks: tuple[str, ...]


def _read(path: Path, topics: str | None, spool: ImageSpool, progress: Progress) -> _Read:
    with bag_reader.opened(path) as bag:
        chosen = choose(path, bag.topics, topics)
        small = _small(bag, chosen)
        motion = _motion(path, chosen, small)
        if not motion.t_ns.size:
            raise DataError(f"{path}: {chosen.imu or chosen.twist} has no message; name another topic with --topics")
        tree = ros_values.Tree(_transforms(small, chosen))
        frames = _Frames.of(chosen, small)
        mounted = _mounted(_Source(path, chosen, small, tree, frames), motion)
        truth = _truth(path, chosen, small, tree, frames)
        _spool_images(bag, chosen, spool, progress)
    listed = pairs_of_asl(spool.folder)
    pairs = tuple(pair for pair in listed.pairs if motion.t_ns.min() <= pair.t_ns <= motion.t_ns.max())
    check_frame_count(path, len(pairs))
    return _Read(chosen, motion, mounted, pairs, truth, listed.remarks)


Small = dict[str, list[bag_reader.Message]]


def _small(bag: Bag, chosen: Chosen) -> Small:
    """Return the messages of all topics but the images'; of calibrations, and one image a side, the first."""
    wanted = (chosen.imu, chosen.twist, chosen.truth, *chosen.transforms)
    found: Small = {}
    for message in bag.messages({topic.name for topic in wanted if topic is not None}):
        found.setdefault(message.topic, []).append(message)
    for topic in (chosen.left_info, chosen.right_info, chosen.left, chosen.right):
        if topic is not None:
            found[topic.name] = list(islice(bag.messages({topic.name}), 1))
    return found


def _of(small: Small, topic: Topic | None) -> list[bag_reader.Message]:
    return [] if topic is None else small.get(topic.name, [])


def _transforms(small: Small, chosen: Chosen) -> Iterator[Any]:
    for topic in chosen.transforms:
        for message in _of(small, topic):
            yield from message.value.transforms


def _stamps(messages: list[bag_reader.Message]) -> IntArray:
    stamps = [ros_values.stamp_ns(message.value.header, message.t_ns) for message in messages]
    return np.array(stamps, dtype=np.int64)


def _motion(path: Path, chosen: Chosen, small: Small) -> MotionSamples:
    """Return the samples of the IMU, or the twists of the odometry where there is none."""
    if chosen.imu is not None:
        messages = _of(small, chosen.imu)
        accel, gyro = (
            np.array([[v.x, v.y, v.z] for v in (getattr(m.value, name) for m in messages)]).reshape(-1, 3)
            for name in ("linear_acceleration", "angular_velocity")
        )
        return ImuSamples(_stamps(messages), accel, gyro)
    messages = _of(small, chosen.twist)
    if not messages:
        raise DataError(f"{path}: no sensor_msgs/Imu and no nav_msgs/Odometry, so nothing measures the motion")
    twists = [message.value.twist.twist for message in messages]
    linear, angular = (
        np.array([[v.x, v.y, v.z] for v in (getattr(twist, name) for twist in twists)])
        for name in ("linear", "angular")
    )
    return TwistSamples(_stamps(messages), linear, angular)


@dataclass(frozen=True)
class _Frames:
    """The names of the frames of the body and of both cameras."""

    body: str
    left: str
    right: str

    @classmethod
    def of(cls, chosen: Chosen, small: Small) -> "_Frames":
        left, right = (
            next((ros_values.frame_name(m.value.header.frame_id) for m in _of(small, topic)), "")
            for topic in (chosen.left, chosen.right)
        )
        if chosen.imu is not None:
            body = next((ros_values.frame_name(m.value.header.frame_id) for m in _of(small, chosen.imu)), "")
        else:
            body = next((ros_values.frame_name(m.value.child_frame_id) for m in _of(small, chosen.twist)), "")
        return cls(body, left, right)


@dataclass(frozen=True, eq=False)
class _Source:
    """Where a calibration may be from."""

    path: Path
    chosen: Chosen
    small: Small
    tree: ros_values.Tree
    frames: _Frames


def _mounted(source: _Source, motion: MotionSamples) -> _Mounted:
    """Return the calibration: from files beside the bag, or from its own messages."""
    folder = _calibration_folder(source.path)
    twist = twist_noise(motion.t_ns, motion.v_mps, motion.w_radps) if isinstance(motion, TwistSamples) else None
    if folder is not None:
        root, mav0 = folder
        calibration = read_calibration(root, mav0)
        if calibration.cameras is None:
            raise DataError(f"{mav0}: the calibration lacks distortion_model or intrinsics of a camera; add them")
        pair = rectified(*calibration.cameras, calibration.T_right_left)
        told = (f"{calibration.source}, beside the bag", *(() if twist else (calibration.noise_source,)))
        return _Mounted(pair, calibration.T_imu_left, twist or calibration.noise, told)
    T_imu_left = source.tree.between(source.frames.body, source.frames.left)
    if T_imu_left is None:
        raise DataError(
            f"{source.path}: nothing tells where the camera is on the body: no /tf_static joins the frames "
            f"{source.frames.body!r} and {source.frames.left!r}; {_PUT_BESIDE}"
        )
    pair, how = _pair(source)
    stated = next(filter(None, map(kalibr_noise, _folders_beside(source.path))), None)
    told = (f"calibration from {how} and /tf_static", *(() if twist else (_NO_NOISE if stated is None else _STATED,)))
    return _Mounted(pair, T_imu_left, twist or stated or mems_imu(), told)


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


def _pair(source: _Source) -> tuple[RectifiedPair, str]:
    """Return the pair of cameras of the CameraInfo messages."""
    chosen, names = source.chosen, []
    infos = []
    for image, topic in ((chosen.left, chosen.left_info), (chosen.right, chosen.right_info)):
        messages = _of(source.small, topic)
        if topic is None or not messages:
            raise DataError(
                f"{source.path}: there is no sensor_msgs/CameraInfo beside {image.name}; name it with --topics "
                f"left_info=TOPIC,right_info=TOPIC, or {_PUT_BESIDE}"
            )
        infos.append(messages[0].value)
        names.append(topic.name)
    what = [f"{source.path}: {name}" for name in names]
    left_rect, right_rect = (ros_values.rectification(info) for info in infos)
    baseline_m, how = right_rect.baseline_m, " and ".join(names)
    if chosen.rectified:
        if not (baseline_m > 0.0 and left_rect.pinhole_px[0] > 0.0):
            raise DataError(f"{what[1]}: P has no baseline, and the images are rectified; mend P, or use raw images")
        size_px = (int(infos[0].width), int(infos[0].height))
        return already_rectified(left_rect.pinhole_px, baseline_m, size_px), how
    left, right = (ros_values.camera(info, text) for info, text in zip(infos, what, strict=True))
    T_right_left = source.tree.between(source.frames.right, source.frames.left)
    if baseline_m > 0.0:
        # In rectified axes the right camera stands on x; R turns each camera's own axes into them.
        R_right_rect = right_rect.R_rect_cam.T
        T_right_left = se3(R_right_rect @ left_rect.R_rect_cam, R_right_rect @ np.array([-baseline_m, 0.0, 0.0]))
    if T_right_left is None:
        raise DataError(f"{what[1]}: P has no baseline, and /tf_static does not join the two cameras; add one of them")
    return rectified(left, right, T_right_left), how


def _truth(path: Path, chosen: Chosen, small: Small, tree: ros_values.Tree, frames: _Frames) -> Truth | None:
    """Return the poses of the body; those of another frame are moved to it where the tree knows how."""
    messages = _of(small, chosen.truth)
    if chosen.truth is None or not messages:
        return None
    t_ns, poses = _stamps(messages), [ros_values.pose_of(message.value) for message in messages]
    _, first = np.unique(t_ns, return_index=True)
    values = np.array([pose for pose, _ in poses])[first]
    what = Path(f"{path}: {chosen.truth.name}")
    T_world_child = checked_poses(what, first.tolist(), t_ns[first], values)
    T_child_body = tree.between(poses[0][1], frames.body)
    return Truth(t_ns[first], T_world_child if T_child_body is None else T_world_child @ T_child_body)


def _spool_images(bag: Bag, chosen: Chosen, spool: ImageSpool, progress: Progress) -> None:
    """Write the images of both cameras as an ASL folder has them; the stamp is the name."""
    sides = {chosen.left.name: "cam0", chosen.right.name: "cam1"}
    total = chosen.left.count + chosen.right.count
    for done, message in enumerate(bag.messages(sides.keys())):
        what = f"{bag.path}: {message.topic}: message {done}"
        name = f"{sides[message.topic]}/data/{ros_values.stamp_ns(message.value.header, message.t_ns)}"
        if _type_of(chosen, message.topic) == COMPRESSED:
            ending, content = ros_values.image_file(message.value, what)
            spool.add(name + ending, content)
        else:
            spool.add_grey(name, ros_values.grey(message.value, what))
        progress.advance(done + 1, max(total, done + 1), "unpacking images")


def _type_of(chosen: Chosen, name: str) -> str:
    return chosen.left.type if chosen.left.name == name else chosen.right.type
