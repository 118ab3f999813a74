"""Seconds during which vision and the measured motion disagree: many moving objects, or samples that are wrong.

Most of the points in view may belong to traffic, wheels may slip, or an IMU may be shaken. As long as that lasts,
vision and the samples give different motions, and the data do not show which one is right. Nothing is repaired.

The deviation of the samples from the camera's own motion is averaged over stretches of time and compared with the
scatter of such means in the rest of the recording, which includes noise, slip and other usual errors.
"""

from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from toolkit.audit.fault import Evidence, Fault, Symptom, Undecided
from toolkit.audit.parts.integrated_gravity import IntegratedGravity
from toolkit.audit.parts.intervals import Intervals
from toolkit.audit.parts.robust import MEDIAN_TO_MEAN_ERROR, median
from toolkit.geometry import Array, BoolArray, IntArray
from toolkit.models.camera_motion import CameraMotion
from toolkit.models.gating import MAD_TO_SIGMA
from toolkit.resampling import NS_PER_S
from toolkit.sequence import Sequence

# A mean is reported from so many of its standard deviations on; the largest mean of a sound recording has 3 to 9.
SIGMAS = 10.0
# Smallest deviation that is reported (rad/s, m/s, m/s^2); of a velocity, a share of the speed is added. The sound
# recordings at hand have up to 0.05 rad/s, a tenth of the speed where wheels slip or depths are wrong, and 0.4 m/s^2.
LEAST = {"rate of rotation": 0.06, "velocity": 0.2, "specific force": 0.5}
LEAST_OF_SPEED = 0.1
# Length (s) of the stretches that are averaged: longer than a correction of the steering, shorter than a stop at a
# traffic light.
STRETCH_S = 2.0
# Least number of intervals for a mean.
LEAST_IN_STRETCH = 8
# From this many stretch lengths on, the scatter of the means is estimated from the recording itself.
LEAST_STRETCHES = 10
# The specific force is compared with the gravity estimated within this time (s), before the gyro's drift rotates it.
GRAVITY_S = 10.0
# A velocity is the median of so many neighbours; its standard deviation is that of a single one times this factor, for
# normal errors.
_MEDIAN_OF, _MEDIAN_ERROR = 5, 0.536
# The quartile of the absolute value of a normal variable, over its standard deviation.
_LOWER_QUARTILE = 0.3186


