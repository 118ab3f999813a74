"""Errors of the calibration that the data contradict: intrinsics, extrinsic, scales and biases."""

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from toolkit.audit.alignment import SYSTEMATIC_RAD, Turn, VelocityFit, metres, turn_by_rotations
from toolkit.audit.fault import Evidence, Symptom, Undecided, beside_camera
from toolkit.audit.intervals import (
    LEAST_INTERVALS,
    MOST_FORCE_RATIO,
    MOST_RATIO,
    Intervals,
    force_ratio,
    rotation_ratio,
)
from toolkit.audit.one_step import errors_are_independent, own_one_step_px
from toolkit.audit.robust import Scalar, median_error, slope
from toolkit.audit.self_calibration import (
    BASELINE,
    GYRO_BIAS,
    LATE,
    RIGHT_ROLL,
    RIGHT_SHIFT,
    RIGHT_SIGMAS,
    TURN,
    SelfCalibration,
    self_calibration,
)
from toolkit.geometry import Array
from toolkit.jackknife import jackknife_error
from toolkit.measurements import MotionKind, Prior, StereoRig, is_measured
from toolkit.models.camera_motion import CameraMotion, camera_motion
from toolkit.motion_samples import TwistSamples
from toolkit.sequence import Sequence


class Judged(NamedTuple):
    """A parameter of the self-calibration that is judged: its rows, and what to check where it is wrong.

    ``limits`` are those of sound recordings, beyond the standard errors, and ``hidden`` the sizes from which on an
    error that would not show is reported as ``unseen``, both by the kind of motion; infinite where it is not judged.
    """

    rows: slice
    check: str
    limits: dict[MotionKind, float]
    hidden: dict[MotionKind, float]
    unseen: str = ""


def _by_kind(imu: float = np.inf, twist: float = np.inf) -> dict[MotionKind, float]:
    return {"imu": imu, "twist": twist}


def _one(row: int) -> slice:
    return slice(row, row + 1)


_PAIR, _FAR = "the rectification of the pair", "too little motion sideways to near points"
_TURNS = "too little rotation"
# Limits are about twice what parts of sound recordings exceed four (six) standard errors by (docs/audit.md); hidden
# errors are reported where they would triple those of estimators. With odometry the baseline is judged by
# `vision_scale`, the clock by `time_offset`, and a hidden rotation by the velocities. A shift of an image has the same
# effect on far points as a baseline.
JUDGED = {
    "fx_px": Judged(_one(0), "K", _by_kind(0.012, 0.06), _by_kind(0.02, 0.16), "fx off by {:.0%}"),
    "fy_px": Judged(_one(1), "K", _by_kind(0.012, 0.06), _by_kind(0.02, 0.16), "fy off by {:.0%}"),
    "cx_px": Judged(_one(2), "K", _by_kind(2.0, 8.0), _by_kind(10.0), "cx off by {:.0f} px"),
    "cy_px": Judged(_one(3), "K", _by_kind(5.0, 12.0), _by_kind(10.0), "cy off by {:.0f} px"),
    "baseline": Judged(_one(BASELINE), f"the baseline, {_PAIR}", _by_kind(0.015), _by_kind()),
    "turn": Judged(
        TURN, "the rotation of T_imu_cam", _by_kind(0.006, 0.06), _by_kind(0.02), "a camera turned by {:.2f} rad"
    ),
    "clock": Judged(_one(LATE), "the clocks of the camera and the IMU", _by_kind(0.0008), _by_kind()),
    "right shift": Judged(
        _one(RIGHT_SHIFT), _PAIR, _by_kind(0.05, 0.3), _by_kind(0.5, 1.5), "a right image shifted by {:.1f} px"
    ),
    "right roll": Judged(
        _one(RIGHT_ROLL), _PAIR, _by_kind(0.002, 0.003), _by_kind(0.01, 0.02), "a right image rolled by {:.3f} rad"
    ),
}
BESIDE = {"imu": "IMU", "twist": "odometry"}


# One wrong part: the message, and what to check.
Wrong = tuple[str, str]


