"""Whether a trajectory belongs to a recording, or to a truth: the same clock, unit of length, rotations and axes.

Each check asks for rival readings of the file, and accuses it only where one of them fits far better than the file as
it is given: another unit of time, of length, another order of quaternions, inverse poses, poses that run backwards,
another body, exchanged axes. A file that fits under none is an estimate that went wrong, and is scored as it is.

Axes are exchanged, or have the wrong sign, where columns of a file are exchanged or its world is left-handed. Positions
that fit the truth's far better after a reflection are mirrored; those that fit, with orientations that are off by one
constant turn, are in other axes than these. The signed permutations are tried: with one of them, and no other that is
as simple, both fit. The fit is Kabsch's, "A solution for the best rotation to relate two sets of vectors" (1976),
without its rotations' handedness where a reflection is allowed.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache, cached_property
from itertools import permutations, product
from typing import Literal, NamedTuple

import numpy as np

from toolkit.datasets.trajectories.formats import CONJUGATE, INVERT_EACH, PosesFile, Reading
from toolkit.errors import DataError
from toolkit.geometry import (
    Array,
    BoolArray,
    IntArray,
    nearest_rotation,
    quaternion_from_rotation,
    se3,
    se3_inverse,
    so3_angle,
    so3_exp,
    so3_log,
    transposed,
)
from toolkit.measurements import NS_PER_S
from toolkit.motion_samples import TwistSamples
from toolkit.sequence import Sequence

# The rates of rotation decide where they follow another reading this closely and leave a third as much, or less,
# unexplained than under the file's own: slow turns correlate with unrelated ones by chance, 0.8 at times.
_FITTING_CORRELATION, _UNEXPLAINED_SHARE = 0.5, 1.0 / 3.0
# A body with other axes has three angles that are fitted: a reading, which has none, may leave a little more.
_FITTED_MORE = 1.25
# Rates that follow the gyro this closely are read rightly, and no other reading is tried.
_SURE_CORRELATION = 0.95
# Three angles are fitted to say that a body has other axes, and mounts are off by some degrees: more is asked for.
_TURNED_CORRELATION, _OTHER_AXES_RAD = 0.8, 0.3
# Rates are means over this long at least, over which even a jittery estimate has turned more than its noise.
_STEP_NS = NS_PER_S // 4
# Stamps beyond this count from an epoch, stamps below it from the start of a recording or of a day.
_EPOCH_S = 1e6
# A unit is wrong where most stamps miss the frames, and nearly all meet and cover half of them in another.
_MOST, _NEARLY_ALL, _COVERED = 0.5, 0.9, 0.5
_SCALES = (1e-3, 1e-6, 1e-9, 1e3, 1e6, 1e9)
# A unit of length is named where the median ratio of speeds, over enough steps in motion, is within this factor of it.
_LENGTHS = {"millimetres": 1000.0, "centimetres": 100.0}
_WITHIN_FACTOR, _FEWEST_STEPS, _MOVING_MPS = 1.25, 20, 0.1
# Largest errors of a fit: positions in shares of their extent, orientations by an angle. Estimates with more drift are
# not judged.
_FITTING_SHARE, _FITTING_RAD = 0.1, float(np.deg2rad(10.0))
# As given, positions must have this many times the error under the exchange, and an error above this share of their
# extent ...
_TIMES, _LEAST_SHARE = 3.0, 0.01
# ... or orientations an error above this angle. A path on a line determines neither.
_WRONG_RAD, _LEAST_SIDEWAYS = np.deg2rad(30.0), 0.05
_FEWEST = 10
# Number of poses, evenly spread, that are compared, and by which rates of rotation are.
_ENOUGH, _ENOUGH_TURNS = 500, 1000
_ALONG_AN_AXIS = 0.9
# Share of a path that its ends are apart, in a steady direction of the body, on a line; and no length at all (m).
_STEADY, _STILL = 0.95, 1e-9
# A turn of a body that is told, and is no other axes: an extrinsic that is a little off.
_LEAST_TOLD_RAD = float(np.deg2rad(2.0))
_ROUNDED = 1e-6
_NAMES = "xyz"
Struck = Literal["positions alone", "positions and quaternions", "the whole world"]


class Reference(NamedTuple):
    """The reference of a trajectory: stamps (K,), rates of rotation (S, 3) rad/s, and positions where known.

    ``clock`` and ``turns`` name the sources of these stamps and rates in messages. ``positions`` (P, 3) m are the
    truth's; without them ``speeds_mps`` (S,) of the motion samples tell the unit of length, and may be NaN.
    """

    name: str
    clock: str
    turns: str
    t_ns: IntArray
    rates_t_ns: IntArray
    rates_radps: Array
    positions_t_ns: IntArray
    positions: Array
    speeds_mps: Array

    @classmethod
    def of_recording(cls, sequence: Sequence) -> "Reference":
        """Return the frames, the gyro, and the truth or else the twists of a recording; no rates without motion."""
        motion, truth = sequence.motion, sequence.truth
        usable = np.flatnonzero(np.isfinite(motion.values).all(axis=1) & (motion.values.shape[1] > 0))
        samples = usable[np.argsort(motion.t_ns[usable], kind="stable")]
        twists = isinstance(motion, TwistSamples)
        speeds = np.linalg.norm(motion.values[samples, :3], axis=1) if twists else np.full(samples.size, np.nan)
        return cls(
            sequence.name, "the frames", "the gyro does", sequence.frames_t_ns,
            motion.t_ns[samples], motion.values[samples, 3:].reshape(-1, 3),
            np.empty(0, np.int64) if truth is None else truth.t_ns,
            np.empty((0, 3)) if truth is None else truth.T_world_imu[:, :3, 3],
            speeds,
        )  # fmt: skip

    @classmethod
    def of_truth(cls, name: str, t_ns: IntArray, T_world_imu: Array) -> "Reference":
        """Return a truth (N,), (N, 4, 4) whose recording is not there: its turns are in the place of a gyro's."""
        turns = so3_log(transposed(T_world_imu[:-1, :3, :3]) @ T_world_imu[1:, :3, :3])
        rates: Array = turns / (np.diff(t_ns) / NS_PER_S)[:, None]
        middle_ns, positions = t_ns[:-1] + np.diff(t_ns) // 2, T_world_imu[:, :3, 3]
        unknown = np.full(middle_ns.size, np.nan)
        return cls(name, "the truth", "the truth does", t_ns, middle_ns, rates, t_ns, positions, unknown)


