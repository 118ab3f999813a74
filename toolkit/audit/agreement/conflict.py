"""Seconds during which vision and the measured motion disagree: many moving objects, or samples that are wrong.

Most of the points in view may move with the traffic, wheels may slip, an IMU may be shaken: then the two tell
different motions for as long as it lasts, and no estimator can know which one is right. Nothing is repaired.
"""

import numpy as np

from toolkit.audit.fault import Evidence, Fault, Symptom, Undecided
from toolkit.audit.parts.deviations import Deviation, Span, deviations, sustained
from toolkit.resampling import NS_PER_S

# A mean counts from so many of its standard deviations on; the largest of a sound recording has 3 to 9.
SIGMAS = 10.0
# The smallest deviation that counts, by what deviates: sound recordings at hand have 0.05 rad/s, a tenth of the speed
# where wheels slip or depths are off, and 0.4 m/s^2.
LEAST = {"rate of rotation": 0.06, "velocity": 0.2, "specific force": 0.5}
LEAST_OF_SPEED = 0.1


def check(evidence: Evidence) -> Symptom | Undecided | None:
    """Name the times at which what the samples and the camera say differs for seconds, and by how much."""
    if evidence.intervals is None:
        return evidence.blind
    sequence, found = evidence.sequence, list[tuple[Deviation, Span]]()
    speed_mps = float(np.median(np.linalg.norm(evidence.intervals.v_cam_mps, axis=1)))
    fallen = evidence.fallen if sequence.motion_kind == "imu" else None
    for deviation in deviations(sequence, evidence.camera_motion, evidence.intervals, fallen):
        least = LEAST[deviation.what] + LEAST_OF_SPEED * speed_mps * (deviation.what == "velocity")
        found += [(deviation, span) for span in sustained(deviation, SIGMAS, least)]
    if not found:
        return None
    samples = "the IMU" if sequence.motion_kind == "imu" else "odometry"
    return Symptom.warning(
        count=len(found),
        detail=f"vision and {samples} disagree at {', '.join(_detail(*one) for one in sorted(found, key=_begin))}",
        treatment="moving objects or wrong samples: distrust every estimate from there on",
        spans_ns=tuple(_in_ns(span, int(sequence.frames_t_ns[0])) for _, span in found),
    )


def _begin(one: tuple[Deviation, Span]) -> float:
    return one[1].begin_s


def _in_ns(span: Span, first_ns: int) -> tuple[int, int]:
    return first_ns + round(span.begin_s * NS_PER_S), first_ns + round(span.end_s * NS_PER_S)


def _detail(deviation: Deviation, span: Span) -> str:
    return f"{span.begin_s:.0f}-{span.end_s:.0f} s (by {span.size:.2g} {deviation.unit} of {deviation.what})"


FAULT = Fault(
    "conflict",
    "vision and the measured motion disagree for seconds: moving objects or wrong samples",
    check,
    after=("accelerometer-axes", "disagreement", "gyro-bias"),
)