def wrong(found: SelfCalibration, rig: StereoRig, kind: MotionKind) -> list[Wrong]:
    """Return the wrong parts of the rig from which the self-calibration started.

    Their standard errors include the largest error of sound recordings, half of the limit.
    """
    return _beyond(found, rig, kind, {name: one.limits[kind] for name, one in JUDGED.items()})


def doubtful(found: SelfCalibration, rig: StereoRig, kind: MotionKind) -> str | None:
    differences = _beyond(found, rig, kind, {name: 0.0 for name, one in JUDGED.items() if one.unseen})
    summary = "; ".join(told for told, _ in differences)
    return f"{summary}: that is more than chance and no more than in recordings without faults" if differences else None


def hidden(found: SelfCalibration, kind: MotionKind) -> str | None:
    """Describe which errors of the intrinsics and the camera's rotation would go undetected, if they are large."""
    unseen: dict[str, list[str]] = {_TURNS: [], _FAR: []}
    for name, one in JUDGED.items():
        least = _least(found, name, kind)
        if least > one.hidden[kind]:
            unseen[_FAR if one.check == _PAIR else _TURNS].append(one.unseen.format(least))
    return "; ".join(f"{why}: {', '.join(parts)} would not show" for why, parts in unseen.items() if parts) or None


def _least(found: SelfCalibration, name: str, kind: MotionKind) -> float:
    one = JUDGED[name]
    return one.limits[kind] + RIGHT_SIGMAS[kind] * float(found.error[one.rows].max())


def _beyond(found: SelfCalibration, rig: StereoRig, kind: MotionKind, limits: dict[str, float]) -> list[Wrong]:
    wrongs = list[Wrong]()
    for name, limit in limits.items():
        rows, check = JUDGED[name].rows, JUDGED[name].check
        value, error = found.value[rows], found.error[rows]
        if (np.abs(value) > limit + RIGHT_SIGMAS[kind] * error).any():
            wrongs.append((_summary(name, value, np.hypot(error, 0.5 * limit), rig, BESIDE[kind]), check))
    return wrongs


def _summary(name: str, value: Array, error: Array, rig: StereoRig, beside: str) -> str:
    (off, *_), (e, *_) = value.tolist(), error.tolist()
    if name in ("fx_px", "fy_px", "cx_px", "cy_px"):
        given = getattr(rig, name)
        fit, e = (given * np.exp(off), given * np.exp(off) * e) if name in ("fx_px", "fy_px") else (given + off, e)
        return f"tracks and {beside} fit {name} = {fit:.1f} +- {e:.1f}, not {given:g}"
    if name == "turn":
        axes = ", ".join(f"{t:+.3f} +- {s:.3f}" for t, s in zip(value, error, strict=True))
        return f"the camera moves as if it were turned by ({axes}) rad about its own x, y, z against T_imu_cam"
    return {
        "baseline": f"a baseline {np.exp(off):.3f} +- {np.exp(off) * e:.3f} times the given one fits",
        "clock": f"frames are stamped {1e3 * abs(off):.1f} +- {1e3 * e:.1f} ms too {'early' if off > 0.0 else 'late'}",
        "right shift": f"the right image's columns are {off:+.2f} +- {e:.2f} px off",
        "right roll": f"the right camera looks rolled about its optical axis by {off:+.4f} +- {e:.4f} rad",
    }[name]


def _unfitted(kind: MotionKind) -> str:
    unseen = f"no tracks are long enough to be compared with the {BESIDE[kind]}"
    return f"{unseen}, or no calibration near the given one fits them"


# Quantiles of the sightings that are taken as their range: tracks may slide out of the image.
RANGE = (0.005, 0.995)
# Limits of the range over the focal length: 2 is a view of 90 degrees, 12 one of 161 degrees, 0.02 one of 1 degree.
WIDEST, NARROWEST = 12.0, 0.02
# Coordinates in pixels exceed this value, normalised ones (in multiples of the focal length) do not.
NORMALISED = 10.0
# A usual range over the focal length, also the least factor between two sizes of an image; and the largest ratio of the
# factors of width and height for one change of size.
USUAL, ALIKE = 1.5, 1.3
# Least share by which other intrinsics must lower the tracks' residual; half a view of a wrong centre gives 0.15.
LEAST_GAIN = 0.05
TRIED_FRAMES = 300
# Where the principal point is farther than this share of the range from the middle, the middle is tried.
MOST_OFF_MIDDLE = 0.2
# Largest ratio of fy and fx in either direction: pixels are square unless an image was rescaled.
MOST_STRETCHED = 1.5