def of_the_camera(sequence: Sequence) -> Reading:
    R_cam_imu = sequence.rig.T_imu_cam[:3, :3].T
    remedy = "the poses look like the left camera's: multiply each by the inverse of T_imu_cam from the right"
    return Reading("read as the camera's", remedy, lambda R_world_cam: R_world_cam @ R_cam_imu, is_of_a_body=True)


_INVERTED = Reading("inverted", CONJUGATE, transposed)
_EACH_INVERTED = Reading("each pose is inverted", INVERT_EACH, transposed)
# Poses in the reverse of their order, on stamps that go on.
_BACKWARDS = Reading(
    "read backwards",
    "its poses run backwards: write them in the order of their stamps",
    lambda rotations: rotations[::-1],
    -1,
)


def body_of(
    file: PosesFile, reference: Reference, t_ns: IntArray, matched: tuple[Array, Array] | None, *readings: Reading
) -> "BodyTurn | None":
    """Return the turn of a file's body against the truth's, which may have other axes; None where it does not show.

    ``t_ns`` (N,) are the stamps of its poses, ``matched`` the truth's and the estimate's poses (n, 4, 4) of the same
    times, where there is a truth; ``readings`` are tried beside the usual ones. Raises DataError where it belongs to
    the reference only in another clock or unit, under another reading or with exchanged axes, with the remedy.
    """
    what = str(file.path)
    check_clock(what, reference, t_ns)
    _check_length_unit(what, reference, t_ns, file.T_world_imu[:, :3, 3])
    fit = None if matched is None else _fit(*matched)
    other_axes = None if fit is None else _exchange(fit)
    # The effect of a reflection on orientations resembles other mistakes in them, so it is refused first.
    is_mirrored = fit is not None and fit.is_mirrored
    turn = None if is_mirrored else _body(file, reference, t_ns, matched, fit, readings)
    if other_axes is None or (turn is not None and turn.is_other_body):
        return turn
    raise DataError(
        f"{what}: it fits the truth with {other_axes}, and not as given; one of the two is written in other axes than "
        "it is read in: write both in the same"
    )


