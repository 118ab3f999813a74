"""A truth whose motion differs from the camera's: it is of another motion, or vision's scale is wrong.

Displacements and rotations of the camera over windows of time, chained from frame to frame, are compared with those of
the truth. Vision's steps have another length where the baseline or the focal length is wrong, or the truth is in
another unit. They have another direction where the truth is of another recording, runs backwards or is in other axes.
If the rotations agree at shifted times, the truth's clock has an offset.
"""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from toolkit.audit.fault import Evidence, Fault, Symptom, Undecided
from toolkit.audit.parts.clocks import LEAST_OFFSET_S, OFFSET_SIGMAS
from toolkit.audit.parts.intervals import LEAST_INTERVALS, is_comparable
from toolkit.audit.parts.windows import (
    LEAST_MOVED_M,
    LEAST_TURNED_RAD,
    LEAST_WINDOWS,
    SYSTEMATIC,
    WINDOW_S,
    WindowMedian,
    Windows,
    longer,
    moving,
    off_by,
    windows,
)
from toolkit.datasets.trajectories.exchanged_axes import exchanges
from toolkit.geometry import Array, BoolArray
from toolkit.resampling import NS_PER_S
from toolkit.sequence import Truth

# Least difference, as a share of the larger motion: unrelated motions differ by more than their size, a truth with
# errors by far less.
MOST_OFF = 0.5
# Rotations are compared if the truth has them in at least this share of the windows. A vehicle that fills the view lets
# vision rotate wrongly, but not for so long.
LEAST_TURNING = 1.0 / 3.0
# Limits of a step between true poses: a distance (m), a multiple of the usual speed, and a speed (m/s).
LEAST_LEAP_M, LEAP, LEAST_LEAP_MPS = 0.5, 10.0, 10.0
# The camera drives if it moves by so many times LEAST_MOVED_M in a window. The truth must stand in this share of the
# windows, longer than another vehicle fills the view; a measured truth does not repeat a pose exactly.
DRIVES, MOST_STANDING = 5.0, 0.5
# From this root mean square difference on, as a share of the motion, other readings of the truth are tried. One is
# reported if it makes the difference so many times smaller, which no sound recording at hand has.
LEAST_APART, TIMES_NEARER = 0.1, 3.0
# Units of length (m) that a truth may be in and that are only named; millimetres and centimetres are converted
# (`units`).
LENGTHS = {"feet": 0.3048, "yards": 0.9144, "inches": 0.0254, "kilometres": 1000.0}
_WHERE = "check the baseline and the focal length (the camera's calibration file), and the unit of the truth"
_OTHER = (
    "check that the truth is this recording's, in order and in the axes it is read in; do not rely on errors against it"
)

_AXES = "write the truth in the axes it is read in: the world's, z upwards, and the body's that the samples have"


def check(evidence: Evidence) -> Symptom | Undecided | None:
    """Compare the camera's own motion with the truth's, in direction and in size."""
    truth = evidence.sequence.truth
    if truth is None or truth.t_ns.size < 2 or evidence.spoilt_by or not is_comparable(evidence.sequence):
        return None
    if evidence.camera_motion.known.sum() < LEAST_INTERVALS:
        return None
    return _broken(truth) or _by_another_clock(evidence) or _compared_with(evidence, truth)


def _broken(truth: Truth) -> Symptom | None:
    """Report poses that are not finite, and steps that no vehicle makes: a reset, a flipped bit."""
    finite = np.isfinite(truth.T_world_imu).all(axis=(1, 2))
    if not finite.all():
        return _symptom(
            f"{int((~finite).sum())} of {finite.size} true poses are not finite", "leave them out of the file"
        )
    step_s = np.maximum(np.diff(truth.t_ns), 1) / NS_PER_S
    step_m = np.linalg.norm(np.diff(truth.T_world_imu[:, :3, 3], axis=0), axis=1)
    usual_mps = float(np.quantile(step_m / step_s, 0.9))
    leaps = (step_m > LEAST_LEAP_M) & (step_m / step_s > max(LEAP * usual_mps, LEAST_LEAP_MPS))
    if not leaps.any():
        return None
    row = int(np.argmax(np.where(leaps, step_m, 0.0)))
    at_s = (truth.t_ns[row] - truth.t_ns[0]) / NS_PER_S
    return _symptom(
        f"the truth jumps {int(leaps.sum())} time(s), the farthest by {step_m[row]:.3g} m at {at_s:.1f} s of it",
        "cut it there, or leave the pose out: every position error includes the jump",
    )


def _compared_with(evidence: Evidence, truth: Truth) -> Symptom | Undecided | None:
    both = windows(evidence.sequence, evidence.camera_motion, truth)
    moved, turned = moving(both.displaced_m, LEAST_MOVED_M), moving(both.turned_rad, LEAST_TURNED_RAD)
    if (stands := _standing(both, moved) or _looking_one_way(truth, both)) is not None:
        return stands
    if moved.sum() < LEAST_WINDOWS:
        return Undecided(
            f"the truth moves by {LEAST_MOVED_M:g} m and more, and the camera's own motion is known, in {moved.sum()} "
            f"windows of {WINDOW_S:g} s; {LEAST_WINDOWS} are needed"
        )
    if (other := _read_otherwise(evidence, truth, both)) is not None:
        return other
    off = {"moves": off_by(both.displaced_m[:, moved])}
    if turned.sum() >= max(LEAST_WINDOWS, LEAST_TURNING * moved.sum()):
        off["turns"] = off_by(both.turned_rad[:, turned])
    elsewhere = {
        how: f"it {how} differently, by {100.0 * share.value:.0f} +- {100.0 * share.error:.0f} % of the larger of both"
        for how, share in off.items()
        if share.value - share.by_chance > MOST_OFF
    }
    seen, true = both.displaced_m[:, moved]
    scale, only_longer = longer(seen, true)
    if "turns" in elsewhere or (elsewhere and not only_longer):
        return _symptom(f"the truth's motion is not the camera's: {' and '.join(elsewhere.values())}", _OTHER)
    if not only_longer or abs(scale.value - 1.0) < SYSTEMATIC + scale.by_chance:
        return _doubtful(scale) if only_longer else None
    unit = "".join(f", as of one in {name}" for name, m in LENGTHS.items() if abs(scale.value / m - 1.0) < SYSTEMATIC)
    return _symptom(f"vision's steps are {scale.value:.3f} +- {scale.error:.3f} times the truth's{unit}", _WHERE)


