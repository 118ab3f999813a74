"""Self-calibration: an adjustment of windows of key frames to tracks and measured motion, with unknown calibration.

From frame to frame, the noise of the tracks hides small errors of a focal length, a clock or a rotation. Points
followed over a second, together with the integrated IMU or odometry, show them. `bundle` has the equations.
"""

from typing import NamedTuple

import numpy as np
from scipy.special import chdtri

from toolkit.audit.alignment import Position
from toolkit.audit.bundle import (
    COMMON,
    GYRO_BIAS,
    LEVER,
    RIGHT_SHIFT,
    Calibration,
    ImuStrides,
    KeyFrameWindow,
    Reduced,
    TwistStrides,
    imu_strides,
    moved,
    reduce,
    twist_strides,
)
from toolkit.audit.intervals import Intervals, chained, interval_means, moved_as_measured, moved_by, usual_step_s
from toolkit.audit.robust import LEVEL
from toolkit.errors import DataError
from toolkit.geometry import Array, BoolArray, IntArray, se3_inverse, transform
from toolkit.measurements import MotionKind, is_left_only
from toolkit.models.camera_motion import CameraMotion
from toolkit.models.stereo import disparity_px, triangulate
from toolkit.sequence import Sequence

# Time (s) between key frames, approximate length (s) of a window, and least number of key frames of one. There is one
# window or an even number, so that no window contains the middle of the recording, where the clock may change.
STRIDE_S, WINDOW_S, FEWEST_KEYS = 0.2, 4.0, 4
# Least number of key frames in which a track is seen, least disparity (px) of a sighting, least number of tracks of a
# window. The longest tracks are used.
FEWEST_SIGHTINGS, LEAST_DISPARITY_PX, FEWEST_TRACKS = 3, 2.0, 20


class Effort(NamedTuple):
    """The largest numbers of windows, of tracks in a window, and of iterations."""

    windows: int
    tracks: int
    iterations: int


# In long recordings, the windows are spread evenly with an IMU, whose clock may change. With odometry those with the
# most rotation are used, because cars drive straight ahead for long; more windows would not help, because errors of
# drifting tracks dominate.
MOST: dict[MotionKind, Effort] = {"imu": Effort(6, 200, 10), "twist": Effort(4, 100, 14)}
# Converged where the step is less than this share of the standard errors.
SETTLED = 0.4
# A step of more than this many prior standard deviations diverges.
STRAYED = 10.0
# Least share of the information on the camera's position that is taken to come from the data.
LEAST_BY_DATA = 1e-3
# The first unknowns are those of a rectified pair. The errors of the right image are fixed at zero, and estimated only
# where one step from the converged calibration has them beyond this many standard errors. Few recordings need them; in
# all others they would make focal length and baseline less certain.
_RECTIFIED, RIGHT = RIGHT_SHIFT, slice(RIGHT_SHIFT, COMMON)
RIGHT_SIGMAS: dict[MotionKind, float] = {"imu": 4.0, "twist": 6.0}
# Of the unknowns in the order of `bundle`, how many they are, and for an IMU and odometry the standard deviation of the
# prior and the largest result that is accepted. The position is accepted far beyond its prior: `lever_arm` reports it.
_UNKNOWNS = (
    (2, 0.2, 0.2, 0.2, 0.2),  # logarithms of the focal lengths
    (2, 70.0, 70.0, 70.0, 70.0),  # principal point, px
    (1, 0.2, 0.2, 0.2, 0.2),  # logarithm of the baseline
    (3, 0.3, 0.3, 0.3, 0.3),  # rotation of the camera, rad
    (3, 0.3, 2.0, 2.0, 10.0),  # its position, with odometry also that of the point whose velocities are given, m
    (1, 0.03, 0.03, 0.06, 0.06),  # its clock, s; a twist may describe the interval before or after its stamp
    (1, 0.1, 0.1, 0.1, 0.1),  # the change of that, s
    (3, 0.1, 0.1, 0.1, 0.1),  # bias of the gyro, rad/s
    (3, 0.3, 0.3, 0.02, 0.1),  # bias of the accelerometer, m/s^2; rotation of velocities by slip and pitch, rad
    (1, 5.0, 5.0, 5.0, 5.0),  # columns of the right image, px
    (1, 0.1, 0.1, 0.1, 0.1),  # roll of the right camera, rad
)
_COUNTS, *_SIZES = zip(*_UNKNOWNS, strict=True)
_OF_IMU, _NEAR_IMU, _OF_TWIST, _NEAR_TWIST = (np.repeat(size, _COUNTS) for size in _SIZES)
PRIOR: dict[MotionKind, Array] = {"imu": _OF_IMU, "twist": _OF_TWIST}
NEAR: dict[MotionKind, Array] = {"imu": _NEAR_IMU, "twist": _NEAR_TWIST}