def intrinsics(evidence: Evidence) -> Symptom | None:
    sequence = evidence.sequence
    uv_px = sequence.observations.uv_px
    if len(uv_px) < LEAST_INTERVALS or not is_measured(uv_px).all():
        return None
    low, high = np.quantile(uv_px[:, [0, 2]], RANGE, axis=0)
    if np.abs([low, high]).max() < NORMALISED and sequence.rig.fx_px > NORMALISED:
        u, v = (f"{a:.2g} to {b:.2g}" for a, b in zip(low, high, strict=True))
        pixels = f"not pixels of fx_px = {sequence.rig.fx_px:g}: normalised image coordinates"
        why = "write fx_px u + cx_px and fy_px v + cy_px for them"
        return Symptom(1, f"the sightings, u {u} and v {v}, are {pixels}", why, remedy=None, spoils_vision=True)
    faults = _suspects(sequence.rig, low, high)
    if not faults:
        return None
    ordinary: dict[str, Any] = {key: value for fields, _ in faults for key, value in fields.items()}
    other = replace(sequence.rig, **ordinary)
    part = sequence.truncated(TRIED_FRAMES)
    given_px = _own_px(part, evidence.camera_motion.first(max(part.frame_count - 1, 0)))
    tried = replace(part, rig=other)
    other_px = _own_px(tried, camera_motion(tried))
    if not given_px * (1.0 - LEAST_GAIN) > other_px:
        return None
    residuals = (
        f"the tracks' residuals against the best-fitting camera motion are {given_px:.2f} px, and {other_px:.2f} px"
    )
    detail = f"{'; '.join(summary for _, summary in faults)}: {residuals} with typical values"
    why = "the true values are not in the data: correct K, or the pixels"
    return Symptom(len(faults), detail, why, remedy=None, spoils_vision=True)


def _suspects(rig: StereoRig, low: Array, high: Array) -> list[tuple[dict[str, Any], str]]:
    """Return ordinary values for the fields that contradict sightings from ``low`` to ``high`` (u, v), and why."""
    found: list[tuple[dict[str, Any], str]] = []
    middle, width_px = 0.5 * (low + high), float((high - low).max())
    centre = np.array([rig.cx_px, rig.cy_px])
    if (np.abs(centre - middle) > MOST_OFF_MIDDLE * (high - low)).any():
        u, v = (f"{a:.0f} to {b:.0f}" for a, b in zip(low, high, strict=True))
        lies = "outside" if ((centre < low) | (centre > high)).any() else "far off the middle of"
        where = f"(cx_px, cy_px) = ({centre[0]:.0f}, {centre[1]:.0f}) lies {lies} the sightings, u {u}, v {v} px"
        if (resized := _resized(rig, middle)) is not None:
            return [resized]
        found.append(({"cx_px": float(middle[0]), "cy_px": float(middle[1])}, where))
    if not NARROWEST * rig.fx_px < width_px < WIDEST * rig.fx_px:
        angle_deg = np.degrees(2.0 * np.arctan2(0.5 * width_px, rig.fx_px))
        usual_px = width_px / USUAL
        summary = f"fx_px = {rig.fx_px:g} makes the sightings, {width_px:.0f} px across, a view of {angle_deg:.1f} deg"
        found.append(({"fx_px": usual_px, "fy_px": usual_px}, summary))
    elif not 1.0 / MOST_STRETCHED < rig.fy_px / rig.fx_px < MOST_STRETCHED:
        summary = f"fy_px = {rig.fy_px:g} beside fx_px = {rig.fx_px:g}: pixels are far from square"
        found.append(({"fy_px": rig.fx_px}, summary))
    return found


