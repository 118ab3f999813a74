"""Vision's steps that are longer or shorter than the measured ones: disparities, baseline, focal length or wheels.

A share of the depths scales every step of the camera. Odometry shows it in velocities, an IMU in accelerations.
"""

from toolkit.audit.disagreement import MOST_RATIO
from toolkit.audit.fault import Evidence, Fault, Symptom, Undecided

# A scale counts that is no chance, beyond what sound recordings at hand have: 0.044 +- 0.007 beside the odometry of
# cars, 0.028 +- 0.006 beside an IMU. Chosen with them in view.
SYSTEMATIC = {"twist": 0.03, "imu": 0.025}
# A scale that is known worse than this is not judged; where a fault must be larger than that to show, it is said.
LARGEST_ERROR, LARGEST_HIDDEN = 0.02, 0.08


def check(evidence: Evidence) -> Symptom | Undecided | None:
    """Compare the camera's translation with the measured one in size; what is beyond MOST_RATIO is a disagreement."""
    if evidence.intervals is None:
        return evidence.blind
    kind, found = evidence.sequence.motion_kind, evidence.alignment
    if found is None or found.scale.error > LARGEST_ERROR:
        known = "unknown"
        if found is not None:
            least = SYSTEMATIC[kind] + found.scale_by_chance
            known = f"known to {100.0 * found.scale.error:.0f} %, a fault of less than {100.0 * least:.0f} % would hide"
        return Undecided(f"too little change of velocity: the scale of vision against the samples is {known}")
    scale, error = found.scale
    least = SYSTEMATIC[kind] + found.scale_by_chance
    if kind == "twist" and not 1.0 / MOST_RATIO < 1.0 + scale < MOST_RATIO:
        return None  # a disagreement, and told as such
    if abs(scale) < least:
        return _hidden(scale, error, least + abs(scale))
    measured, causes = ("odometry's", ", or wheels: check K, the baseline and the unit of the samples")
    if kind == "imu":
        measured, causes = "IMU's", ": check K and the baseline"
    return Symptom.warning(
        count=1,
        detail=(
            f"vision's steps are {100.0 * abs(scale):.1f} +- {100.0 * error:.1f} % "
            f"{'longer' if scale > 0.0 else 'shorter'} than the {measured}"
        ),
        treatment=f"disparities, baseline or focal length are off{causes}",
    )


def _hidden(scale: float, error: float, hidden: float) -> Undecided | None:
    """Say how large a fault the scale may hide that is found, where that is much."""
    if hidden < LARGEST_HIDDEN:
        return None
    known = f"vision's steps are off by {100.0 * scale:+.1f} +- {100.0 * error:.1f} %"
    return Undecided(f"{known}, as in sound recordings: a fault of less than {100.0 * hidden:.0f} % would not show")


FAULT = Fault(
    "vision-scale",
    "steps of vision that are a few percent longer or shorter than the measured ones",
    check,
    after=("accelerometer-axes", "disagreement"),
)