# Clock and unit of length --------------------------------------------------------------------------------------------


def check_clock(what: str, reference: Reference, t_ns: IntArray) -> None:
    """Raise DataError, with the likely cause, where stamps (N,) overlap the reference's in another unit or not."""
    frames_t_ns = reference.t_ns
    scale = _fitting_scale(frames_t_ns, t_ns)
    overlap = t_ns[-1] >= frames_t_ns[0] and t_ns[0] <= frames_t_ns[-1]
    if overlap and scale is None:
        return
    if scale is None:
        mismatch, cause = "they do not overlap", _clock_difference(frames_t_ns, t_ns)
    else:
        mismatch, cause = "they fit only in another unit of time", f"multiply the stamps by {scale:g}"
    ranges = f"{what} covers {range_s(t_ns)}, {reference.clock} {range_s(frames_t_ns)}"
    raise DataError(f"{reference.name}: {ranges}: {mismatch}; {cause}")


def range_s(t_ns: IntArray) -> str:
    return f"{t_ns[0] / NS_PER_S:.3f} .. {t_ns[-1] / NS_PER_S:.3f} s"


def _fitting_scale(frames_t_ns: IntArray, t_ns: IntArray) -> float | None:
    """Return the factor that alone makes stamps (N,) those of the frames, or None."""
    first, last = float(frames_t_ns[0]), float(frames_t_ns[-1])

    def share_within(stamps: Array) -> float:
        return float(((stamps >= first) & (stamps <= last)).mean())

    stamps = t_ns.astype(np.float64)
    if share_within(stamps) > _MOST:
        return None
    for scale in _SCALES:
        scaled: Array = scale * stamps
        if share_within(scaled) >= _NEARLY_ALL and scaled[-1] - scaled[0] >= _COVERED * (last - first):
            return scale
    return None


def _clock_difference(frames_t_ns: IntArray, t_ns: IntArray) -> str:
    """Name the likely reason why two recordings of one drive do not overlap in time."""
    frames_s, other_s = frames_t_ns[0] / NS_PER_S, t_ns[0] / NS_PER_S
    hours = (frames_s - other_s) / 3600.0
    if abs(frames_s) > _EPOCH_S > abs(other_s) or abs(other_s) > _EPOCH_S > abs(frames_s):
        return f"one counts from its own start: add {frames_s - other_s:.3f} s to it if both start together"
    if abs(hours) < 24.5 and abs(hours - round(hours)) * 3600.0 < max(1.0, abs(t_ns[-1] / NS_PER_S - other_s)):
        return f"the clocks are about {hours:.0f} h apart, as time zones are: shift it"
    return "it is of another drive or clock"


def _check_length_unit(what: str, reference: Reference, t_ns: IntArray, positions: Array) -> None:
    """Raise DataError where positions (N, 3) move as fast as the truth, or else the twists, only in another unit."""
    steps = Steps.of(t_ns)
    if reference.positions_t_ns.size > 1:
        measured_mps = steps.speeds(values_at(reference.positions_t_ns, reference.positions, t_ns))
    elif reference.rates_t_ns.size > 1:
        measured_mps = values_at(reference.rates_t_ns, reference.speeds_mps[:, None], t_ns[steps.start])[:, 0]
    else:
        return
    known = np.isfinite(measured_mps) & (measured_mps > _MOVING_MPS)
    if known.sum() < _FEWEST_STEPS:
        return
    ratio = float(np.median(steps.speeds(positions)[known] / measured_mps[known]))
    for unit, factor in _LENGTHS.items():
        if factor / _WITHIN_FACTOR < ratio < factor * _WITHIN_FACTOR:
            found = f"{what} moves {ratio:.4g} times as fast as measured"
            raise DataError(f"{reference.name}: {found}; it is in {unit}: divide its positions by {factor:g}")


