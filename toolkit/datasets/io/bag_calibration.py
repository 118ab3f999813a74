"""The calibration of a bag: files beside it, or its CameraInfo messages and the transforms that never change.

Sources: sensor_msgs/CameraInfo, whose P of the right camera has the baseline; REP 104 (rectified images), REP 105.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from toolkit.datasets.io import ros_values
from toolkit.datasets.io.bag_reader import Bag, Held, Message, Topic
from toolkit.datasets.io.bag_topics import Chosen
from toolkit.datasets.io.euroc_calibration import kalibr_noise, read_calibration
from toolkit.errors import DataError
from toolkit.files.reading import is_regular
from toolkit.frontend import RectifiedPair, already_rectified, rectified
from toolkit.geometry import Array, se3
from toolkit.measurements import MotionNoise
from toolkit.models.noise import mems_imu, twist_noise
from toolkit.motion_samples import MotionSamples, TwistSamples

_NO_NOISE = "no noise of the IMU is stated: that of a MEMS unit in motion is assumed (noise.motion_scale scales it)"
_STATED = "the noise of the IMU is as its file states it"
_PUT_BESIDE = "put Kalibr's camchain.yaml or an ASL folder's cam0/sensor.yaml beside the bag"


@dataclass(frozen=True, eq=False)
class Mounted:
    """The pair of cameras, where the left one stands on the body, the motion's noise, and where all this is from.

    ``as_they_are`` is the pair that images make which come rectified already, where that is possible.
    """

    pair: RectifiedPair
    T_imu_left: Array
    noise: MotionNoise
    facts: tuple[str, ...]
    as_they_are: RectifiedPair | None = None


@dataclass(frozen=True)
class Frames:
    """The names of the frames of the body and of both cameras."""

    body: str
    left: str
    right: str

    @classmethod
    def of(cls, chosen: Chosen, held: Held) -> "Frames":
        """Return the frames that the first messages name."""
        body = (chosen.imu, "header.frame_id") if chosen.imu is not None else (chosen.twist, "child_frame_id")
        left, right = (_frame(held.of(topic)) for topic in (chosen.left, chosen.right))
        return cls(_frame(held.of(body[0]), of_child=chosen.imu is None), left, right)


def _frame(messages: list[Message], *, of_child: bool = False) -> str:
    """Return the frame of the first message; of an odometry that of the child, which its twist is in."""
    if not messages:
        return ""
    value = messages[0].value
    child = getattr(value, "child_frame_id", "") if of_child else ""
    return ros_values.frame_name(child or value.header.frame_id)


@dataclass(frozen=True, eq=False)
class Source:
    """Possible sources of a calibration; ``in_tf`` says that /tf connects the frames, and not /tf_static."""

    path: Path
    chosen: Chosen
    held: Held
    tree: ros_values.Tree
    frames: Frames
    in_tf: bool = False


def source_of(bag: Bag, chosen: Chosen, held: Held) -> Source:
    """Return where the calibration of a bag may be from; /tf is read where /tf_static does not join the frames."""
    frames = Frames.of(chosen, held)
    static = [t for topic in chosen.transforms for message in held.of(topic) for t in message.value.transforms]
    source = Source(bag.path, chosen, held, ros_values.Tree(static), frames)
    if not chosen.moving or source.tree.between(frames.body, frames.left) is not None:
        return source
    tree = ros_values.Tree([*ros_values.fixed(_moving(bag, chosen)), *static])
    if tree.between(frames.body, frames.left) is None:
        return source
    return replace(source, tree=tree, in_tf=True)


def _moving(bag: Bag, chosen: Chosen) -> Iterator[Any]:
    for message in bag.messages({topic.name for topic in chosen.moving}):
        yield from message.value.transforms


def mounted(source: Source, motion: MotionSamples) -> Mounted:
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
        notes = (f"{calibration.source}, beside the bag", *(() if twist else (calibration.noise_source,)))
        return Mounted(pair, calibration.T_imu_left, twist or calibration.noise, notes)
    T_imu_left = source.tree.between(source.frames.body, source.frames.left)
    # An IMU does not have the axes of a camera: if both name the same frame, the name is wrong for one of them.
    if T_imu_left is None or (source.chosen.imu is not None and source.frames.body == source.frames.left):
        raise DataError(_not_joined(source))
    pair, as_they_are, how = _pair(source)
    stated = next(filter(None, map(kalibr_noise, _folders_beside(source.path))), None)
    noise = () if twist else (_NO_NOISE if stated is None else _STATED,)
    tf = "the transforms of /tf that never change" if source.in_tf else "/tf_static"
    notes = (f"calibration from {how} and {tf}", *noise)
    return Mounted(pair, T_imu_left, twist or stated or mems_imu(), notes, as_they_are)


def _not_joined(source: Source) -> str:
    others = ", ".join(source.chosen.other_imus)
    other = f", or name another Imu with --topics imu=TOPIC ({others})" if others else ""
    tf = "/tf_static and no fixed transform of /tf" if source.chosen.moving else "/tf_static"
    return (
        f"{source.path}: the camera's pose on the body is unknown: no {tf} connects the frames "
        f"{source.frames.body!r} and {source.frames.left!r}; {_PUT_BESIDE}{other}"
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


def _pair(source: Source) -> tuple[RectifiedPair, RectifiedPair | None, str]:
    """Return the pair of cameras of the CameraInfo messages, that of images which come rectified, and the topics."""
    topics, infos = _infos(source)
    what = [f"{source.path}: {topic.name}" for topic in topics]
    left_rect, right_rect = (ros_values.rectification(info) for info in infos)
    how = " and ".join(topic.name for topic in topics)
    baseline_m = right_rect.right_m - left_rect.right_m
    T_right_left = source.tree.between(source.frames.right, source.frames.left)
    R_rect_left, R_rect_right = left_rect.R_rect_cam, right_rect.R_rect_cam
    if source.chosen.rectified:
        if not baseline_m > 0.0 and T_right_left is not None:
            baseline_m = float(np.linalg.norm(T_right_left[:3, 3]))
        if not (baseline_m > 0.0 and left_rect.pinhole_px[0] > 0.0):
            raise DataError(
                f"{what[1]}: the images are rectified, P has no baseline (Tx is 0), and no /tf_static joins the two "
                f"cameras; correct P, or {_PUT_BESIDE} and name the raw images"
            )
        given = already_rectified(left_rect.pinhole_px, baseline_m, _size(infos[0]))
        # The frame of an image is the camera's own; R turns it into the rectified one's.
        return replace(given, R_rect_cam=R_rect_left), None, how
    left, right = (ros_values.camera(info, text) for info, text in zip(infos, what, strict=True))
    as_they_are = None
    if baseline_m > 0.0:
        # In rectified axes the right camera stands on x; R turns each camera's own axes into them.
        shift_m = R_rect_right.T @ np.array([-baseline_m, 0.0, 0.0])
        T_right_left = se3(R_rect_right.T @ R_rect_left, shift_m)
        as_they_are = already_rectified(left_rect.pinhole_px, baseline_m, _size(infos[0]))
    if T_right_left is None:
        raise DataError(f"{what[1]}: P has no baseline, and /tf_static does not join the two cameras; {_PUT_BESIDE}")
    return rectified(left, right, T_right_left, f"{source.path}: {how}"), as_they_are, how


def _infos(source: Source) -> tuple[list[Topic], list[Any]]:
    """Return the topics of both calibrations and their first messages; raises DataError where one is missing."""
    chosen, topics, infos = source.chosen, [], []
    for image, topic in ((chosen.left, chosen.left_info), (chosen.right, chosen.right_info)):
        messages = source.held.of(topic)
        if topic is None or not messages:
            raise DataError(
                f"{source.path}: there is no sensor_msgs/CameraInfo beside {image.name}; name it with --topics "
                f"left_info=TOPIC,right_info=TOPIC, or {_PUT_BESIDE}"
            )
        infos.append(messages[0].value)
        topics.append(topic)
    return topics, infos


def _size(info: Any) -> tuple[int, int]:
    return int(info.width), int(info.height)
