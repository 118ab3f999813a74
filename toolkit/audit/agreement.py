"""Faults that show only where vision is compared with the measured motion, at once or from some time on."""

from collections.abc import Iterator
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.special import stdtrit

from toolkit.audit.alignment import ForceBesideCamera
from toolkit.audit.fault import Evidence, Symptom, Undecided, beside_camera
from toolkit.audit.intervals import FORCE, LEAST_INTERVALS, RATE, SPEED, Intervals
from toolkit.audit.one_step import errors_are_independent
from toolkit.audit.robust import LEVEL, MEDIAN_TO_MEAN_ERROR, Scalar, median_error, regression
from toolkit.geometry import Array, BoolArray, IntArray
from toolkit.jackknife import STRETCHES
from toolkit.measurements import NS_PER_S
from toolkit.models.camera_motion import CameraMotion
from toolkit.models.gating import MAD_TO_SIGMA
from toolkit.sequence import Sequence

# A ratio must be this many standard errors beyond its limit; the noise of the camera's rotation lowers that of rates.
RATIO_SIGMAS = 5.0


@beside_camera
def disagreement(evidence: Evidence, intervals: Intervals) -> Symptom | Undecided | None:
    found = evidence.agreement
    findings = list(_ratios(evidence.sequence, intervals))
    if not (found.residual_px > found.limit_px or found.own_px > found.limit_px or findings):
        return None
    residuals = f"the tracks' residuals from frame to frame are {found.residual_px:.2f} px against the measured motion"
    explained = f"(median; noise explains {found.limit_px:.2f} px at most)"
    findings.append(f"{residuals} {explained} and {found.own_px:.2f} px against the camera motion that fits them best")
    treatment = "T_imu_cam, the intrinsics, the baseline or the samples (their unit or axes) are wrong: check them"
    if found.own_px > found.limit_px:
        treatment = "the intrinsics or the tracks themselves are wrong: check K and the pixels"
    return Symptom(count=1, detail="; ".join(findings), treatment=treatment, remedy=None)


def _ratios(sequence: Sequence, intervals: Intervals) -> Iterator[str]:
    for quantity in (SPEED, RATE, FORCE):
        ratio = quantity.ratio_of(sequence, intervals)
        margin = np.inf if ratio is None else RATIO_SIGMAS * ratio.error
        if ratio is None or quantity.least - margin <= ratio.value <= quantity.most + margin:
            continue
        yield quantity.summary.format(*ratio)


# A mean is reported from this many of its standard deviations on; the largest mean of a sound recording has 3 to 9.
CONFLICT_SIGMAS = 10.0
# Smallest deviation that is reported (rad/s, m/s, m/s^2); of a velocity, a share of the speed is added. The sound
# recordings at hand have up to 0.05 rad/s, a tenth of the speed where wheels slip or depths are wrong, and 0.4 m/s^2.
LEAST_DEVIATION = {"rate of rotation": 0.06, "velocity": 0.2, "specific force": 0.5}
LEAST_OF_SPEED = 0.1
# Length (s) of the averaged stretches: longer than a correction of the steering, shorter than a stop.
STRETCH_S = 2.0
# Least number of intervals for a mean.
LEAST_IN_STRETCH = 8
# From this many stretch lengths on, the scatter of the means is estimated from the recording itself.
LEAST_STRETCHES = 10
# The specific force is compared with the gravity estimated within this time (s), before the gyro's drift rotates it.
GRAVITY_S = 10.0
# A velocity is the median of this many neighbours, with a standard deviation that is smaller by this factor.
_MEDIAN_OF, _MEDIAN_ERROR = 5, 0.536
# The quartile of the absolute value of a normal variable, over its standard deviation.
_LOWER_QUARTILE = 0.3186


class Deviation(NamedTuple):
    """Samples less camera: ``value`` (n, 3) in ``unit``, at times ``t_s`` (n,) after the first frame.

    ``what`` names the quantity. ``noise`` (3,) is the standard deviation of the mean of n intervals times the root of
    n. Where ``telescopes`` it is times n: the mean of changes of velocity depends only on the velocities at both ends.
    """

    what: str
    unit: str
    t_s: Array
    value: Array
    noise: Array
    telescopes: bool


