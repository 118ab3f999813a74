"""Trajectories in the files that other programs read and write: one module a format, its reader beside its writer.

The formats are ``tum``, ``kitti``, ``euroc`` and ``openvins``, made of ``rows`` (lines as cells) and ``poses`` (what is
read, and its checks); ``belonging`` checks that a file is of a recording, ``exchanged_axes`` that its axes are. Poses
are ``T_world_imu`` in all of them. A format is a :class:`TrajectoryFormat`; a file is recognised from its content, not
its name.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Protocol

import numpy as np

from toolkit.datasets.trajectories import euroc, kitti, openvins, tum
from toolkit.datasets.trajectories.poses import PosesFile
from toolkit.datasets.trajectories.rows import Rows, read_rows
from toolkit.errors import DataError
from toolkit.estimate import Trajectory


class TrajectoryFormat(Protocol):
    """A module that reads and writes one format."""

    COLUMNS: str

    def recognises(self, rows: Rows) -> bool:
        """Say whether rows have the shape of this format; at most one has it."""

    def parse(self, rows: Rows) -> PosesFile:
        """Return the poses of rows; raise DataError, naming the line, where they are not of this format."""

    def text(self, trajectory: Trajectory) -> str:
        """Return a trajectory as the text of a file."""


FORMATS: Mapping[str, TrajectoryFormat] = {"tum": tum, "kitti": kitti, "euroc": euroc, "openvins": openvins}
_KIND = f"there are {', '.join(f'{name} ({module.COLUMNS})' for name, module in FORMATS.items())}"


def read_poses(path: Path) -> PosesFile:
    """Read a file of any of the formats.

    Raises DataError, naming the line and the likely cause, where it is missing, empty, of none of the formats or
    not as its format requires: a wrong unit of time is named, never repaired. The order of quaternions shows
    only beside the recording (:mod:`~toolkit.datasets.trajectories.belonging`).
    """
    rows = read_rows(path, _KIND)
    for module in FORMATS.values():
        if module.recognises(rows):
            with np.errstate(all="ignore"):  # the checks say what is wrong with values, and not NumPy
                return module.parse(rows)
    kind = "separated by commas" if rows.commas else "separated by blanks"
    raise DataError(f"{path}: {rows.width} columns {kind} are no format that is known; {_KIND}")