def _resized(rig: StereoRig, middle: Array) -> tuple[dict[str, Any], str] | None:
    """Return the K of images larger or smaller by one factor, if it puts the principal point into the middle."""
    ratio = middle / np.maximum([rig.cx_px, rig.cy_px], 1.0)
    factor = float(np.sqrt(ratio[0] * ratio[1]))
    if ratio.max() > ALIKE * ratio.min() or 1.0 / USUAL < factor < USUAL:
        return None
    K = {name: factor * getattr(rig, name) for name in ("fx_px", "fy_px", "cx_px", "cy_px")}
    size = f"that of images of {1.0 / factor:.2g} times the size of those the sightings are in"
    return K, f"K with (cx_px, cy_px) = ({rig.cx_px:.0f}, {rig.cy_px:.0f}) looks like {size}"


def _own_px(sequence: Sequence, camera: CameraMotion) -> float:
    own_px = own_one_step_px(sequence, camera)
    return own_px if np.isfinite(own_px) else np.inf


# Measured speed (m/s) below which the vehicle stands, and the fewest samples of a standstill that are used.
STANDING_MPS = 0.05
LEAST_STANDING = 50
# Systematic errors (rad/s), added to the standard error of the median: a standing vehicle vibrates, and the camera's
# own rotation is off by up to 0.0045 on KITTI drives whose gyro has no bias.
SYSTEMATIC_STANDING = 0.00075
SYSTEMATIC_CAMERA = 0.00125
# The same for self-calibrations: on V2_01 they are off by up to 0.0009 rad/s, six of their standard errors.
SYSTEMATIC_FIT = 0.0004
BIAS_SIGMAS = 4.0
# With odometry and without a prior, estimators start from a bias of zero with this standard deviation (rad/s).
UNKNOWN_SIGMA_RADPS = 0.02


def gyro_bias(evidence: Evidence) -> Symptom | Undecided | None:
    """Report a constant bias of the gyro, which is left to the estimators.

    A prior that excludes it makes them diverge, so its covariance is widened; with odometry and without a prior they
    start from zero, and a bias that is too large for that is subtracted.
    """
    if (reading := _bias_read(evidence)) is None:
        return evidence.blind
    bias_radps, error_radps, source = reading
    sequence, motion, prior = evidence.sequence, evidence.sequence.motion, evidence.sequence.prior
    expected_radps, sigma_radps = np.zeros(3), np.full(3, UNKNOWN_SIGMA_RADPS)
    if prior is not None:
        expected_radps, sigma_radps = prior.bias[3:], np.sqrt(np.diag(prior.cov)[-3:])
    excluded = np.abs(bias_radps - expected_radps) > BIAS_SIGMAS * np.hypot(sigma_radps, error_radps)
    biased = np.abs(bias_radps) > BIAS_SIGMAS * error_radps
    if not (count := int((biased | excluded).sum())):
        return None
    values = ", ".join(f"{b:z.4f} +- {e:.4f}" for b, e in zip(bias_radps, error_radps, strict=True))
    detail = f"the gyro reads ({values}) rad/s too much about x, y, z ({source})"
    if prior is None and isinstance(motion, TwistSamples) and excluded.any():
        detail += ", more than expected by estimators that start without a bias"
        remedy = replace(sequence, motion=replace(motion, w_radps=motion.w_radps - bias_radps))
        return Symptom(count, detail, "it is subtracted", remedy)
    if prior is None or not excluded.any():
        return Symptom.information(count, detail, "left to the estimators, which estimate a gyro bias")
    stated = ", ".join(f"{b:z.4f} +- {s:.4f}" for b, s in zip(expected_radps, sigma_radps, strict=True))
    detail += f", and the prior has ({stated})"
    treatment = "the prior's covariance of it is widened by the difference"
    return Symptom(count, detail, treatment, replace(sequence, prior=_widened(prior, bias_radps, error_radps)))