class Span(NamedTuple):
    """A time (s from the first frame) during which a deviation lasts, and the largest size of its means there."""

    begin_s: float
    end_s: float
    size: float


@beside_camera
def conflict(evidence: Evidence, intervals: Intervals) -> Symptom | Undecided | None:
    """Report the times at which vision and samples differ for seconds: traffic in the view, slip, a shaken IMU.

    Means of the deviation over stretches of time are compared with the scatter of such means in the rest.
    """
    sequence, found = evidence.sequence, list[tuple[Deviation, Span]]()
    speed_mps = float(np.median(np.linalg.norm(intervals.v_cam_mps, axis=1)))
    for deviation in _deviations(evidence, intervals):
        least = LEAST_DEVIATION[deviation.what] + LEAST_OF_SPEED * speed_mps * (deviation.what == "velocity")
        found += [(deviation, span) for span in sustained(deviation, CONFLICT_SIGMAS, least)]
    if not found:
        return None
    samples = "the IMU" if sequence.motion_kind == "imu" else "odometry"
    where = ", ".join(
        f"{span.begin_s:.0f}-{span.end_s:.0f} s (by {span.size:.2g} {deviation.unit} of {deviation.what})"
        for deviation, span in sorted(found, key=lambda one: one[1].begin_s)
    )
    spans_ns = np.rint(np.array([span[:2] for _, span in found]) * NS_PER_S).astype(int) + sequence.frames_t_ns[0]
    return Symptom.warning(
        f"vision and {samples} disagree at {where}",
        "moving objects or wrong samples: do not rely on any estimate from there on",
        len(found),
        tuple((int(begin), int(end)) for begin, end in spans_ns),
    )


def _deviations(evidence: Evidence, intervals: Intervals) -> tuple[Deviation, ...]:
    sequence = evidence.sequence
    frame_s = (sequence.frames_t_ns - sequence.frames_t_ns[0]) / NS_PER_S
    t_s = 0.5 * (frame_s[intervals.interval] + frame_s[intervals.interval + 1])
    w_radps = intervals.w_radps - intervals.bias_radps

    def of_medians(what: str, unit: str, value: Array) -> Deviation:
        # Changes between intervals, which lasting deviations do not raise, show the scatter.
        scatter = MAD_TO_SIGMA * np.median(np.abs(np.diff(value, axis=0)), axis=0) / np.sqrt(2.0)
        return Deviation(what, unit, t_s, value, MEDIAN_TO_MEAN_ERROR * scatter, telescopes=False)

    rotation = of_medians("rate of rotation", "rad/s", w_radps - intervals.w_seen_radps)
    if intervals.v_mps is None:
        return rotation, _specific_force(sequence, evidence.camera_motion, evidence.force_beside_camera)
    v_mps = intervals.v_mps + np.cross(w_radps, intervals.T_imu_cam[:3, 3]) - intervals.v_seen_mps
    return rotation, of_medians("velocity", "m/s", v_mps)


def sustained(deviation: Deviation, sigmas: float, least: float) -> list[Span]:
    """Return the spans in which means over stretches exceed ``sigmas`` of their standard deviations, and ``least``.

    The standard deviation is that of white noise; in a long recording it is no less than the scatter of the less
    scattered half of the means in either half of the recording, the smaller of both.
    """
    if deviation.t_s.size < LEAST_IN_STRETCH:
        return []
    centre_s, mean, noise = _stretches(deviation)
    if not centre_s.size:
        return []
    if np.ptp(centre_s) > LEAST_STRETCHES * STRETCH_S:
        # A fault that begins in the middle and lasts to the end must not raise the usual scatter.
        first, second = (_scatter_of_means(half) for half in np.array_split(mean, 2))
        noise = np.maximum(noise, np.minimum(first, second))
    size, spans = np.linalg.norm(mean, axis=1), list[Span]()
    for row in np.flatnonzero((np.linalg.norm(mean / noise, axis=1) > sigmas) & (size > least)).tolist():
        # A stretch stands for its middle half; those that overlap are joined.
        span = Span(float(centre_s[row]) - 0.25 * STRETCH_S, float(centre_s[row]) + 0.25 * STRETCH_S, float(size[row]))
        if spans and span.begin_s <= spans[-1].end_s:
            span = Span(spans[-1].begin_s, span.end_s, max(spans.pop().size, span.size))
        spans.append(span)
    return spans