def values_at(t_ns: IntArray, values: Array, at_ns: IntArray) -> Array:
    """Return values (S, C) on stamps, taken as straight lines, at others (N,); NaN outside their time."""
    t_s, at_s = (t_ns - t_ns[0]) / NS_PER_S, (at_ns - t_ns[0]) / NS_PER_S
    return np.stack([np.interp(at_s, t_s, column, np.nan, np.nan) for column in values.T], axis=1)


# Rates of rotation ---------------------------------------------------------------------------------------------------


class Steps(NamedTuple):
    """Steps between stamps (N,), of their indices (M,): from each one to the first that is far enough behind it."""

    t_ns: IntArray
    start: IntArray
    end: IntArray
    duration_s: Array

    @classmethod
    def of(cls, t_ns: IntArray, shortest_ns: int = _STEP_NS) -> "Steps":
        """Return the steps of at least ``shortest_ns`` that end within the stamps."""
        end = np.searchsorted(t_ns, t_ns + shortest_ns)
        start = np.flatnonzero(end < t_ns.size)
        return cls(t_ns, start, end[start], (t_ns[end[start]] - t_ns[start]) / NS_PER_S)

    def rates(self, R_world_imu: Array) -> Array:
        """Return the mean rates of rotation (M, 3) rad/s of orientations (N, 3, 3), in the body frame."""
        turns = so3_log(transposed(R_world_imu[self.start]) @ R_world_imu[self.end])
        return np.asarray(turns / self.duration_s[:, None])

    def mean_rates(self, sample_t_ns: IntArray, rates_radps: Array) -> Array:
        """Return the means (M, 3) of rates (S, 3) rad/s that are measured at stamps (S,)."""
        at_stamps = _turned(sample_t_ns, rates_radps, self.t_ns)
        return np.asarray((at_stamps[self.end] - at_stamps[self.start]) / self.duration_s[:, None])

    def speeds(self, positions: Array) -> Array:
        return np.asarray(np.linalg.norm(positions[self.end] - positions[self.start], axis=1) / self.duration_s)


def _turned(sample_t_ns: IntArray, rates_radps: Array, at_ns: IntArray) -> Array:
    """Return the integrals (N, 3) rad of rates (S, 3), taken as straight lines, from the first to stamps (N,)."""
    sample_s, at_s = (sample_t_ns - sample_t_ns[0]) / NS_PER_S, (at_ns - sample_t_ns[0]) / NS_PER_S
    areas = 0.5 * (rates_radps[1:] + rates_radps[:-1]) * np.diff(sample_s)[:, None]
    reached = np.vstack([np.zeros(3), np.cumsum(areas, axis=0)])
    return np.stack([np.interp(at_s, sample_s, axis) for axis in reached.T], axis=1)


class Turns(NamedTuple):
    """Whether rates of rotation agree with the gyro's, and the turn R_reference_body (3, 3) of a body with other axes.

    It is found where they agree once they are turned as a whole (the best turn: Kabsch 1976), and not as they are; a
    camera's poses beside an IMU's are the usual case.
    """

    confirmed: bool
    R_reference_body: Array | None = None