class SelfCalibration(NamedTuple):
    """Corrections of the calibration, or values of the biases, (21,) in the order of `bundle`, and their covariance.

    ``windows`` is the number of windows; with one, a change of the clock is not determined. For a pair that looks
    rectified, the corrections of the right image are zero, with the covariance that they have if all are estimated.
    """

    value: Array
    cov: Array
    windows: int

    @property
    def error(self) -> Array:
        """The standard errors (21,)."""
        return np.sqrt(np.diag(self.cov))

    @property
    def position(self) -> Position:
        """The camera's position without its prior, by the share of the information that comes from the data."""
        by_data = np.maximum(1.0 - (self.error[LEVER] / PRIOR["imu"][LEVER]) ** 2, LEAST_BY_DATA)
        root = np.sqrt(by_data)
        return Position(self.value[LEVER] / by_data, self.cov[LEVER, LEVER] / root / root[:, None])


def self_calibration(
    sequence: Sequence, camera: CameraMotion, intervals: Intervals, fewest_windows: int = 1
) -> SelfCalibration | None:
    """Estimate the calibration from tracks and measured motion.

    None where no window has enough tracks, or the adjustment finds no calibration near the given one.
    """
    w_bias = intervals.bias_radps
    windows = _windows(sequence, camera, w_bias, fewest_windows)
    if not windows:
        return None
    kind = sequence.motion_kind
    try:
        given = Calibration(sequence.rig, 0.0, np.zeros(6))
        found, cov = _fitted(_At(windows, given, np.zeros(COMMON)), kind)
    except (np.linalg.LinAlgError, DataError):  # diverging steps: singular, or an impossible rig
        return None
    value = found.value
    if not found.settled or (np.abs(value) > NEAR[kind]).any():
        return None
    value[GYRO_BIAS] += w_bias
    return SelfCalibration(value, cov, len(windows))


class _At(NamedTuple):
    """Where an adjustment is linearised: the windows, the calibration, and its corrections so far (21,)."""

    windows: list[KeyFrameWindow]
    calibration: Calibration
    moved_by: Array


class _Adjusted(NamedTuple):
    """The end of an adjustment: whether it converged, the last linearisation, its step (21,) and its windows."""

    settled: bool
    at: _At
    step: Array
    all_reduced: list[Reduced]

    @property
    def value(self) -> Array:
        """The corrections of the calibration (21,)."""
        return self.at.moved_by + self.step


def _fitted(at: _At, kind: MotionKind) -> tuple[_Adjusted, Array]:
    """Return the adjustment and its covariance (21, 21).

    A rectified pair is assumed unless, after convergence, one step of all unknowns has a significant correction of the
    right image.
    """
    rectified, prior = _adjusted(at, kind, _RECTIFIED), PRIOR[kind]
    right = _step(rectified.all_reduced, rectified.at.moved_by, prior)[RIGHT]
    # Windows of a pair that is not rectified fit different calibrations, so their scatter is not included.
    by_parts, _ = _cov_of_parts(rectified.all_reduced, prior, COMMON)
    if rectified.settled and (np.abs(right) > RIGHT_SIGMAS[kind] * np.sqrt(np.diag(by_parts)[RIGHT])).any():
        found = _adjusted(rectified.at, kind, COMMON)
        return found, _cov(found.all_reduced, prior)
    cov = _cov(rectified.all_reduced, prior)
    cov[:_RECTIFIED], cov[:, :_RECTIFIED] = 0.0, 0.0
    cov[:_RECTIFIED, :_RECTIFIED] = _cov(rectified.all_reduced, prior, _RECTIFIED)
    return rectified, cov


def _adjusted(at: _At, kind: MotionKind, free: int) -> _Adjusted:
    """Adjust the first ``free`` unknowns by Gauss-Newton."""
    prior = PRIOR[kind]
    for _ in range(MOST[kind].iterations):
        all_reduced = [reduce(window, at.calibration) for window in at.windows]
        found = _Adjusted(False, at, _step(all_reduced, at.moved_by, prior, free), all_reduced)
        if not (np.abs(found.step) < STRAYED * prior).all():
            return found
        error = np.sqrt(np.diag(np.linalg.inv(_information(all_reduced, prior)[:free, :free])))
        if (np.abs(found.step[:free]) < SETTLED * error).all():
            return found._replace(settled=True)
        windows = [moved(window, reduced, found.step) for window, reduced in zip(at.windows, all_reduced, strict=True)]
        at = _At(windows, at.calibration.moved(found.step), found.value)
    return found


