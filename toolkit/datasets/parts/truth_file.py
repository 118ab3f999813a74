"""Ground truth from TUM files, and the checks that it belongs to a recording.

A TUM file has one pose a line, ``t x y z qx qy qz qw`` (s, m, Hamilton quaternion IMU -> world), and comments
after ``#``. Columns are never reordered silently: where the order looks wrong the error says so.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np

from toolkit.cutting import NS_PER_S
from toolkit.datasets.parts.stamps import stamps_ns
from toolkit.datasets.parts.text_table import read_rows
from toolkit.errors import DataError
from toolkit.geometry import Array, IntArray, quaternion_from_rotation, rotation_from_quaternion, se3, so3_log
from toolkit.sequence import Sequence, Truth

_COLUMNS = "t x y z qx qy qz qw"
_KIND = "a truth file is TUM text, one pose a line"
# Quaternions printed with four decimals are off by 1e-4; anything beyond 1e-2 is not a rounded rotation.
_UNIT_TOLERANCE = 1e-2
# A file whose first four-vector is this close to (1, 0, 0, 0) starts at the identity if it is w first.
_IDENTITY_TOLERANCE = 1e-2
# Mean resultant length of the directions of travel in the body frame: 1 for a vehicle, about 0 for the wrong order.
_VEHICLE_CONCENTRATION, _LEAST_GAIN = 0.9, 0.1
# The rates of rotation decide where they follow the w-first reading this closely and leave a third as much, or less,
# unexplained than under the file's own: slow turns correlate with unrelated ones by chance, 0.8 at times.
_FITTING_CORRELATION, _UNEXPLAINED_SHARE = 0.5, 1.0 / 3.0
# Stamps beyond this count from an epoch, stamps below it from the start of a recording or of a day.
_EPOCH_S = 1e6
_W_FIRST = "the quaternions look w first; TUM order is qx qy qz qw: move the fifth column to the end"


def load_truth(path: Path) -> Truth:
    """Read a TUM file.

    Raises DataError, naming the line and the likely cause, where the file is missing, empty or not a table of
    eight finite numbers a line, time does not increase or is not in seconds, or quaternions are not unit
    length or look w first.
    """
    line_numbers, table = read_rows(path, _COLUMNS, _KIND)
    t_ns, T_world_imu = checked_poses(path, line_numbers, table)
    if _looks_w_first(table[:, 1:4], table[:, 4:]):
        raise DataError(f"{path}: {_W_FIRST}")
    return Truth(t_ns, T_world_imu)


def checked_poses(path: Path, line_numbers: list[int], table: Array) -> tuple[IntArray, Array]:
    """Return stamps (N,) ns and poses (N, 4, 4) of rows (N, 8) in TUM's order, or raise DataError naming the line."""
    t_ns = stamps_ns(path, "time", table[:, 0])
    checks = (
        (np.isfinite(table).all(axis=1), "holds a value that is not finite; remove the line"),
        (np.diff(t_ns, prepend=t_ns[:1] - 1) > 0, "is not later than the line before it; sort the file by time"),
        (
            np.abs(np.linalg.norm(table[:, 4:], axis=1) - 1.0) < _UNIT_TOLERANCE,
            "has a quaternion that is not of unit length; check the order of the columns",
        ),
    )
    for passed, complaint in checks:
        if not passed.all():
            raise DataError(f"{path}: line {line_numbers[int(np.argmin(passed))]} {complaint}")
    return t_ns, se3(rotation_from_quaternion(table[:, 4:]), table[:, 1:4])


def with_truth(sequence: Sequence, truth: Truth) -> Sequence:
    """Return the sequence with this truth.

    Raises DataError where the two do not overlap in time (both ranges and the likely cause are named), or
    where the measured rates of rotation fit the truth only with its quaternions read w first.
    """
    first, last = sequence.frames_t_ns[0], sequence.frames_t_ns[-1]
    if truth.t_ns[-1] < first or truth.t_ns[0] > last:
        raise DataError(
            f"{sequence.name}: the truth covers {_range_s(truth.t_ns)}, the frames {_range_s(sequence.frames_t_ns)}: "
            f"they do not overlap; {_clock_difference(sequence.frames_t_ns, truth.t_ns)}"
        )
    if _rates_fit_w_first(sequence, truth):
        raise DataError(f"{sequence.name}: the truth turns as the gyro says only if read w first; {_W_FIRST}")
    return replace(sequence, truth=truth)


def _w_first(quaternions: Array) -> Array:
    """Return quaternions (N, 4) whose scalar came first in the order x y z w."""
    return np.roll(quaternions, -1, axis=1)


