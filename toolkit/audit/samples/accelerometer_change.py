"""An accelerometer that reads another gravity from some time on: its range or scale was changed, or it was knocked.

The camera's velocity less the integrated specific force changes by gravity. The size of its slope over a few seconds is
the gravity that the accelerometer reads there, to a few thousandths with good tracks. The gyro's drift changes only its
direction, which is not used.
"""

import numpy as np

from toolkit.audit.fault import Evidence, Fault, Symptom, Undecided
from toolkit.audit.parts.one_step import errors_are_independent
from toolkit.audit.parts.robust import CAUCHY_SIGMAS, ITERATIONS, Scalar
from toolkit.geometry import Array, BoolArray
from toolkit.models.gating import MAD_TO_SIGMA
from toolkit.resampling import NS_PER_S

# The parts before and after each of these shares of the recording are compared. A change must be beyond so many
# standard errors and a share of gravity, a larger one unless the errors of the tracks are independent. Beyond five
# standard errors, parts of sound recordings at hand have 0.3 % at most, and simulated flights whose tracks drift from
# image to image 0.8 %. Chosen with them in view.
CUTS, SIGMAS, SYSTEMATIC, BY_TRACK_DRIFT = (1.0 / 3.0, 0.5, 2.0 / 3.0), 5.0, 0.005, 0.012
# Length (s) of the windows in which gravity is read, short enough for the gyro's drift to be negligible, and the least
# number of intervals of a window.
WINDOW_S, LEAST_INTERVALS = 4.0, 12
# Where only a change larger than this share of gravity would be found, the finding is undecided and says so.
LARGEST_HIDDEN = 0.05


def check(evidence: Evidence) -> Symptom | Undecided | None:
    """Compare the gravity that is read before and after three times."""
    sequence = evidence.sequence
    if sequence.motion_kind != "imu":
        return None
    if evidence.intervals is None:
        return evidence.blind
    middle_ns, v_mps = evidence.integrated_gravity
    t_s, known = (middle_ns - sequence.frames_t_ns[0]) / NS_PER_S, evidence.camera_motion.known
    steps = {share: _step(t_s, v_mps, known, share * sequence.duration_s) for share in CUTS}
    found = {share: step for share, step in steps.items() if step is not None}
    gravity = float(np.linalg.norm(sequence.gravity_world))
    if not found:
        return Undecided("too few intervals whose camera motion is known, to estimate gravity before and after")
    share, step = max(found.items(), key=lambda one: abs(one[1].value) / one[1].error)
    least = SYSTEMATIC * gravity + SIGMAS * step.error
    if abs(step.value) > least and not errors_are_independent(evidence.step_correlation):
        least = BY_TRACK_DRIFT * gravity + SIGMAS * step.error
    if abs(step.value) < least:
        hidden = least / gravity
        return None if hidden < LARGEST_HIDDEN else Undecided(f"a change by less than {hidden:.0%} would not show")
    return Symptom.warning(
        count=1,
        detail=(
            f"from about {share * sequence.duration_s:.0f} s on the accelerometer reads a gravity that is "
            f"{abs(step.value):.2f} +- {step.error:.2f} m/s^2 {'more' if step.value > 0.0 else 'less'} than before"
        ),
        treatment="its range or its scale have changed, or it was knocked: no constant bias describes the recording",
    )


def _step(t_s: Array, fallen: Array, known: BoolArray, at_s: float) -> Scalar | None:
    """Return how much more gravity (m/s^2) is read after a time than before it; None where one of both is not known."""
    before, after = _gravity(t_s, fallen, known & (t_s < at_s)), _gravity(t_s, fallen, known & (t_s >= at_s))
    if before is None or after is None:
        return None
    return Scalar(after.value - before.value, float(np.hypot(before.error, after.error)))


def _gravity(t_s: Array, fallen: Array, rows: BoolArray) -> Scalar | None:
    """Return the weighted mean of the gravity (m/s^2) read in the windows of some rows (n,), and its standard error."""
    at = np.flatnonzero(rows)
    if at.size < LEAST_INTERVALS:
        return None
    windows = max(round(float(np.ptp(t_s[at])) / WINDOW_S), 1)
    parts = [part for part in np.array_split(at, windows) if part.size >= LEAST_INTERVALS]
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
    """Return the size of the slope (m/s^2) of velocities (n, 3) at times (n,), and its error, with Cauchy weights."""
    weight = np.ones(len(t_s))
    for _ in range(ITERATIONS):
        share = weight / weight.sum()
        since_s, apart = t_s - share @ t_s, fallen - share @ fallen
        moment = weight * since_s
        slope = moment @ apart / float(moment @ since_s)
        residual = apart - since_s[:, None] * slope
        sigma = np.maximum(MAD_TO_SIGMA * np.median(np.abs(residual), axis=0), 1e-9)
        weight = 1.0 / (1.0 + np.sum((residual / sigma) ** 2, axis=1) / (3.0 * CAUCHY_SIGMAS**2))
    size = float(np.linalg.norm(slope))
    error = float(np.linalg.norm(sigma * slope / max(size, 1e-9)))
    return size, error / float(np.sqrt(np.sum(since_s**2)))


FAULT = Fault(
    "accelerometer-change",
    "an accelerometer that reads another gravity from some time on",
    check,
    after=("accelerometer-axes", "disagreement", "gyro-bias", "correlated-tracks"),
)