def _step(all_reduced: list[Reduced], value: Array, prior: Array, free: int = COMMON) -> Array:
    """Return the step (21,) of the calibration from all windows and the prior about zero.

    Only the first ``free`` unknowns are estimated.
    """
    gradient = sum(reduced.gradients.sum(axis=0) for reduced in all_reduced) - value / prior**2
    step = np.zeros(COMMON)
    step[:free] = np.linalg.solve(_information(all_reduced, prior)[:free, :free], gradient[:free])
    return step


def _information(all_reduced: list[Reduced], prior: Array) -> Array:
    return np.asarray(np.diag(prior**-2.0) + sum(reduced.information for reduced in all_reduced))


def _cov(all_reduced: list[Reduced], prior: Array, free: int = COMMON) -> Array:
    """Return the covariance of the first ``free`` unknowns, which also allows errors that are constant in a window.

    The scatter of the windows, of which there are two to six, is used only where it is beyond chance.
    """
    cov, inverse = _cov_of_parts(all_reduced, prior, free)
    by_window = np.array([reduced.gradients[:, :free].sum(axis=0) for reduced in all_reduced]) @ inverse
    dof = len(all_reduced) - 1
    if dof == 0:
        return cov
    scatter = np.sum((by_window - by_window.mean(axis=0)) ** 2, axis=0) * (dof + 1) / dof
    beyond = scatter > np.diag(cov) * chdtri(dof, LEVEL) / dof
    return np.asarray(cov + np.diag(np.where(beyond, np.maximum(scatter - np.diag(cov), 0.0), 0.0)))


def _cov_of_parts(all_reduced: list[Reduced], prior: Array, free: int) -> tuple[Array, Array]:
    """Return the covariance that allows errors constant along a track or for a second, and the usual one.

    It is no less than that of independent errors, because a few parts may scatter too little by chance. Source: Liang &
    Zeger, "Longitudinal data analysis using generalized linear models" (1986), the sandwich.
    """
    inverse = np.linalg.inv(_information(all_reduced, prior)[:free, :free])
    gradients = np.concatenate([reduced.gradients[:, :free] for reduced in all_reduced])
    cov = inverse @ (gradients.T @ gradients + np.diag(prior[:free] ** -2.0)) @ inverse
    return np.asarray(cov + np.diag(np.maximum(np.diag(inverse) - np.diag(cov), 0.0))), np.asarray(inverse)


def _windows(sequence: Sequence, camera: CameraMotion, w_bias: Array, fewest: int = 1) -> list[KeyFrameWindow]:
    """Return the windows in which the motion is known and there are enough tracks."""
    step_s = usual_step_s(sequence.frames_t_ns)
    stride = max(1, round(STRIDE_S / step_s))
    keys = np.arange(0, sequence.frame_count, stride)
    whole = round(sequence.duration_s / WINDOW_S)
    count = max(fewest, whole - whole % 2, 1)
    edges = np.linspace(0, keys.size - 1, count + 1).round().astype(int)
    spans = [keys[edges[k] : edges[k + 1] + 1] for k in range(count)]
    spans = [spans[k] for k in _chosen(sequence, spans)]
    T_before_after, known = _roughly_moved(sequence, camera)
    spans = [span for span in spans if span.size >= FEWEST_KEYS and known[span[0] : span[-1]].all()]
    found = [_window(sequence, span, T_before_after[span[0] : span[-1]], w_bias) for span in spans]
    return [window for window in found if window is not None]


def _chosen(sequence: Sequence, spans: list[IntArray]) -> list[int]:
    """Return the indices of the spans of frames that are used, in the order of time."""
    count, most = len(spans), MOST[sequence.motion_kind].windows
    if sequence.motion_kind == "imu" or count <= most:
        return [int(k) for k in np.unique(np.linspace(0, count - 1, min(count, most)).round())]
    mean = interval_means(sequence.motion.t_ns, sequence.motion.values[:, 3:], sequence.frames_t_ns)
    rates = mean - np.median(mean, axis=0)
    turned = [float(np.linalg.norm(rates[span[0] : span[-1]], axis=1).sum()) for span in spans]
    return sorted(int(k) for k in np.argsort(turned)[-most:])


def _roughly_moved(sequence: Sequence, camera: CameraMotion) -> tuple[Array, BoolArray]:
    """Return initial motions of the camera (K - 1, 4, 4), and whether they are known; odometry fills gaps."""
    T_before_after, known = moved_by(camera, sequence), camera.known
    if sequence.motion_kind != "twist":
        return T_before_after, known
    measured = moved_as_measured(sequence, camera, sequence.rig.T_imu_cam)
    return np.where(known[:, None, None], T_before_after, measured), np.ones_like(known)


