"""Ground truth of a recording: read from a TUM file, checked to belong to it, and taken at the stamps of its frames.

Columns are never reordered silently: where the order looks wrong an error is raised.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np

from toolkit.datasets.trajectories import tum
from toolkit.datasets.trajectories.belonging import Reference, check_clock, check_turns, in_other_order
from toolkit.datasets.trajectories.formats import check_order
from toolkit.geometry import Array, IntArray, interpolate_poses
from toolkit.measurements import NS_PER_S
from toolkit.sequence import Sequence, Truth

_KIND = "a truth file is TUM text, one pose a line"
# Between truths farther apart nothing is known of the motion at 1 m/s: two periods of the camera.
_LONGEST_TRUTH_GAP_NS = NS_PER_S // 10


def load_truth(path: Path) -> Truth:
    """Read a TUM file.

    Raises DataError, naming the line and the likely cause, where the file is missing, empty or not a table of
    eight finite numbers a line, time does not increase or is not in seconds, or quaternions are not unit
    length or look w first.
    """
    read = tum.read(path, _KIND)
    check_order(path, read.T_world_imu, tum.other_order)
    return Truth(read.t_ns, read.T_world_imu)


def with_truth(sequence: Sequence, truth: Truth) -> Sequence:
    """Return the sequence with this truth.

    Raises DataError where the two do not overlap in time (both ranges and the likely cause are named), or
    where the measured rates of rotation fit the truth only with its quaternions read w first.
    """
    reference = Reference.of_recording(sequence)
    check_clock("the truth", reference, truth.t_ns)
    # Only the order: the recording is not audited yet, and mixed axes of its own would look like a camera's.
    readings = (in_other_order(tum.other_order),)
    check_turns("the truth", reference, truth.t_ns, truth.T_world_imu[:, :3, :3], readings)
    return replace(sequence, truth=truth)


def stamps_within(stamps: IntArray, imu_t_ns: IntArray, truth_t_ns: IntArray) -> IntArray:
    """Return the stamps (K,) that lie within the IMU's time and between truths close enough to interpolate."""
    first, last = max(imu_t_ns.min(), truth_t_ns[0]), min(imu_t_ns.max(), truth_t_ns[-1])
    inside = stamps[(stamps >= first) & (stamps <= last)]
    after = np.clip(np.searchsorted(truth_t_ns, inside), 1, truth_t_ns.size - 1)
    return np.asarray(inside[truth_t_ns[after] - truth_t_ns[after - 1] <= _LONGEST_TRUTH_GAP_NS])


def truth_near(truth: Truth, t_ns: IntArray) -> Truth:
    """Return the truth at those stamps (K,) that lie between truths close enough to interpolate."""
    return truth_at(truth, stamps_within(t_ns, truth.t_ns, truth.t_ns))


def truth_at(truth: Truth, t_ns: IntArray) -> Truth:
    """Return the truth at stamps (K,) within it: poses on the geodesic, velocities and biases on straight lines."""
    poses = interpolate_poses(truth.t_ns, truth.T_world_imu, t_ns)
    return Truth(t_ns, poses, _linear(truth.v_world, truth.t_ns, t_ns), _linear(truth.bias, truth.t_ns, t_ns))


def _linear(values: Array | None, t_ns: IntArray, at_ns: IntArray) -> Array | None:
    if values is None:
        return None
    t_s, at_s = (t_ns - t_ns[0]) / NS_PER_S, (at_ns - t_ns[0]) / NS_PER_S
    return np.stack([np.interp(at_s, t_s, column) for column in values.T], axis=1)