def _widened(prior: Prior, bias_radps: Array, error_radps: Array) -> Prior:
    """Return a prior that allows the bias, widened for all axes: one with a smaller difference is known no better."""
    cov = prior.cov.copy()
    cov[-3:, -3:] += np.diag((bias_radps - prior.bias[3:]) ** 2 + error_radps**2)
    return replace(prior, cov=cov, source=f"{prior.source}; its gyro bias widened by the audit")


def _bias_read(evidence: Evidence) -> tuple[Array, Array, str] | None:
    """Return the bias of the gyro (3,) rad/s, its standard error with the systematic one, and how it was estimated."""
    motion, intervals, fitted = evidence.sequence.motion, evidence.intervals, evidence.self_calibration
    if isinstance(motion, TwistSamples):
        stands = (np.linalg.norm(motion.v_mps, axis=1) < STANDING_MPS) & np.isfinite(motion.w_radps).all(axis=1)
        if stands.sum() >= LEAST_STANDING:
            return *_median(motion.w_radps[stands], SYSTEMATIC_STANDING), f"{stands.sum()} samples at standstill"
    if fitted is not None:
        error_radps = np.hypot(fitted.error[GYRO_BIAS], SYSTEMATIC_FIT)
        return fitted.value[GYRO_BIAS], error_radps, "the bias for which tracks and IMU agree"
    if intervals is None:
        return None
    source = f"against the camera's rotation over {len(intervals.interval)} intervals"
    return *_median(intervals.w_radps - intervals.w_seen_radps, SYSTEMATIC_CAMERA), source


def _median(residual_radps: Array, systematic_radps: float) -> tuple[Array, Array]:
    return np.median(residual_radps, axis=0), np.hypot(median_error(residual_radps), systematic_radps)


# A scale is reported beyond this many standard errors and this share; tracks that drift cause 2.3 % at most.
GYRO_SCALE_SIGMAS, GYRO_SCALE_SYSTEMATIC = 5.0, 0.05
# An axis is judged only if the lower bound is more than this share of the upper one: it has rotation enough.
LEAST_IN_COMMON = 0.8


@beside_camera
def gyro_scale(evidence: Evidence, intervals: Intervals) -> Symptom | Undecided | None:
    """Report the axes of the gyro whose rates are a multiple of the camera's: a channel with a wrong scale.

    Noise lowers the slope of the gyro's rates on the camera's, and raises the inverse of the opposite one (Frisch,
    "Statistical confluence analysis", 1934): the scale is wrong where both are on one side of 1.
    """
    off, doubtful = list[str](), list[str]()
    both = (rates - np.median(rates, axis=0) for rates in (intervals.w_radps, intervals.w_seen_radps))
    for axis, measured, seen in zip("xyz", *(rates.T for rates in both), strict=True):
        found = _sensitivity(measured, seen)
        if found is None:
            continue
        beyond = abs(found.value - 1.0) - GYRO_SCALE_SIGMAS * found.error
        if beyond > 0.0:
            excess = f"{found.value:.3f} +- {found.error:.3f} times as fast as the camera about {axis}"
            (off if beyond > GYRO_SCALE_SYSTEMATIC else doubtful).append(excess)
    if off:
        treatment = "check the scale of each of its axes; no estimator estimates it"
        return Symptom.warning(f"the gyro turns {', '.join(off)}", treatment, len(off))
    if doubtful:
        within = f"by less than {100.0 * GYRO_SCALE_SYSTEMATIC:g} % beyond chance, which drifting tracks can cause"
        return Undecided(f"the gyro turns {', '.join(doubtful)}, {within}")
    return None


def _sensitivity(measured: Array, seen: Array) -> Scalar | None:
    """Return the bound nearer to 1, with its standard error; None where the bounds enclose 1 or are far apart."""
    least, most = _slope(measured, seen), _inverse_slope(measured, seen)
    if not least > LEAST_IN_COMMON * most > 0.0 or least <= 1.0 <= most:
        return None
    nearer = _slope if least > 1.0 else _inverse_slope
    return Scalar(nearer(measured, seen), jackknife_error(nearer, measured, seen))