def check_turns(
    what: str,
    reference: Reference,
    t_ns: IntArray,
    R_world_body: Array,
    readings: Iterable[Reading],
    fitted_more: float = np.inf,
) -> Turns:
    """Hold rotations (N, 3, 3) against the gyro; neither is found where the recording is too short or straight.

    Raises DataError where they agree under one of the readings, and neither as given nor with other axes of the body:
    misread rotations turn the other way and about other axes. A reading may leave ``fitted_more`` times as much
    unexplained as such a body, which is none where the rotations are known to be the reference's own.
    """
    within = stamps_among(t_ns, reference.rates_t_ns)
    steps, given = Steps.of(t_ns[within]), R_world_body[within]
    if steps.start.size < 2:
        return Turns(confirmed=False)
    measured, rates = steps.mean_rates(reference.rates_t_ns, reference.rates_radps), steps.rates(given)
    turn, _ = nearest_rotation((measured - measured.mean(axis=0)).T @ (rates - rates.mean(axis=0)))
    as_given, turned = _correlation(rates, measured), _correlation(rates @ turn.T, measured)
    far_better = 1.0 - _UNEXPLAINED_SHARE * (1.0 - as_given)
    is_other = steps.start.size >= _FEWEST_STEPS and turned > max(_TURNED_CORRELATION, far_better)
    other = turn if is_other and so3_angle(turn) > _OTHER_AXES_RAD else None
    if as_given > _SURE_CORRELATION:
        return Turns(True, other)
    fits = {reading: _correlation(steps.rates(reading.reread(given)), measured) for reading in readings}
    best, fit = max(fits.items(), key=lambda item: item[1])
    beats_a_body = other is None or best.is_of_a_body or fit > 1.0 - fitted_more * (1.0 - turned + _ROUNDED)
    if fit > max(_FITTING_CORRELATION, far_better) and beats_a_body:
        raise _only_if(what, reference, best)
    return Turns(as_given > max(_FITTING_CORRELATION, fit), other)


def stamps_among(t_ns: IntArray, sample_t_ns: IntArray) -> BoolArray:
    """Say which stamps (N,) lie between the first and the last of samples (S,); none where there are fewer than two."""
    if sample_t_ns.size < 2:
        return np.zeros(t_ns.size, dtype=bool)
    return np.asarray((t_ns >= sample_t_ns[0]) & (t_ns <= sample_t_ns[-1]))


def _correlation(one: Array, other: Array) -> float:
    """Return the correlation of two series (N, 3) about their means (a gyro has a bias), over all axes at once."""
    a, b = one - one.mean(axis=0), other - other.mean(axis=0)
    norm = float(np.linalg.norm(a) * np.linalg.norm(b))
    return float((a * b).sum()) / norm if norm > 0.0 else 0.0


def _only_if(what: str, reference: Reference, reading: Reading) -> DataError:
    return DataError(f"{reference.name}: {what} turns as {reference.turns} only if {reading.only_if}; {reading.remedy}")


# The body ------------------------------------------------------------------------------------------------------------


class BodyTurn(NamedTuple):
    """The turn R_truth_body (3, 3) that orientations have in common, how they scatter about it, and what hides it.

    ``scatter_rad`` is the median angle from it; the fit of the positions leaves a turn of ``unknown_rad`` open.
    """

    R_truth_body: Array
    scatter_rad: float
    unknown_rad: float

    @property
    def angle_rad(self) -> float:
        return float(so3_angle(self.R_truth_body))

    @property
    def is_told(self) -> bool:
        """Say whether the turn is more than the errors of both."""
        return self.angle_rad > max(_LEAST_TOLD_RAD, _TIMES * self.scatter_rad, _TIMES * self.unknown_rad)

    @property
    def is_other_body(self) -> bool:
        return self.is_told and self.angle_rad > _OTHER_AXES_RAD


