"""A constant difference of vision and odometry beyond chance, and within what slip causes in sound recordings.

Tyres, slip and pitch give odometry a scale and a direction of its own. Where these differ from vision's by as much as
in sound drives, the data do not show whether the calibration or the wheels are wrong. The difference is significant all
the same, and no estimator's covariance accounts for it.
"""

import numpy as np

from toolkit.audit.fault import Evidence, Fault, Symptom
from toolkit.audit.parts.alignment import LARGEST_SCALE_ERROR, SYSTEMATIC_SCALE
from toolkit.audit.parts.extrinsic import SYSTEMATIC_RAD, angle_of, turn_by_velocities
from toolkit.audit.parts.one_step import errors_are_independent

# Excess beyond chance (a share, rad) that tracks which drift from image to image cause in simulations without slip.
SCALE_BY_TRACK_DRIFT, TURN_BY_TRACK_DRIFT_RAD = 0.005, 0.003


def check(evidence: Evidence) -> Symptom | None:
    """Report differences of scale and direction that are beyond chance and below the limits of a fault."""
    if evidence.intervals is None or evidence.sequence.motion_kind != "twist":
        return None
    differences = [one for one in (_scale(evidence), _direction(evidence)) if one is not None]
    if not differences:
        return None
    return Symptom.information(
        count=len(differences),
        detail=f"vision and odometry differ during the whole recording: {'; '.join(differences)}",
        treatment=(
            "a wrong focal length, baseline, principal point or wheel scale, or slip and pitch, which cause as much in "
            "recordings of cars without faults; by default estimators model none of these"
        ),
    )


def _scale(evidence: Evidence) -> str | None:
    found = evidence.alignment
    if found is None or found.scale.error > LARGEST_SCALE_ERROR or found.by_velocities is None:
        return None
    scale, error = found.scale
    beyond = abs(scale) - found.scale_by_chance
    if not 0.0 < beyond < SYSTEMATIC_SCALE["twist"] or not _exceeds_track_drift(evidence, beyond, SCALE_BY_TRACK_DRIFT):
        return None
    return (
        f"vision's steps are {100.0 * abs(scale):.1f} +- {100.0 * error:.1f} % "
        f"{'longer' if scale > 0.0 else 'shorter'} than the odometry's"
    )


def _direction(evidence: Evidence) -> str | None:
    found = evidence.alignment
    if found is None or found.by_velocities is None:
        return None
    turn = turn_by_velocities(found.by_velocities)
    beyond_rad = float((np.abs(turn.rad) - turn.by_chance_rad).max())
    if not 0.0 < beyond_rad < SYSTEMATIC_RAD["twist"]:
        return None
    if not _exceeds_track_drift(evidence, beyond_rad, TURN_BY_TRACK_DRIFT_RAD):
        return None
    angle, error = angle_of(turn)
    return (
        f"the camera moves at an angle of {angle:.3f} +- {error:.3f} rad to the velocities, equivalent to "
        f"{angle * evidence.sequence.rig.fx_px:.0f} px of the principal point"
    )


def _exceeds_track_drift(evidence: Evidence, beyond: float, by_track_drift: float) -> bool:
    """Say whether tracks that drift cannot cause the excess: it is larger, or the errors are independent."""
    return beyond > by_track_drift or errors_are_independent(evidence.step_correlation)


FAULT = Fault(
    "steady-difference",
    "vision and odometry that differ during the whole recording, by no more than slip causes without a fault",
    check,
    after=("accelerometer-axes", "disagreement", "correlated-tracks"),
)