def _slope(response: Array, regressor: Array) -> float:
    return slope(regressor[:, None], regressor[:, None], response[:, None]).value


def _inverse_slope(measured: Array, seen: Array) -> float:
    """Return the inverse of the slope of the camera's rates on the measured ones; infinite where it is not positive."""
    found = _slope(seen, measured)
    return 1.0 / found if found > 0.0 else np.inf


# Limits of an axis: this many standard errors beyond what sound recordings at hand have (m). The velocities of cars are
# those of another point, or slip: 0.43 to 0.85 m along x in all seven.
LEVER_SIGMAS, SYSTEMATIC_M = {"twist": 5.0, "imu": 4.0}, {"twist": 0.6, "imu": 0.015}
# An axis along which the standard error of the position is larger than this (m) is not judged.
LARGEST_ERROR_M = 0.25
# Where only a camera farther off than this (m) would be found, the finding is undecided and says so.
HIDDEN_M = {"twist": 1.2, "imu": 0.5}


@beside_camera
def lever_arm(evidence: Evidence, intervals: Intervals) -> Symptom | Undecided | None:
    """Report the axes along which the camera is not where the extrinsic has it, or the velocities are of another point.

    In a turn of rate w, a camera whose position is wrong by p moves by w x p more than expected.
    """
    found, kind, T_imu_cam = evidence.position, evidence.sequence.motion_kind, evidence.sequence.rig.T_imu_cam
    if found is None:
        return Undecided(f"the camera's position: {_unfitted(kind)}")
    if not (decidable := found.error_m < LARGEST_ERROR_M).any():
        errors = ", ".join(f"{error:.1f}" for error in found.error_m)
        return Undecided(f"too little rotation: the camera's position along x, y and z is known to {errors} m only")
    least_m = SYSTEMATIC_M[kind] + LEVER_SIGMAS[kind] * found.error_m
    if not (off := decidable & (np.abs(found.lacking_m) > least_m)).any():
        far = np.flatnonzero(decidable & (least_m > HIDDEN_M[kind])).tolist()
        parts = ", ".join(f"{least_m[k]:.1f} m along {'xyz'[k]}" for k in far)
        hidden = f"too little rotation: a camera that is off by less than {parts} would not show"
        return Undecided(hidden) if far else None
    axes = np.flatnonzero(off).tolist()
    axes_m = [f"{found.lacking_m[k]:+.2f} +- {found.error_m[k]:.2f} m along {'xyz'[k]}" for k in axes]
    place = f"from {metres(T_imu_cam[:3, 3])}, its position in T_imu_cam"
    summary = f"residuals are correlated with rotation: the camera is off by {', '.join(axes_m)} {place}"
    other_point = "" if kind == "imu" else ", and which point of the vehicle the velocities are of"
    return Symptom.warning(summary, f"check the translation of T_imu_cam{other_point}", len(axes))


# Limits, beyond five standard errors, of the ratios of specific force to gravity and of the gyro's rates to the
# camera's; of 699 parts of sound recordings two exceed one, by 0.011. Noise lowers the second: only values above 1
# count.
RATIO_SIGMAS, SYSTEMATIC_FORCE, SYSTEMATIC_RATE = 5.0, 0.05, {"twist": 0.025, "imu": 0.01}
# Where only a rotation (rad) larger than this would be found, the finding is undecided and says so.
LARGEST_RAD = 0.05
# With an IMU the self-calibration finds rotations (rad) up to about this one. Larger ones, for which it finds no
# calibration, are seen in the rates of rotation; what other faults look like there is smaller (0.115 at most).
FAR_RAD = 0.2
SLIP = "wheel slip that lasts for seconds is as large"


