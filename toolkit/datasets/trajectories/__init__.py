"""Trajectories in the files that other programs read and write; poses are ``T_world_imu`` in all of them.

``formats`` has the formats as a table, ``covariances`` what a covariance means in them; ``belonging`` checks that a
file is of a recording, in its clock, units and axes.
"""

from toolkit.datasets.trajectories.formats import (
    FORMATS,
    PosesFile,
    TrajectoryFormat,
    euroc,
    kitti,
    openvins,
    read_poses,
    tum,
)

__all__ = ["FORMATS", "PosesFile", "TrajectoryFormat", "euroc", "kitti", "openvins", "read_poses", "tum"]