def _body(
    file: PosesFile,
    reference: Reference,
    t_ns: IntArray,
    matched: tuple[Array, Array] | None,
    fit: "_Fit | None",
    readings: tuple[Reading, ...],
) -> BodyTurn | None:
    """Judge every reading by what it leaves of the orientations once the positions are laid over each other.

    That is at best one turn of the body, however large. Where positions do not tell, the rates of rotation do.
    """
    what = str(file.path)
    others = (*filter(None, (file.other_order,)), _INVERTED, _BACKWARDS, *readings)
    if fit is not None and fit.turns:
        given, left = fit.body, {one: fit.reread(one).body for one in others}
        most_rad = min(_FITTING_RAD, fit.turned_by_rad / _TIMES)
        fits = given.scatter_rad < most_rad
        if fits and not given.is_other_body:
            return given
        # A reading that leaves no turn is likelier than one that leaves a turn, which a loop may make by chance.
        best = min(left, key=lambda one: left[one].scatter_rad)
        least_rad = given.scatter_rad * (_FITTED_MORE if fits else 1.0 / _TIMES) + _ROUNDED
        if not (fits and left[best].is_other_body) and left[best].scatter_rad < min(most_rad, least_rad):
            raise _only_if(what, reference, best)
        if fits:
            return given
    if matched is not None and fit is None and _fits_inverted(*matched):
        raise _only_if(what, reference, _EACH_INVERTED)
    some = slice(None, None, 1 + len(file) // _ENOUGH_TURNS)
    t_ns, R_world_body = t_ns[some], file.T_world_imu[some, :3, :3]
    confirmed, turn = check_turns(what, reference, t_ns, R_world_body, others, _FITTED_MORE)
    if turn is None and matched is not None:
        turn = _turned_on_a_line(*matched)
    if not confirmed and turn is None:
        file.check_order()
    return None if turn is None else BodyTurn(turn, 0.0, 0.0)


def _fits_inverted(truth: Array, estimate: Array) -> bool:
    """Say whether poses (n, 4, 4) fit once inverted; those that stand in one place and turn are a circle then."""
    extents_m = [float(np.linalg.norm(np.ptp(poses[:, :3, 3], axis=0))) for poses in (estimate, truth) if len(poses)]
    if len(extents_m) < 2 or extents_m[0] < _LEAST_SHARE * extents_m[1]:
        return False
    fit = _fit(truth, se3_inverse(estimate))
    return fit is not None and fit.turns and fit.body.scatter_rad < min(_FITTING_RAD, fit.turned_by_rad / _TIMES)


def _turned_on_a_line(truth: Array, estimate: Array) -> Array | None:
    """Return the least turn of the body that makes it travel in the same direction of its own axes on a line, or None.

    A line leaves the turn about it open. None where either changes its direction, both travel alike, or one states no
    orientation, for they are all one.
    """
    if any(np.ptp(poses[:, :3, :3], axis=0).max() == 0.0 for poses in (truth, estimate) if len(poses)):
        return None
    directions = [_travels(poses[np.isfinite(poses).all(axis=(1, 2))]) for poses in (truth, estimate)]
    if any(np.linalg.norm(one) < _STEADY for one in directions):
        return None
    y, x = (one / np.linalg.norm(one) for one in directions)
    axis = np.cross(x, y)
    angle = float(np.arctan2(np.linalg.norm(axis), x @ y))
    if angle < _OTHER_AXES_RAD:
        return None
    if np.linalg.norm(axis) < _STILL:  # backwards, about whatever is upright
        axis = np.cross(x, np.eye(3)[int(np.argmin(np.abs(x)))])
    return np.asarray(so3_exp(angle * axis / np.linalg.norm(axis)))


def _travels(poses: Array) -> Array:
    """Return the mean direction of travel (3,) in the body's axes of poses (n, 4, 4), shorter where it changes."""
    if len(poses) < _FEWEST:
        return np.zeros(3)
    way = poses[-1, :3, 3] - poses[0, :3, 3]
    path_m = float(np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1).sum())
    return np.asarray((transposed(poses[:, :3, :3]) @ way).mean(axis=0) / max(path_m, _STILL))


def other_axes(R_reference_body: Array) -> str:
    """Describe a turn (3, 3) from a body's axes to the truth's, and what to do about it."""
    largest = np.abs(R_reference_body).argmax(axis=0)
    if (np.abs(R_reference_body[largest, range(3)]) > _ALONG_AN_AXIS).all():
        signs = ("" if R_reference_body[row, column] > 0.0 else "-" for column, row in enumerate(largest))
        signed = [f"{sign}{_NAMES[row]}" for sign, row in zip(signs, largest, strict=True)]
        along = f"its x, y and z point along the truth's {signed[0]}, {signed[1]} and {signed[2]}"
    else:
        along = f"turned by {float(np.degrees(so3_angle(R_reference_body))):.0f} deg"
    x, y, z, w = quaternion_from_rotation(R_reference_body).tolist()
    quaternion = f"x y z w {x:.3f} {y:.3f} {z:.3f} {w:.3f}"
    return f"{along}; multiply each pose by the inverse of the extrinsic (about {quaternion}) from the right"