def _scatter_of_means(mean: Array) -> Array:
    """Return the standard deviation (3,) of means (m, 3), from the half of them nearest to their median."""
    off_centre = np.abs(mean - np.median(mean, axis=0))
    return np.asarray(np.quantile(off_centre, 0.25, axis=0) / _LOWER_QUARTILE)


def _stretches(deviation: Deviation) -> tuple[Array, Array, Array]:
    """Return centres (m,) s, means (m, 3) and noise (m, 3) of the whole stretches that begin with an interval."""
    t_s, value = deviation.t_s, deviation.value
    begin = np.flatnonzero(t_s + STRETCH_S <= t_s[-1:] + 1e-9)
    end = np.searchsorted(t_s, t_s[begin] + STRETCH_S)
    enough = end - begin >= LEAST_IN_STRETCH
    if deviation.telescopes:  # its mean needs an uninterrupted stretch
        step_s = np.diff(t_s, append=t_s[-1:])
        gaps = np.concatenate([[0], np.cumsum(step_s > 1.5 * np.median(step_s))])
        enough &= gaps[np.maximum(end - 1, 0)] == gaps[begin]
    begin, end = begin[enough], end[enough]
    count = (end - begin)[:, None]
    of_stretches = (value[i:j] for i, j in zip(begin, end, strict=True))
    average = partial(np.mean if deviation.telescopes else np.median, axis=0)
    mean = np.array([average(of_one) for of_one in of_stretches]).reshape(-1, 3)
    noise = deviation.noise / (count if deviation.telescopes else np.sqrt(count))
    return 0.5 * (t_s[begin] + t_s[end - 1]), mean, noise