@beside_camera
def miscalibration(evidence: Evidence, intervals: Intervals) -> Symptom | Undecided | None:
    """Report small errors of the calibration that bend a trajectory: rotation, K, the accelerometer's scale.

    Points followed over a second show most of them (`self_calibration`). With odometry, whose slip lasts as long, the
    rotation by its velocities is judged as well; with an IMU and no calibration that fits, a large one by the rates.
    """
    sequence, rig, kind, found = (
        evidence.sequence,
        evidence.sequence.rig,
        evidence.sequence.motion_kind,
        evidence.self_calibration,
    )
    if kind == "twist":
        found = self_calibration(sequence, evidence.camera_motion, intervals)
    wrongs = [] if found is None else wrong(found, rig, kind)
    unseen = [f"the intrinsics: {_unfitted(kind)}" if found is None else hidden(found, kind)]
    if evidence.velocity_fit is not None:
        turned, unturned = _by_turn(evidence.velocity_fit.turn, rig, SYSTEMATIC_RAD, SLIP)
        wrongs, unseen = wrongs or turned, [unturned, *unseen]
    elif found is not None:
        unseen = [doubtful(found, rig, kind), *unseen]
    else:
        wrongs, unturned = _by_turn(turn_by_rotations(intervals), rig, FAR_RAD, "rates of rotation alone tell of it")
        unseen = [unturned, *unseen]
    rate, fits = rotation_ratio(intervals), found is not None and not wrongs  # else the rates of an IMU accuse the gyro
    least = 1.0 + RATIO_SIGMAS * rate.error + SYSTEMATIC_RATE[kind]
    if (kind == "twist" or fits) and least < rate.value < MOST_RATIO:
        summary = f"the gyro turns {rate.value:.3f} +- {rate.error:.3f} times as fast as the camera"
        wrongs.append((summary, "the scale of the gyro and the focal length"))
    force = force_ratio(sequence)
    near = force is not None and 1.0 / MOST_FORCE_RATIO < force.value < MOST_FORCE_RATIO  # else a `disagreement`
    if force is not None and near and abs(force.value - 1.0) > RATIO_SIGMAS * force.error + SYSTEMATIC_FORCE:
        summary = f"the accelerometer reads {force.value:.3f} +- {force.error:.3f} times gravity (median)"
        wrongs.append((summary, "the scale and the bias of the accelerometer"))
    if not wrongs:
        return Undecided("; ".join(filter(None, unseen))) if any(unseen) else None
    return Symptom.warning(
        count=len(wrongs),
        detail="; ".join(told for told, _ in wrongs),
        treatment=f"check {', '.join(dict.fromkeys(part for _, check in wrongs for part in check.split(', ')))}",
    )


def _by_turn(turn: Turn, rig: StereoRig, systematic_rad: float, why: str) -> tuple[list[Wrong], str]:
    least_rad = systematic_rad + turn.by_chance_rad
    least = float(least_rad.min())
    if (np.abs(turn.rad) > least_rad).any():
        angle, error = turn.angle
        summary = (
            f"the camera moves as if it were turned by {angle:.3f} +- {error:.3f} rad against "
            f"T_imu_cam, or its principal point were {angle * rig.fx_px:.0f} px off"
        )
        return [(summary, "the extrinsic and the principal point")], ""
    if least < LARGEST_RAD:
        return [], ""
    unseen = f"a rotation of it by less than {least:.2f} rad" if np.isfinite(least) else "any rotation of it"
    return [], f"the camera's orientation: {unseen} would not show, for {why}"


# Limit of the scale beyond chance (0.044 +- 0.007 in cars), and the largest standard error with which it is judged.
SYSTEMATIC_SCALE, LARGEST_SCALE_ERROR = {"twist": 0.03, "imu": 0.025}, 0.02
# From this size on, what would not be found is undecided: 2 % beside odometry make errors of estimators six times as
# large; with an IMU it is about a stereo system's drift.
LARGEST_HIDDEN_SCALE = {"twist": 0.02, "imu": 0.01}


@beside_camera
def vision_scale(evidence: Evidence, intervals: Intervals) -> Symptom | Undecided | None:
    """Report steps of vision longer or shorter than those by odometry's velocities, or a baseline that fits the IMU.

    A relative error of all depths does that. A ratio beyond MOST_RATIO is a `disagreement`.
    """
    if evidence.velocity_fit is not None:
        return _scale_beside_odometry(evidence.velocity_fit)
    return _scale_beside_imu(evidence.self_calibration)


