"""The motion that a bag measures: an IMU, a gyro and an accelerometer on topics of their own, or twists."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from toolkit.datasets.io import ros_values
from toolkit.datasets.io.bag_reader import Held, Message, Topic
from toolkit.datasets.io.bag_topics import Chosen
from toolkit.errors import DataError
from toolkit.geometry import Array, IntArray
from toolkit.measured_motion import ImuSamples, MotionSamples, TwistSamples

_NAME_ANOTHER = "another topic with --topics imu=TOPIC, or an odometry with --topics twist=TOPIC"


def stamps_ns(messages: Sequence[Message]) -> IntArray:
    """Return the stamps (N,) of messages, which are their headers' or, where these are zero, the recording's."""
    stamps = [ros_values.stamp_ns(message.value.header, message.t_ns) for message in messages]
    return np.array(stamps, dtype=np.int64)


def motion_of(path: Path, chosen: Chosen, held: Held, tree: ros_values.Tree) -> tuple[MotionSamples, tuple[str, ...]]:
    """Return the samples of the IMU, or the twists where there is none, and what must be known of them.

    Raises DataError where nothing measures the motion, or what was chosen does not measure all of it.
    """
    if chosen.imu is not None:
        messages = _given(path, chosen.imu, held)
        t_ns, gyro = stamps_ns(messages), _vectors([m.value.angular_velocity for m in messages])
        _check_measured(path, chosen.imu, gyro, messages[0].value.angular_velocity_covariance, "angular velocity")
        if chosen.accel is not None:
            return _joined(path, chosen, held, tree, (t_ns, gyro))
        accel, stated = _accel(messages)
        _check_measured(path, chosen.imu, accel, stated, "acceleration")
        return ImuSamples(t_ns, accel, gyro), ()
    if chosen.twist is None:
        raise DataError(f"{path}: no sensor_msgs/Imu and no nav_msgs/Odometry, so nothing measures the motion")
    messages = _given(path, chosen.twist, held)
    # A twist is wrapped once more where it has a covariance.
    twists = [getattr(message.value.twist, "twist", message.value.twist) for message in messages]
    linear, angular = (_vectors([getattr(twist, name) for twist in twists]) for name in ("linear", "angular"))
    if not (linear.any() or angular.any()):
        raise DataError(f"{path}: {chosen.twist.name} states no twist (all are 0); name {_NAME_ANOTHER}")
    return TwistSamples(stamps_ns(messages), linear, angular), ()


def _joined(
    path: Path, chosen: Chosen, held: Held, tree: ros_values.Tree, gyro: tuple[IntArray, Array]
) -> tuple[ImuSamples, tuple[str, ...]]:
    """Return the samples of a gyro with the accelerometer's, which has other stamps, interpolated at its own."""
    assert chosen.imu is not None
    assert chosen.accel is not None
    messages = _given(path, chosen.accel, held)
    order = np.argsort(stamps_ns(messages), kind="stable")
    t_ns, (accel, stated) = stamps_ns(messages)[order], _accel(messages)
    _check_measured(path, chosen.accel, accel, stated, "acceleration")
    frames = (ros_values.frame_name(held.of(topic)[0].value.header.frame_id) for topic in (chosen.imu, chosen.accel))
    T_gyro_accel = tree.between(*frames)
    accel = accel[order] if T_gyro_accel is None else accel[order] @ T_gyro_accel[:3, :3].T
    within = (gyro[0] >= t_ns[0]) & (gyro[0] <= t_ns[-1])
    if not within.any():
        raise DataError(
            f"{path}: {chosen.imu.name} and {chosen.accel.name} have no time in common; name {_NAME_ANOTHER}"
        )
    at_ns = gyro[0][within]
    at_gyro = np.stack([np.interp(at_ns - t_ns[0], t_ns - t_ns[0], column) for column in accel.T], axis=1)
    fact = f"{len(messages)} samples of {chosen.accel.name} are interpolated at the {at_ns.size} of {chosen.imu.name}"
    return ImuSamples(at_ns, at_gyro, gyro[1][within]), (fact,)


def _given(path: Path, topic: Topic, held: Held) -> list[Message]:
    messages = held.of(topic)
    if not messages:
        raise DataError(f"{path}: {topic.name} has no message; name another topic with --topics")
    return messages


def _accel(messages: list[Message]) -> tuple[Array, Any]:
    """Return the accelerations (N, 3) of messages, and the covariance that the first one states."""
    return _vectors([m.value.linear_acceleration for m in messages]), messages[0].value.linear_acceleration_covariance


def _vectors(values: Sequence[Any]) -> Array:
    return np.array([[v.x, v.y, v.z] for v in values], dtype=np.float64).reshape(-1, 3)


def _check_measured(path: Path, topic: Topic, values: Array, covariance: Any, what: str) -> None:
    """Raise DataError where an Imu does not measure something: a covariance of -1 says so, or all values are 0."""
    if values.any() and float(np.asarray(covariance).ravel()[0]) != -1.0:
        return
    apart = "the accelerometer's topic with --topics accel=TOPIC, " if what == "acceleration" else ""
    raise DataError(
        f"{path}: {topic.name} measures no {what} (its values are 0 or said to be none); name {apart}{_NAME_ANOTHER}"
    )