def _window(sequence: Sequence, keys: IntArray, T_before_after: Array, w_bias: Array) -> KeyFrameWindow | None:
    """Return a window of frames (n,), initialised by the camera's own motion; None with too few tracks."""
    sighting, key, track = _long_tracks(sequence, keys)
    if track.size == 0 or track[-1] + 1 < FEWEST_TRACKS:
        return None
    T_imu_cam, uv_px = sequence.rig.T_imu_cam, sequence.observations.uv_px[sighting]
    T_first_cam = T_imu_cam @ chained(T_before_after)[keys - keys[0]]
    T_first_imu = T_first_cam @ se3_inverse(T_imu_cam)
    by_imu = sequence.motion_kind == "imu"
    strides = (imu_strides if by_imu else twist_strides)(sequence, sequence.frames_t_ns[keys], w_bias)
    nearest_first = np.lexsort((-disparity_px(uv_px), track))
    nearest = nearest_first[np.searchsorted(track, np.arange(track[-1] + 1))]
    points = transform(T_first_cam[key[nearest]], triangulate(uv_px[nearest], sequence.rig))
    velocity, gravity = _velocities(T_first_imu, strides)
    w_radps = _rates(sequence, keys) - w_bias
    position, later = T_first_imu[:, :3, 3], float(np.mean(keys[1:] > sequence.frame_count // 2)) - 0.5
    return KeyFrameWindow(
        T_first_imu[:, :3, :3], position, velocity, w_radps, gravity, later, strides, key, track, uv_px, points
    )


def _long_tracks(sequence: Sequence, keys: IntArray) -> tuple[IntArray, IntArray, IntArray]:
    """Return rows (N,) of the longest tracks' sightings in key frames, sorted by track, and key and track (N,)."""
    seen = sequence.observations
    begin, end = np.searchsorted(seen.frame, [keys[0], keys[-1] + 1])
    key_of = np.full(keys[-1] - keys[0] + 1, -1)
    key_of[keys - keys[0]] = np.arange(keys.size)
    row = begin + np.flatnonzero((key_of[seen.frame[begin:end] - keys[0]] >= 0) & _usable(seen.uv_px[begin:end]))
    _, track, sightings = np.unique(seen.track_id[row], return_inverse=True, return_counts=True)
    longest = np.argsort(-sightings, kind="stable")[: MOST[sequence.motion_kind].tracks]
    chosen = longest[sightings[longest] >= FEWEST_SIGHTINGS]
    row = row[np.isin(track, chosen)]
    row = row[np.argsort(seen.track_id[row], kind="stable")]
    _, track = np.unique(seen.track_id[row], return_inverse=True)
    return row, key_of[seen.frame[row] - keys[0]], track


def _usable(uv_px: Array) -> BoolArray:
    """Say which sightings (N, 3) are of both cameras and near enough."""
    both = ~is_left_only(uv_px)
    both[both] = disparity_px(uv_px[both]) > LEAST_DISPARITY_PX
    return np.asarray(both & np.isfinite(uv_px).all(axis=1))


def _velocities(T_first_imu: Array, strides: ImuStrides | TwistStrides) -> tuple[Array, Array]:
    """Return velocities (n, 3) and gravity (3,) at poses (n, 4, 4), by linear least squares over an IMU's strides.

    With odometry the velocities are means of the neighbouring strides', and gravity is zero.
    """
    n, dt_s = len(T_first_imu), strides.dt_s
    R_first_a, position = T_first_imu[:-1, :3, :3], T_first_imu[:, :3, 3]
    if isinstance(strides, TwistStrides):
        v_mps = (R_first_a @ strides.moved[:, :, None])[..., 0] / dt_s[:, None]
        ends = np.concatenate([v_mps[:1], v_mps, v_mps[-1:]])
        return 0.5 * (ends[1:] + ends[:-1]), np.zeros(3)
    rows, jacobian = np.arange(n - 1), np.zeros((2, n - 1, n + 1))
    jacobian[0, rows, rows], jacobian[0, :, n] = dt_s, 0.5 * dt_s**2
    jacobian[1, rows, rows], jacobian[1, rows, rows + 1], jacobian[1, :, n] = -1.0, 1.0, -dt_s
    by_force = (R_first_a @ np.stack([strides.moved, strides.faster])[..., None])[..., 0]
    response = np.stack([np.diff(position, axis=0) - by_force[0], by_force[1]])
    found = np.linalg.lstsq(jacobian.reshape(-1, n + 1), response.reshape(-1, 3))[0]
    return found[:n], found[n]


def _rates(sequence: Sequence, keys: IntArray) -> Array:
    """Return the gyro's means (n, 3) rad/s over the two intervals around each of the frames (n,)."""
    mean = interval_means(sequence.motion.t_ns, sequence.motion.values[:, 3:], sequence.frames_t_ns)
    return np.asarray(0.5 * (mean[np.maximum(keys - 1, 0)] + mean[np.minimum(keys, len(mean) - 1)]))