def _specific_force(sequence: Sequence, camera: CameraMotion, found: ForceBesideCamera) -> Deviation:
    """Return the change of the camera's velocity less the specific force, less the gravity estimated around that time.

    In the axes of the first frame that is constant but for the drift of the gyro. Integrals of both are subtracted from
    the velocities before the median of five neighbours is taken: that of velocities that vibrate differs from the mean.
    """
    middle_s = (found.middle_ns - sequence.frames_t_ns[0]) / NS_PER_S
    h_s = np.diff(middle_s)[:, None]
    gravity_mps2 = np.median(np.diff(found.gravity_mps, axis=0) / h_s, axis=0)
    fallen = found.gravity_mps - gravity_mps2 * (middle_s - middle_s[0])[:, None]
    smooth = np.asarray(np.median(_neighbours(fallen, _MEDIAN_OF // 2), axis=-1))
    sound = _neighbours(camera.known.astype(float), _MEDIAN_OF // 2).min(axis=-1) > 0.0
    rows = np.flatnonzero(sound[1:] & sound[:-1])
    t_s = middle_s[rows]
    value = (np.diff(smooth, axis=0) / h_s)[rows]
    bend = np.abs(np.diff(fallen, n=2, axis=0))[rows[rows < len(fallen) - 2]]
    # Without three known intervals in a row, the scatter of the velocities is unknown.
    bent_mps = np.median(bend, axis=0) if len(bend) else np.full(3, np.inf)
    sigma_mps = _MEDIAN_ERROR * MAD_TO_SIGMA * bent_mps / np.sqrt(6.0)
    noise = np.sqrt(2.0) * sigma_mps / np.median(h_s)
    return Deviation("specific force", "m/s^2", t_s, value - _around(t_s, value), noise, telescopes=True)


def _neighbours(values: Array, reach: int) -> Array:
    """Return each value (n, ...) with ``reach`` on either side (n, ..., 2 reach + 1); the ends repeat."""
    padded = np.pad(values, [(reach, reach)] + [(0, 0)] * (values.ndim - 1), mode="edge")
    return np.asarray(sliding_window_view(padded, 2 * reach + 1, axis=0))


def _around(t_s: Array, value: Array) -> Array:
    """Return the median (n, 3) of the means over stretches of values (n, 3) within GRAVITY_S, updated once a second."""
    if len(t_s) < LEAST_IN_STRETCH:
        return np.zeros_like(value)
    knots_s: Array = np.unique(np.floor(t_s))
    first: IntArray = np.searchsorted(t_s, knots_s - GRAVITY_S)
    last: IntArray = np.searchsorted(t_s, knots_s + 1.0 + GRAVITY_S)
    even = _neighbours(value, round(0.5 * STRETCH_S / float(np.median(np.diff(t_s))))).mean(axis=-1)
    medians = np.array([np.median(even[i:j], axis=0) for i, j in zip(first, last, strict=True)]).reshape(-1, 3)
    return medians[np.searchsorted(knots_s, np.floor(t_s))]


# Least share of a step, beside its significance over all places where it can be (sound drives have 0.057).
SYSTEMATIC = 0.06
# Where only a step larger than this would be found, the finding is undecided and says so.
LARGEST_HIDDEN_STEP = 0.08
# Below this speed the camera is taken to stand, and its speed is noise.
STANDING_MPS = 0.05
# Either side of a step has at least this many stretches.
LEAST_STRETCHES_ASIDE = 2


@beside_camera
def scale_change(evidence: Evidence, intervals: Intervals) -> Symptom | Undecided | None:
    if intervals.v_mps is None:
        return None  # an IMU has no speed to compare
    measured, seen = intervals.v_measured_mps, intervals.v_seen_mps
    speed_mps = np.linalg.norm(seen, axis=1)
    fast = (speed_mps > STANDING_MPS) & (speed_mps >= 0.5 * np.median(speed_mps))
    if fast.sum() < LEAST_INTERVALS:
        return Undecided(f"too little motion: {int(fast.sum())} intervals show a scale, {LEAST_INTERVALS} are needed")
    ratio = np.sum(measured * seen, axis=1)[fast] / speed_mps[fast] ** 2
    after, step = _largest_step(ratio)
    level = LEVEL / (STRETCHES + 1 - 2 * LEAST_STRETCHES_ASIDE)
    sigmas = float(stdtrit(STRETCHES - 2, 1.0 - 0.5 * level))
    least = max(SYSTEMATIC, sigmas * step.error)
    hidden = least + abs(step.value)
    if abs(step.value) < least:
        wanders = f"by {100.0 * step.value:+.1f} +- {100.0 * step.error:.1f} %, as in drives without faults"
        unseen = f"the odometry's scale changes {wanders}: a step by less than {100.0 * hidden:.0f} % would not show"
        return Undecided(unseen) if hidden >= LARGEST_HIDDEN_STEP else None
    frame = intervals.interval[fast][np.argmax(np.arange(len(ratio)) * STRETCHES // len(ratio) == after)]
    at_s = (evidence.sequence.frames_t_ns[frame] - evidence.sequence.frames_t_ns[0]) / NS_PER_S
    size = f"{100.0 * abs(step.value):.1f} +- {100.0 * step.error:.1f} %"
    return Symptom.warning(
        f"from about {at_s:.0f} s on the odometry's speed relative to the camera's is {size} "
        f"{'higher' if step.value > 0.0 else 'lower'} than before",
        "wheels, their scale or depths have changed: no constant scale corrects the recording",
    )


def _largest_step(ratio: Array) -> tuple[int, Scalar]:
    """Return the first stretch after the most significant step of ratios (n,) in time, and the size of the step."""
    stretch = np.arange(len(ratio)) * STRETCHES // len(ratio)
    level = np.array([np.median(ratio[stretch == k]) for k in range(STRETCHES)])
    own = np.array([median_error(ratio[stretch == k][:, None])[0] for k in range(STRETCHES)])
    steps = dict[int, Scalar]()
    for k in range(LEAST_STRETCHES_ASIDE, STRETCHES + 1 - LEAST_STRETCHES_ASIDE):
        parts = (level[:k], level[k:])
        scatter = sum(float(np.sum((part - part.mean()) ** 2)) for part in parts) / (STRETCHES - 2)
        variance = max(scatter, float(np.mean(own**2))) * (1.0 / k + 1.0 / (STRETCHES - k))
        steps[k] = Scalar(float(parts[1].mean() - parts[0].mean()), float(np.sqrt(variance)))
    best = max(steps, key=lambda k: abs(steps[k].value) / max(steps[k].error, 1e-12))
    return best, steps[best]


# The parts before and after these shares of the recording are compared. A change must be beyond this many standard
# errors and a share of gravity (sound recordings have 0.3 % at most), a larger one if tracks drift (0.8 %).
CUTS, GRAVITY_SIGMAS, GRAVITY_SYSTEMATIC, BY_TRACK_DRIFT = (1.0 / 3.0, 0.5, 2.0 / 3.0), 5.0, 0.005, 0.012
# Length (s) of the windows in which gravity is read, while the gyro hardly drifts, and their least number of intervals.
GRAVITY_WINDOW_S, FEWEST_IN_GRAVITY_WINDOW = 2.0, 12
# Where only a change larger than this share of gravity would be found, the finding is undecided and says so.
LARGEST_HIDDEN_GRAVITY = 0.05


def accelerometer_change(evidence: Evidence) -> Symptom | Undecided | None:
    """Report an accelerometer that reads another gravity from some time on: another range, or a knock.

    It is the size of the slope of the camera's velocity less the integrated force; the gyro's drift only turns that.
    """
    sequence = evidence.sequence
    if sequence.motion_kind != "imu":
        return None
    if evidence.intervals is None:
        return evidence.blind
    middle_ns, v_mps = evidence.force_beside_camera.middle_ns, evidence.force_beside_camera.gravity_mps
    t_s, known = (middle_ns - sequence.frames_t_ns[0]) / NS_PER_S, evidence.camera_motion.known
    gravity, found = float(np.linalg.norm(sequence.gravity_world)), dict[float, Scalar]()
    for share in CUTS:
        sides = t_s < share * sequence.duration_s, t_s >= share * sequence.duration_s
        before, after = (_gravity(t_s, v_mps, known & side) for side in sides)
        if before is not None and after is not None:
            found[share] = Scalar(after.value - before.value, float(np.hypot(before.error, after.error)))
    if not found:
        return Undecided("too few intervals whose camera motion is known, to estimate gravity before and after")
    share, step = max(found.items(), key=lambda one: abs(one[1].value) / one[1].error)
    least = GRAVITY_SYSTEMATIC * gravity + GRAVITY_SIGMAS * step.error
    if abs(step.value) > least and not errors_are_independent(evidence.step_correlation):
        least = BY_TRACK_DRIFT * gravity + GRAVITY_SIGMAS * step.error
    if abs(step.value) < least:
        hidden = least / gravity
        unseen = Undecided(f"a change by less than {hidden:.0%} of the gravity that it reads would not show")
        return None if hidden < LARGEST_HIDDEN_GRAVITY else unseen
    return Symptom.warning(
        f"from about {share * sequence.duration_s:.0f} s on the accelerometer reads a gravity that is "
        f"{abs(step.value):.2f} +- {step.error:.2f} m/s^2 {'more' if step.value > 0.0 else 'less'} than before",
        "its range or its scale have changed, or it was knocked: no constant bias describes the recording",
    )


def _gravity(t_s: Array, fallen: Array, rows: BoolArray) -> Scalar | None:
    """Return the weighted mean of the gravity (m/s^2) read in the windows of some rows (n,), and its standard error."""
    at = np.flatnonzero(rows)
    if at.size < FEWEST_IN_GRAVITY_WINDOW:
        return None
    windows = max(round(float(np.ptp(t_s[at])) / GRAVITY_WINDOW_S), 1)
    parts = [part for part in np.array_split(at, windows) if part.size >= FEWEST_IN_GRAVITY_WINDOW]
    if not parts:
        return None
    read = np.array([_read(t_s[part], fallen[part]) for part in parts])
    weight = read[:, 1] ** -2.0
    mean = float(weight @ read[:, 0] / weight.sum())
    error = float(weight.sum() ** -0.5)
    if len(parts) > 1:  # bias and tilt make them scatter more than their own errors
        chi2 = float(weight @ (read[:, 0] - mean) ** 2) / (len(parts) - 1)
        error *= max(np.sqrt(chi2), 1.0)
    return Scalar(mean, error)


def _read(t_s: Array, fallen: Array) -> tuple[float, float]:
    """Return the size of the slope (m/s^2) of velocities (n, 3) at times (n,), and its error."""
    line = np.stack([np.ones(t_s.size), t_s - t_s.mean()], axis=1)
    found, cov = regression(fallen, np.kron(line, np.eye(3)).reshape(-1, 3, 6))
    slope, size = found[3:], float(np.linalg.norm(found[3:]))
    return size, float(np.sqrt(slope @ cov[3:, 3:] @ slope)) / max(size, 1e-9)


# An interval is a candidate beyond this many standard deviations of all and beyond this angle (rad). Single intervals
# of sound recordings have up to 9 and 0.007 with an IMU, and up to 21 and 0.021 on drives, without a lasting rotation.
JUMP_SIGMAS, LEAST_JUMP_RAD = 12.0, 0.008
# The intervals before and after it must be less than this share of it.
ALONE = 0.5
# The lasting rotation, over this many intervals before and after, as a share of the jump and in standard errors. Real
# drives with a planted jump have shares of 1.26 to 1.43, three slips of the tracks in 03 0.0, 0.4 and 2.1.
AROUND, STAYS_SIGMAS, SHARE = 60, 4.0, (0.5, 1.75)
LEAST_AROUND = 10


@beside_camera
def image_jump(evidence: Evidence, intervals: Intervals) -> Symptom | Undecided | None:
    """Report the times at which the image is displaced for good: a knock of the camera, another crop.

    The camera seems to rotate in one interval, unlike the gyro. A slip of the tracks does not last: with odometry the
    camera's velocity must be rotated by that angle from then on.
    """
    sequence = evidence.sequence
    frame_s = (sequence.frames_t_ns - sequence.frames_t_ns[0]) / NS_PER_S
    excess_radps = intervals.w_seen_radps - intervals.w_radps + intervals.bias_radps
    turn_rad = excess_radps * np.diff(frame_s)[intervals.interval][:, None]
    sigma_rad = np.maximum(MAD_TO_SIGMA * np.median(np.abs(turn_rad), axis=0), 1e-9)
    size, angle_rad = np.linalg.norm(turn_rad / sigma_rad, axis=1), np.linalg.norm(turn_rad, axis=1)
    beside = np.maximum(np.append(size[1:], 0.0), np.insert(size[:-1], 0, 0.0))
    jumps = np.flatnonzero((size > JUMP_SIGMAS) & (angle_rad > LEAST_JUMP_RAD) & (beside < ALONE * size))
    if not jumps.size:
        return None
    stay = [k for k in jumps.tolist() if _stays(intervals, k, turn_rad[k])]
    places = [f"{frame_s[intervals.interval[k]]:.1f} s (by {angle_rad[k]:.3f} rad)" for k in stay or jumps.tolist()]
    if not stay:
        return Undecided(
            f"the camera jumps at {', '.join(places)}, and its velocity does not show whether the change is permanent"
        )
    treatment = "the camera was knocked or the image was cropped anew: cut the recording there"
    return Symptom.warning(f"the image jumps, and not the vehicle, at {', '.join(places)}", treatment, len(stay))


def _stays(intervals: Intervals, k: int, turn_rad: Array) -> bool:
    """Say whether the camera's velocity is rotated by that angle after interval ``k``; True with an IMU."""
    if intervals.v_mps is None:
        return True
    deviation = intervals.v_measured_mps - intervals.v_seen_mps
    expected = np.cross(turn_rad, intervals.v_seen_mps)  # if the camera is rotated by it against its extrinsic
    size = np.sum(expected**2, axis=1)
    before, after = slice(max(k - AROUND, 0), k), slice(k + 1, k + 1 + AROUND)
    shares = np.sum(deviation * expected, axis=1) / np.maximum(size, 1e-12)
    one, other = shares[before, None], shares[after, None]
    if min(len(one), len(other)) < LEAST_AROUND:
        return False
    error = float(np.hypot(median_error(one)[0], median_error(other)[0]))
    return max(SHARE[0], STAYS_SIGMAS * error) < float(np.median(other) - np.median(one)) < SHARE[1]
