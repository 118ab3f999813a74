"""Ground truth from TUM files, and the checks that it belongs to a recording.

Columns are never reordered silently: where the order looks wrong an error is raised.
"""

from dataclasses import replace
from pathlib import Path

from toolkit.datasets.trajectories import tum
from toolkit.datasets.trajectories.belonging import Reference, check_clock, check_turns, in_other_order
from toolkit.datasets.trajectories.poses import check_order
from toolkit.sequence import Sequence, Truth

_KIND = "a truth file is TUM text, one pose a line"


def load_truth(path: Path) -> Truth:
    """Read a TUM file.

    Raises DataError, naming the line and the likely cause, where the file is missing, empty or not a table of
    eight finite numbers a line, time does not increase or is not in seconds, or quaternions are not unit
    length or look w first.
    """
    read = tum.read(path, _KIND)
    check_order(path, read.T_world_imu, tum.W_FIRST)
    return Truth(read.t_ns, read.T_world_imu)


def with_truth(sequence: Sequence, truth: Truth) -> Sequence:
    """Return the sequence with this truth.

    Raises DataError where the two do not overlap in time (both ranges and the likely cause are named), or
    where the measured rates of rotation fit the truth only with its quaternions read w first.
    """
    reference = Reference.of_recording(sequence)
    check_clock("the truth", reference, truth.t_ns)
    # Only the order: the recording is not audited yet, and mixed axes of its own would look like a camera's.
    readings = (in_other_order(tum.W_FIRST),)
    check_turns("the truth", reference, truth.t_ns, truth.T_world_imu[:, :3, :3], readings)
    return replace(sequence, truth=truth)
