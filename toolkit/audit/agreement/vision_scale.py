"""Steps of vision that are longer or shorter than the measured ones: disparities, baseline, focal length or wheels.

A relative error of all depths scales every step of the camera by the same factor. With odometry the velocities show it,
with an IMU the accelerations.
"""

import numpy as np

from toolkit.audit.fault import Evidence, Fault, Symptom, Undecided
from toolkit.audit.parts.alignment import LARGEST_SCALE_ERROR, SYSTEMATIC_SCALE
from toolkit.audit.parts.bundle import BASELINE
from toolkit.audit.parts.calibration_limits import hidden_baseline
from toolkit.audit.parts.ratios import MOST_RATIO

# Where only an error larger than this share would be found, the finding is undecided and says so.
LARGEST_HIDDEN = 0.08
# With odometry `steady_difference` reports a scale from chance on. Where chance is more than this share, the finding is
# undecided: an error of 2 % in all disparities makes the errors on `drive` six times as large.
LARGEST_CHANCE = 0.02
# The same limit with an IMU, where only vision determines the scale over the times at which the IMU's noise is large.
# It is about the drift of a stereo system with an IMU, one percent of the distance.
LARGEST_HIDDEN_BESIDE_IMU = 0.01


def check(evidence: Evidence) -> Symptom | Undecided | None:
    """Compare the camera's translation with the measured one; a ratio beyond MOST_RATIO is a `disagreement`."""
    if evidence.intervals is None:
        return evidence.blind
    kind, found = evidence.sequence.motion_kind, evidence.alignment
    known = found is not None and found.scale.error <= LARGEST_SCALE_ERROR
    least = np.inf if found is None else SYSTEMATIC_SCALE[kind] + found.scale_by_chance
    if found is None or not known or abs(found.scale.value) < least:
        return _unseen(evidence, least if known else np.inf)
    scale, error = found.scale
    if kind == "twist" and not 1.0 / MOST_RATIO < 1.0 + scale < MOST_RATIO:
        return None  # reported as a disagreement
    measured, causes = ("odometry's", ", or wheels: check K, the baseline and the unit of the samples")
    if kind == "imu":
        measured, causes = "IMU's", ": check K and the baseline"
    return Symptom.warning(
        count=1,
        detail=(
            f"vision's steps are {100.0 * abs(scale):.1f} +- {100.0 * error:.1f} % "
            f"{'longer' if scale > 0.0 else 'shorter'} than the {measured}"
        ),
        treatment=f"disparities, baseline or focal length are wrong{causes}",
    )


def _unseen(evidence: Evidence, least: float) -> Undecided | None:
    """Return the smallest error of the scale that would be found, where it is large.

    With an IMU it is that of the self-calibration, where there is one, else that of the regression.
    ``least`` is the limit of the regression's scale, infinite where the scale is not judged.
    """
    found, fitted = evidence.alignment, evidence.self_calibration
    if fitted is not None:
        hidden = hidden_baseline(fitted, "imu")
        if hidden < LARGEST_HIDDEN_BESIDE_IMU:
            return None
        factor = float(np.exp(fitted.value[BASELINE]))
        seen = (
            f"tracks and IMU fit a baseline {factor:.3f} +- {factor * fitted.error[BASELINE]:.3f} times the given one"
        )
        return Undecided(f"too little change of velocity: {seen}, and less than {100.0 * hidden:.1f} % would not show")
    if found is None:
        return Undecided("too little change of velocity: the scale of vision against the samples is unknown")
    scale, error = found.scale
    if not np.isfinite(least):
        share = 100.0 * (SYSTEMATIC_SCALE[evidence.sequence.motion_kind] + found.scale_by_chance)
        known = f"known to {100.0 * error:.0f} %, a fault of less than {share:.0f} % would not show"
        return Undecided(f"too little change of velocity: the scale of vision against the samples is {known}")
    if least + abs(scale) < LARGEST_HIDDEN:
        return _unseen_at_all(scale, error, found.scale_by_chance + abs(scale))
    known = f"vision's steps are off by {100.0 * scale:+.1f} +- {100.0 * error:.1f} %"
    hidden = least + abs(scale)
    return Undecided(
        f"{known}, as in recordings without faults: a fault of less than {100.0 * hidden:.0f} % would not show"
    )


def _unseen_at_all(scale: float, error: float, hidden: float) -> Undecided | None:
    """Return, with odometry, the scale below which not even `steady_difference` reports it, where it is large."""
    if hidden < LARGEST_CHANCE:
        return None
    known = f"vision's steps are off by {100.0 * scale:+.1f} +- {100.0 * error:.1f} %, within chance"
    return Undecided(f"{known}: a scale that is off by less than {100.0 * hidden:.1f} % would not show")


FAULT = Fault(
    "vision-scale",
    "steps of vision that are a few percent longer or shorter than the measured ones",
    check,
    after=("accelerometer-axes", "disagreement"),
)