def _looks_w_first(positions: Array, quaternions: Array) -> bool:
    """Judge the order of quaternions by the trajectory alone.

    A vehicle moves in one direction of its own frame. If that holds with w first and not as given, the order
    is wrong; where both readings do as well (no turn, or a hand-held camera), a start at the identity decides:
    read x y z w it would be a start upside down.
    """
    as_given = _concentration(positions, rotation_from_quaternion(quaternions))
    w_first = _concentration(positions, rotation_from_quaternion(_w_first(quaternions)))
    if w_first > _VEHICLE_CONCENTRATION and w_first > as_given + _LEAST_GAIN:
        return True
    starts_at_identity = np.linalg.norm(quaternions[0, 1:]) < _IDENTITY_TOLERANCE
    return bool(starts_at_identity and w_first >= as_given - _LEAST_GAIN)


def _concentration(positions: Array, R_world_imu: Array) -> float:
    """Return the mean resultant length, 0 to 1, of the body-frame displacements: 1 where all point the same way.

    Displacements are their own weights, so that noise at standstill does not count.
    """
    steps = np.diff(positions, axis=0)
    total = np.linalg.norm(steps, axis=1).sum()
    in_body = np.einsum("nji,nj->ni", R_world_imu[:-1], steps)
    return float(np.linalg.norm(in_body.sum(axis=0)) / total) if total > 0.0 else 0.0


def _rates_fit_w_first(sequence: Sequence, truth: Truth) -> bool:
    """Say whether the truth turns as the gyro says if its quaternions are read w first, and not as given.

    Read in the wrong order, a truth turns the other way and about other axes.
    """
    motion = sequence.motion
    usable = np.flatnonzero(np.isfinite(motion.values).all(axis=1))
    samples = usable[np.argsort(motion.t_ns[usable], kind="stable")]
    if samples.size < 2:
        return False
    within = (truth.t_ns >= motion.t_ns[samples[0]]) & (truth.t_ns <= motion.t_ns[samples[-1]])
    if within.sum() < 3:
        return False
    measured_radps = _mean_rates(motion.t_ns[samples], motion.values[samples, 3:], truth.t_ns[within])
    R_world_imu = truth.T_world_imu[within, :3, :3]
    re_read = rotation_from_quaternion(_w_first(quaternion_from_rotation(R_world_imu)))
    as_given, w_first = (_correlation(_rates(truth.t_ns[within], R), measured_radps) for R in (R_world_imu, re_read))
    return w_first > _FITTING_CORRELATION and 1.0 - w_first < _UNEXPLAINED_SHARE * (1.0 - as_given)


def _rates(t_ns: IntArray, R_world_imu: Array) -> Array:
    """Return the mean rates of rotation (N - 1, 3) rad/s between orientations (N, 3, 3), in the body frame."""
    steps = np.swapaxes(R_world_imu[:-1], -1, -2) @ R_world_imu[1:]
    rates: Array = so3_log(steps) * (NS_PER_S / np.diff(t_ns))[:, None]
    return rates


def _mean_rates(sample_t_ns: IntArray, samples_radps: Array, t_ns: IntArray) -> Array:
    """Return the means (N - 1, 3) of samples (S, 3), taken as straight lines, between stamps (N,)."""
    sample_s, at_s = (sample_t_ns - t_ns[0]) / NS_PER_S, (t_ns - t_ns[0]) / NS_PER_S
    areas = 0.5 * (samples_radps[1:] + samples_radps[:-1]) * np.diff(sample_s)[:, None]
    turned = np.vstack([np.zeros(3), np.cumsum(areas, axis=0)])
    at_stamps = np.stack([np.interp(at_s, sample_s, axis) for axis in turned.T], axis=1)
    means: Array = np.diff(at_stamps, axis=0) / np.diff(at_s)[:, None]
    return means


def _correlation(one: Array, other: Array) -> float:
    """Return the correlation of two series (N, 3) about their means (a gyro has a bias), over all axes at once."""
    a, b = one - one.mean(axis=0), other - other.mean(axis=0)
    norm = float(np.linalg.norm(a) * np.linalg.norm(b))
    return float((a * b).sum()) / norm if norm > 0.0 else 0.0


def _range_s(t_ns: IntArray) -> str:
    return f"{t_ns[0] / NS_PER_S:.3f} .. {t_ns[-1] / NS_PER_S:.3f} s"


def _clock_difference(frames_t_ns: IntArray, truth_t_ns: IntArray) -> str:
    """Name the likely reason why two recordings of one drive do not overlap in time."""
    frames_s, truth_s = frames_t_ns[0] / NS_PER_S, truth_t_ns[0] / NS_PER_S
    hours = (frames_s - truth_s) / 3600.0
    if abs(frames_s) > _EPOCH_S > abs(truth_s) or abs(truth_s) > _EPOCH_S > abs(frames_s):
        return f"one counts from its own start: add {frames_s - truth_s:.3f} s to the truth if both start together"
    if abs(hours) < 24.5 and abs(hours - round(hours)) * 3600.0 < max(1.0, abs(truth_t_ns[-1] / NS_PER_S - truth_s)):
        return f"the clocks are about {hours:.0f} h apart, as time zones are: shift the truth"
    return "the truth is of another drive or clock"
