"""Poses of a topic of a bag, with the covariances of PoseWithCovarianceStamped and Odometry (extra ``bags``).

A path names the topic behind a colon, as in ``run.bag:/odom``. Covariances are as ROS defines them: position first,
turns about the fixed axes.
"""

from pathlib import Path

import numpy as np

from toolkit.datasets.io import bag_reader, ros_values
from toolkit.datasets.trajectories.covariances import ROS, CovConvention, StatedCovariances
from toolkit.datasets.trajectories.formats import PosesFile, checked_poses
from toolkit.errors import DataError, no_such

_WITH_COVARIANCES = (bag_reader.ODOMETRY, bag_reader.POSE_COV)
_POSES = (*_WITH_COVARIANCES, bag_reader.POSE, bag_reader.TRANSFORM)


def read_topic(path: Path, name: str | None, cov_convention: CovConvention | None = None) -> PosesFile:
    """Read the poses of a topic of a bag, of the only one where none is named.

    The convention of covariances is ROS's unless another is given, for programs that write theirs into ROS's messages.
    Raises DataError where the bag is damaged, rosbags is not installed, or it has no such topic.
    """
    with bag_reader.opened(path) as bag:
        usable = [topic for topic in bag.topics if topic.type in _POSES and topic.count and not topic.unreadable]
        topic = _chosen(path, usable, name)
        messages = list(bag.messages({topic.name}))
    stamps = [ros_values.stamp_ns(message.value.header, message.t_ns) for message in messages]
    t_ns, first = np.unique(np.array(stamps, dtype=np.int64), return_index=True)
    values = [messages[row].value for row in first.tolist()]
    T_world_body = checked_poses(
        Path(f"{path}: {topic.name}"), first.tolist(), t_ns, ros_values.poses_of(values, topic.type)
    )
    stated = None
    if topic.type in _WITH_COVARIANCES:
        cov = np.array([value.pose.covariance for value in values], dtype=float).reshape(-1, 6, 6)
        cov = 0.5 * (cov + np.swapaxes(cov, 1, 2))
        # A covariance of zeros, or of -1, says that there is none.
        unknown = (np.einsum("nii->ni", cov) <= 0.0).all(axis=1)
        cov[unknown] = np.nan
        stated = None if unknown.all() else StatedCovariances(cov, None)
    file = PosesFile(path, f"{topic.type.replace('/msg/', '/')} of a bag", t_ns, T_world_body, None, stated)
    return file.with_convention(cov_convention or ROS)


def _chosen(path: Path, usable: list[bag_reader.Topic], name: str | None) -> bag_reader.Topic:
    """Return the topic that is named, or the only one, of those with covariances first."""
    if name is not None:
        named = next((topic for topic in usable if topic.name == name), None)
        if named is None:
            raise DataError(f"{path}: {no_such('topic of poses', name, [topic.name for topic in usable])}")
        return named
    for topics in ([topic for topic in usable if topic.type in _WITH_COVARIANCES], usable):
        if len(topics) == 1:
            return topics[0]
    there = ", ".join(map(str, usable)) or "none"
    raise DataError(f"{path}: name the topic of the poses, as in {path.name}:/odom; there are {there}")