# Exchanged axes ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Exchange:
    """A signed permutation (3, 3) of axes, and what it has struck."""

    matrix: Array
    struck: Struck

    def reread(self, T_world_body: Array) -> Array:
        """Return poses (n, 4, 4) with the axes set right; an exchange of two undoes itself.

        A quaternion whose three columns are permuted turns about the permuted axis; where that is a reflection, by the
        opposite angle.
        """
        rotations, positions = T_world_body[:, :3, :3], T_world_body[:, :3, 3] @ self.matrix.T
        if self.struck == "positions alone":
            return se3(rotations, positions)
        turned = self.matrix @ rotations @ self.matrix.T
        inverted = self.struck == "positions and quaternions" and np.linalg.det(self.matrix) < 0.0
        return se3(transposed(turned) if inverted else turned, positions)

    @property
    def description(self) -> str:
        """Say what must be done to the axes: "y and z exchanged (positions alone)"."""
        order = np.abs(self.matrix).argmax(axis=1)
        moved = [axis for axis in range(3) if order[axis] != axis]
        turned = [_NAMES[axis] for axis in range(3) if self.matrix[axis].sum() < 0.0]
        changes = []
        if len(moved) == 2:
            changes.append(f"{_NAMES[moved[0]]} and {_NAMES[moved[1]]} exchanged")
        elif moved:
            changes.append(f"x, y and z read from the columns {', '.join(_NAMES[axis] for axis in order)}")
        if turned:
            changes.append(f"the sign of {' and '.join(turned)} changed")
        return f"{' and '.join(changes)} ({self.struck})"


@cache
def exchanges() -> tuple[Exchange, ...]:
    """Return all signed permutations but the identity, the simplest first."""
    found = []
    for order, signs in product(permutations(range(3)), product((1.0, -1.0), repeat=3)):
        matrix = np.diag(signs) @ np.eye(3)[list(order)]
        moved = sum(axis != place for place, axis in enumerate(order)) + 1.5 * sum(sign < 0.0 for sign in signs)
        struck: tuple[Struck, ...] = ("positions alone", "positions and quaternions", "the whole world")
        # With a proper permutation the last two are the same.
        those = struck if np.linalg.det(matrix) < 0.0 else struck[:2]
        found += [(moved, Exchange(matrix, one)) for one in those] if moved else []
    return tuple(exchange for _, exchange in sorted(found, key=lambda one: one[0]))


def _exchange(fit: "_Fit") -> str | None:
    """Say under which exchange of axes alone poses fit the truth's; None where they do as given, or under none."""
    if fit.is_mirrored:
        return _named(fit) or "its positions mirrored"
    turns_alike = fit.turned_rad(_AS_GIVEN) < _WRONG_RAD or fit.body.scatter_rad < _FITTING_RAD
    return None if turns_alike or not fit.turns else _named(fit)


def _named(fit: "_Fit") -> str | None:
    """Name the simplest exchange under which positions and orientations fit, these far better than as given."""
    inverse = _Fit(fit.truth, se3_inverse(fit.estimate))
    if inverse.is_near and not inverse.is_mirrored and inverse.turned_rad(_AS_GIVEN) < _FITTING_RAD:
        return "each pose inverted"
    if not fit.turns:
        return None
    least_rad = min(_FITTING_RAD, fit.turned_rad(_AS_GIVEN) / _TIMES)
    fitting = (one for one in exchanges() if fit.off_share(one.matrix) < _FITTING_SHARE)
    return next((one.description for one in fitting if fit.turned_rad(one) < least_rad), None)


_AS_GIVEN = Exchange(np.eye(3), "positions alone")


# The fit -------------------------------------------------------------------------------------------------------------