def _doubtful(scale: WindowMedian) -> Undecided | None:
    """Return a scale that is beyond chance and within the limit of sound recordings, as undecided."""
    if abs(scale.value - 1.0) <= scale.by_chance:
        return None
    return Undecided(
        f"vision's steps are {scale.value:.3f} +- {scale.error:.3f} times the truth's, which is more than chance and "
        "no more than in recordings without faults: the truth's unit, the baseline or the focal length may be off "
        "by it"
    )


def _standing(both: Windows, moved: BoolArray) -> Symptom | None:
    """Report a truth that stands in half of the windows while the camera drives, or repeats a pose exactly."""
    drives_m = np.linalg.norm(both.displaced_m[0], axis=1)
    frozen = (both.displaced_m[1] == 0.0).all(axis=1) & (both.turned_rad[1] == 0.0).all(axis=1)
    apart = ~moved & (drives_m > DRIVES * LEAST_MOVED_M)
    in_most = apart.sum() >= max(LEAST_WINDOWS, MOST_STANDING * moved.size)
    if not in_most and (apart & frozen).sum() < LEAST_WINDOWS:
        return None
    speed_mps = float(np.median(drives_m[apart])) / WINDOW_S
    return _symptom(
        f"the truth stands still in {apart.sum()} of {moved.size} windows of {WINDOW_S:g} s in which the camera moves "
        f"at {speed_mps:.2g} m/s",
        "it is no truth of this motion, or was frozen: leave it out; errors and consistency against it are meaningless",
    )


def _looking_one_way(truth: Truth, both: Windows) -> Symptom | None:
    """Report a truth whose orientations are all equal, as if none was written, while the camera rotates.

    A measured truth does not repeat an orientation exactly, so the camera's rotation only has to exceed its noise.
    """
    turns_rad = np.linalg.norm(both.turned_rad[0], axis=1)
    turns = turns_rad > LEAST_TURNED_RAD
    if np.ptp(truth.T_world_imu[:, :3, :3], axis=0).max() > 0.0 or turns.sum() < LEAST_WINDOWS:
        return None
    return _symptom(
        f"all orientations of the truth are equal, and in {turns.sum()} of {turns.size} windows of {WINDOW_S:g} s the "
        f"camera turns by {float(np.median(turns_rad[turns])):.2g} rad (median)",
        "write the orientations, or leave the truth out: errors of orientation and NEES against it are meaningless",
    )


def _read_otherwise(evidence: Evidence, truth: Truth, both: Windows) -> Symptom | None:
    """Report a truth that agrees with the camera if read backwards or in other axes, and not as given (``both``)."""
    given = _apart(both)
    if not given > LEAST_APART:
        return None
    for reading, remedy, T_world_imu in _readings(truth.T_world_imu):
        apart = _apart(windows(evidence.sequence, evidence.camera_motion, replace(truth, T_world_imu=T_world_imu)))
        if apart < given / TIMES_NEARER:
            summary = (
                f"the truth's motion agrees with the camera's only for a truth {reading}, with a difference of "
                f"{apart:.1%}"
            )
            return _symptom(f"{summary} in place of {given:.0%}", remedy)
    return None


def _readings(T_world_imu: Array) -> Iterator[tuple[str, str, Array]]:
    """Yield other readings of a truth: a description, what to do about it, and the poses."""
    yield "whose poses run backwards", "write them in the order of their stamps", T_world_imu[::-1]
    for exchange in exchanges():
        yield f"with {exchange.description}", _AXES, exchange.reread(T_world_imu)


def _apart(both: Windows) -> float:
    """Return the root mean square difference over windows, as a share of the truth's displacements and rotations."""
    squared = [
        np.mean((x[0] - x[1]) ** 2) / max(float(np.mean(x[1] ** 2)), least**2)
        for x, least in ((both.displaced_m, LEAST_MOVED_M), (both.turned_rad, LEAST_TURNED_RAD))
    ]
    return float(np.sqrt(sum(squared)))


def _by_another_clock(evidence: Evidence) -> Symptom | None:
    """Report an offset of the truth's clock, unless the clock has another rate (`truth_clock`)."""
    clock = evidence.truth_clock
    if clock is None or clock.offset is None or clock.runs_otherwise:
        return None
    found = clock.offset
    if abs(found.value) < max(LEAST_OFFSET_S, OFFSET_SIGMAS * found.error):
        return None
    return _symptom(
        f"the camera turns as the truth does when the truth's stamps are shifted by {-1e3 * found.value:.0f} +- "
        f"{1e3 * found.error:.0f} ms",
        "stamp both by one clock: every position error includes the distance moved in that time",
    )


def _symptom(detail: str, treatment: str) -> Symptom:
    return Symptom.warning(count=1, detail=detail, treatment=treatment)


FAULT = Fault(
    "truth-mismatch",
    "a truth that moves differently from vision: of another motion or unit, or a wrong baseline or focal length",
    check,
    after=("disagreement",),
)