def _scale_beside_odometry(found: VelocityFit) -> Symptom | Undecided | None:
    scale, error = found.scale
    if error <= LARGEST_SCALE_ERROR and abs(scale) >= SYSTEMATIC_SCALE["twist"] + found.scale_by_chance:
        cause = (
            "disparities, baseline or focal length are wrong, or wheels: check K, the baseline and the samples' unit"
        )
        is_scale = 1.0 / MOST_RATIO < 1.0 + scale < MOST_RATIO  # else reported as a disagreement
        return Symptom.warning(_steps(found.scale, "odometry"), cause) if is_scale else None
    hidden = found.scale_by_chance + abs(scale)
    off = f"vision's steps are off by {100.0 * scale:+.1f} +- {100.0 * error:.1f} %"
    if error > LARGEST_SCALE_ERROR:
        return Undecided(f"{off}: too little change of velocity to judge that")
    unseen = f"{off}: a fault of less than {100.0 * hidden:.1f} % would not show beside what slip causes"
    return None if hidden < LARGEST_HIDDEN_SCALE["twist"] else Undecided(unseen)


def _scale_beside_imu(found: SelfCalibration | None) -> Symptom | Undecided | None:
    if found is None:
        return Undecided(f"the scale of vision: {_unfitted('imu')}")
    factor, error = float(np.exp(found.value[BASELINE])), float(found.error[BASELINE])
    if abs(found.value[BASELINE]) > SYSTEMATIC_SCALE["imu"] + RIGHT_SIGMAS["imu"] * error:
        cause = "disparities, baseline or focal length are wrong: check K and the baseline"
        return Symptom.warning(_steps(Scalar(1.0 / factor - 1.0, error / factor), "IMU"), cause)
    hidden = _least(found, "baseline", "imu") + abs(found.value[BASELINE])
    seen = f"tracks and IMU fit a baseline {factor:.3f} +- {factor * error:.3f} times the given one"
    unseen = f"too little change of velocity: {seen}, and less than {100.0 * hidden:.1f} % would not show"
    return None if hidden < LARGEST_HIDDEN_SCALE["imu"] else Undecided(unseen)


def _steps(scale: Scalar, measured: str) -> str:
    size = f"vision's steps are {100.0 * abs(scale.value):.1f} +- {100.0 * scale.error:.1f} %"
    return f"{size} {'longer' if scale.value > 0.0 else 'shorter'} than the {measured}'s"


# Excess beyond chance (a share, rad) that tracks which drift from image to image cause in simulations without slip.
SCALE_BY_TRACK_DRIFT, TURN_BY_TRACK_DRIFT_RAD = 0.005, 0.003


def steady_difference(evidence: Evidence) -> Symptom | None:
    found = evidence.velocity_fit
    if found is None:
        return None
    (angle, error), differences = found.turn.angle, list[str]()
    beyond = abs(found.scale.value) - found.scale_by_chance
    beyond_rad = float((np.abs(found.turn.rad) - found.turn.by_chance_rad).max())
    independent = errors_are_independent(evidence.step_correlation)
    least, least_rad = (0.0, 0.0) if independent else (SCALE_BY_TRACK_DRIFT, TURN_BY_TRACK_DRIFT_RAD)
    if found.scale.error <= LARGEST_SCALE_ERROR and least < beyond < SYSTEMATIC_SCALE["twist"]:
        differences.append(_steps(found.scale, "odometry"))
    if least_rad < beyond_rad < SYSTEMATIC_RAD:
        off = f"the camera moves at an angle of {angle:.3f} +- {error:.3f} rad to the velocities"
        equivalent = f"{angle * evidence.sequence.rig.fx_px:.0f} px of the principal point"
        differences.append(f"{off}, equivalent to {equivalent}")
    if not differences:
        return None
    return Symptom.information(
        len(differences),
        f"vision and odometry differ during the whole recording: {'; '.join(differences)}",
        "possible causes are a wrong focal length, baseline, principal point or wheel scale, or slip and pitch, "
        "which cause as much in recordings of cars without faults; by default estimators model none of these",
    )