def _fit(truth: Array, estimate: Array) -> "_Fit | None":
    """Return the fit of poses (n, 4, 4); None where they are few, on a line, or near the truth in no axes."""
    finite = np.isfinite(truth).all(axis=(1, 2)) & np.isfinite(estimate).all(axis=(1, 2))
    rows = np.flatnonzero(finite)[:: 1 + len(truth) // _ENOUGH]
    if rows.size < _FEWEST:
        return None
    fit = _Fit(truth[rows], estimate[rows])
    leaves_a_line = float(fit.overlaps[1]) > _LEAST_SIDEWAYS**2 * float(fit.overlaps[0])
    return fit if leaves_a_line and fit.is_near else None


class _Fit:
    """Poses (n, 4, 4) against the truth's, positions laid over each other under any exchange of their axes."""

    def __init__(self, truth: Array, estimate: Array) -> None:
        y, x = (poses[:, :3, 3] - poses[:, :3, 3].mean(axis=0) for poses in (truth, estimate))
        self.truth, self.estimate = truth, estimate
        # Each in its own extent: the scale of a single camera's estimate is free.
        extents = float(np.linalg.norm(y) * np.linalg.norm(x))
        self._covariance = y.T @ x / (extents or 1.0)
        _, self.overlaps = nearest_rotation(self._covariance)

    @property
    def is_near(self) -> bool:
        return min(self.off_share(np.eye(3)), self.off_share(-np.eye(3))) < _FITTING_SHARE

    @property
    def is_mirrored(self) -> bool:
        """Say whether the positions fit far better after a reflection."""
        return bool(self.off_share(np.eye(3)) > max(_TIMES * self.off_share(-np.eye(3)), _LEAST_SHARE))

    @property
    def turns(self) -> bool:
        return self.turned_by_rad > _FITTING_RAD

    @cached_property
    def turned_by_rad(self) -> float:
        """How much the orientations of that which turns less change: the median angle from their mean."""
        both = (poses[:, :3, :3] for poses in (self.truth, self.estimate))
        return min(_scatter_rad(rotations)[1] for rotations in both)

    @cached_property
    def body(self) -> BodyTurn:
        """The turn of the body that is left of the orientations once the positions are laid over each other."""
        if not self.is_near:
            return BodyTurn(np.eye(3), np.inf, np.inf)
        aligned = nearest_rotation(self._covariance)[0] @ self.estimate[:, :3, :3]
        turn, scatter_rad = _scatter_rad(transposed(self.truth[:, :3, :3]) @ aligned)
        unknown_rad = self.off_share(np.eye(3)) / max(float(np.sqrt(max(self.overlaps[1], 0.0))), 1e-9)
        return BodyTurn(turn, scatter_rad, unknown_rad)

    def reread(self, reading: Reading) -> "_Fit":
        """Return the fit of the poses read otherwise."""
        rotations, positions = self.estimate[:, :3, :3], self.estimate[:, :3, 3]
        return _Fit(self.truth, se3(reading.reread(rotations), positions[:: reading.step]))

    def off_share(self, matrix: Array) -> float:
        """Return how far positions whose axes are exchanged are off the truth's at best, of the truth's extent."""
        _, overlaps = nearest_rotation(self._covariance @ matrix.T)
        return float(np.sqrt(max(1.0 - float(overlaps.sum()) ** 2, 0.0)))

    def turned_rad(self, exchange: Exchange) -> float:
        """Return the median angle between the truth's orientations and those under an exchange."""
        aligned = nearest_rotation(self._covariance @ exchange.matrix.T)[0] @ exchange.reread(self.estimate)[:, :3, :3]
        return float(np.median(so3_angle(aligned @ transposed(self.truth[:, :3, :3]))))


def _scatter_rad(rotations: Array) -> tuple[Array, float]:
    """Return the rotation (3, 3) nearest to the mean of rotations (n, 3, 3), and their median angle from it."""
    mean, _ = nearest_rotation(rotations.mean(axis=0))
    return mean, float(np.median(so3_angle(mean.T @ rotations)))