class Deviation(NamedTuple):
    """Samples less camera: ``value`` (n, 3) in ``unit``, at times ``t_s`` (n,) after the first frame.

    ``what`` names the quantity.

    ``noise`` (3,) is the standard deviation of the mean of n intervals times the root of n. Where ``telescopes`` it is
    times n: the mean of changes of velocity depends only on the velocities at both ends.
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


def check(evidence: Evidence) -> Symptom | Undecided | None:
    """Report the times at which samples and camera differ for seconds, and by how much."""
    if evidence.intervals is None:
        return evidence.blind
    sequence, found = evidence.sequence, list[tuple[Deviation, Span]]()
    speed_mps = float(np.median(np.linalg.norm(evidence.intervals.v_cam_mps, axis=1)))
    for deviation in _deviations(evidence, evidence.intervals):
        least = LEAST[deviation.what] + LEAST_OF_SPEED * speed_mps * (deviation.what == "velocity")
        found += [(deviation, span) for span in sustained(deviation, SIGMAS, least)]
    if not found:
        return None
    samples = "the IMU" if sequence.motion_kind == "imu" else "odometry"
    return Symptom.warning(
        count=len(found),
        detail=f"vision and {samples} disagree at {', '.join(_detail(*one) for one in sorted(found, key=_begin))}",
        treatment="moving objects or wrong samples: do not rely on any estimate from there on",
        spans_ns=tuple(_in_ns(span, int(sequence.frames_t_ns[0])) for _, span in found),
    )


def _begin(one: tuple[Deviation, Span]) -> float:
    return one[1].begin_s


def _in_ns(span: Span, first_ns: int) -> tuple[int, int]:
    return first_ns + round(span.begin_s * NS_PER_S), first_ns + round(span.end_s * NS_PER_S)


def _detail(deviation: Deviation, span: Span) -> str:
    return f"{span.begin_s:.0f}-{span.end_s:.0f} s (by {span.size:.2g} {deviation.unit} of {deviation.what})"


def _deviations(evidence: Evidence, intervals: Intervals) -> tuple[Deviation, ...]:
    """Return the deviations of the rotation, and of the velocity of twists or the specific force of an IMU.

    The gyro's constant bias is subtracted first.
    """
    sequence, T_imu_cam = evidence.sequence, evidence.sequence.rig.T_imu_cam
    frame_s = (sequence.frames_t_ns - sequence.frames_t_ns[0]) / NS_PER_S
    t_s = 0.5 * (frame_s[intervals.interval] + frame_s[intervals.interval + 1])
    w_radps = intervals.w_radps - intervals.w_cam_radps @ T_imu_cam[:3, :3].T
    bias_radps = np.median(w_radps, axis=0)
    rotation = _of_medians("rate of rotation", "rad/s", t_s, w_radps - bias_radps)
    if intervals.v_mps is None:
        return rotation, _specific_force(sequence, evidence.camera_motion, evidence.integrated_gravity)
    lever_mps = np.cross(intervals.w_radps - bias_radps, T_imu_cam[:3, 3])
    v_mps = intervals.v_mps + lever_mps - intervals.v_cam_mps @ T_imu_cam[:3, :3].T
    return rotation, _of_medians("velocity", "m/s", t_s, v_mps)


def sustained(deviation: Deviation, sigmas: float, least: float) -> list[Span]:
    """Return the spans in which the means over stretches exceed ``sigmas`` of their standard deviations.

    The standard deviation of a mean is that of white noise. In a long recording it is no less than the scatter of the
    means, taken from the less scattered half of them in each half of the recording, the smaller of both. ``least`` is
    the smallest deviation that is reported, in its unit.
    """
    if deviation.t_s.size < LEAST_IN_STRETCH:
        return []
    stretches = _stretches(deviation)
    if not stretches.centre_s.size:
        return []
    noise = stretches.noise
    if np.ptp(stretches.centre_s) > LEAST_STRETCHES * STRETCH_S:
        # A fault that begins in the middle and lasts to the end must not raise the usual scatter.
        first, second = (_scatter_of_means(half) for half in np.array_split(stretches.mean, 2))
        noise = np.maximum(noise, np.minimum(first, second))
    improbable = np.linalg.norm(stretches.mean / noise, axis=1) > sigmas
    return _spans(stretches, np.asarray(improbable & (np.linalg.norm(stretches.mean, axis=1) > least)))


def _scatter_of_means(mean: Array) -> Array:
    """Return the standard deviation (3,) of means (m, 3), from the half of them nearest to their median."""
    off_centre = np.abs(mean - np.median(mean, axis=0))
    return np.asarray(np.quantile(off_centre, 0.25, axis=0) / _LOWER_QUARTILE)


class _Stretches(NamedTuple):
    """Centres (m,) s of the stretches, the means (m, 3) of a deviation in them and the noise (m, 3) of those."""

    centre_s: Array
    mean: Array
    noise: Array


def _stretches(deviation: Deviation) -> _Stretches:
    """Average a deviation over every stretch that begins with one of its intervals and is whole."""
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
    average = partial(np.mean, axis=0) if deviation.telescopes else median
    mean = np.array([average(of_one) for of_one in of_stretches]).reshape(-1, 3)
    noise = deviation.noise / (count if deviation.telescopes else np.sqrt(count))
    return _Stretches(0.5 * (t_s[begin] + t_s[end - 1]), mean, noise)


def _spans(stretches: _Stretches, deviates: BoolArray) -> list[Span]:
    """Join stretches that deviate and overlap; each stands for its middle half, from a quarter to three quarters."""
    spans: list[Span] = []
    size = np.linalg.norm(stretches.mean, axis=1)
    for row in np.flatnonzero(deviates).tolist():
        centre_s, here = float(stretches.centre_s[row]), float(size[row])
        span = Span(centre_s - 0.25 * STRETCH_S, centre_s + 0.25 * STRETCH_S, here)
        if spans and span.begin_s <= spans[-1].end_s:
            span = Span(spans[-1].begin_s, span.end_s, max(spans.pop().size, here))
        spans.append(span)
    return spans


def _of_medians(what: str, unit: str, t_s: Array, value: Array) -> Deviation:
    return Deviation(what, unit, t_s, value, MEDIAN_TO_MEAN_ERROR * _scatter(value), telescopes=False)


def _scatter(value: Array) -> Array:
    """Return the standard deviation (3,) from changes between intervals, which lasting deviations do not raise."""
    change = np.abs(np.diff(value, axis=0))
    return np.asarray(MAD_TO_SIGMA * np.median(change, axis=0) / np.sqrt(2.0))


def _specific_force(sequence: Sequence, camera: CameraMotion, found: IntegratedGravity) -> Deviation:
    """Return the change of the camera's velocity less the specific force, less the gravity estimated around that time.

    In the axes of the first frame, by the gyro, the velocity changes by the specific force plus gravity, which is
    constant but for the drift of the gyro. The integrals of both are subtracted from the velocities before the median
    of five neighbours is taken: the median of velocities that vibrate or fall differs from their mean.
    """
    frames_t_ns = sequence.frames_t_ns
    middle_ns = found.middle_ns
    h_s = np.diff(middle_ns)[:, None] / NS_PER_S
    fallen = (
        found.velocity_mps
        - np.median(np.diff(found.velocity_mps, axis=0) / h_s, axis=0) * (middle_ns - middle_ns[0])[:, None] / NS_PER_S
    )
    smooth = np.asarray(np.median(_neighbours(fallen, _MEDIAN_OF // 2), axis=-1))
    sound = _neighbours(camera.known.astype(float), _MEDIAN_OF // 2).min(axis=-1) > 0.0
    rows = np.flatnonzero(sound[1:] & sound[:-1])
    t_s = (middle_ns[:-1][rows] - frames_t_ns[0]) / NS_PER_S
    value = (np.diff(smooth, axis=0) / h_s)[rows]
    bend = np.abs(np.diff(fallen, n=2, axis=0))[rows[rows < len(fallen) - 2]]
    # Without three known intervals in a row, the scatter of the velocities is unknown.
    bent_mps = np.median(bend, axis=0) if len(bend) else np.full(3, np.inf)
    sigma_mps = _MEDIAN_ERROR * MAD_TO_SIGMA * bent_mps / np.sqrt(6.0)
    noise = np.sqrt(2.0) * sigma_mps / np.median(h_s)
    return Deviation("specific force", "m/s^2", t_s, value - _around(t_s, value), noise, telescopes=True)


def _neighbours(values: Array, reach: int) -> Array:
    """Return each value (n, ...) with so many on either side (n, ..., 2 reach + 1); the ends repeat."""
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
    medians = np.array([median(even[i:j]) for i, j in zip(first, last, strict=True)]).reshape(-1, 3)
    return medians[np.searchsorted(knots_s, np.floor(t_s))]


FAULT = Fault(
    "conflict",
    "vision and the measured motion disagree for seconds: moving objects or wrong samples",
    check,
    after=("accelerometer-axes", "disagreement", "gyro-bias"),
)
