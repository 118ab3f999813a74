"""Odometry or depths whose scale changes during the recording: a tyre loses air, a gear or a focus is changed.

The ratio of the measured velocity to the camera's is computed in ten stretches of the recording. A step between two
stretches is reported where the scatter within the parts before and after does not explain it.
"""

import numpy as np
from scipy.special import stdtrit

from toolkit.audit.fault import Evidence, Fault, Symptom, Undecided
from toolkit.audit.parts.intervals import LEAST_INTERVALS
from toolkit.audit.parts.robust import Scalar, median_error
from toolkit.geometry import Array
from toolkit.jackknife import STRETCHES
from toolkit.resampling import NS_PER_S

# Level of significance of a step, over all places where it can be, and its least share: the sound drives at hand have
# 0.057 at most. Chosen with them in view.
LEVEL, SYSTEMATIC = 1e-3, 0.06
# Where only a step larger than this would be found, the finding is undecided and says so.
LARGEST_HIDDEN = 0.08
# Below this speed the camera is taken to stand, and its speed is noise.
STANDING_MPS = 0.05
# Either side of a step has at least so many stretches.
LEAST_STRETCHES = 2


def check(evidence: Evidence) -> Symptom | Undecided | None:
    """Find the step of the scale that is largest in its standard errors, and report it if it is beyond the limit."""
    if evidence.intervals is None:
        return evidence.blind
    intervals, T_imu_cam = evidence.intervals, evidence.sequence.rig.T_imu_cam
    if intervals.v_mps is None:
        return None  # an IMU has no speed to compare
    w_imu, seen = intervals.w_cam_radps @ T_imu_cam[:3, :3].T, intervals.v_cam_mps @ T_imu_cam[:3, :3].T
    measured, speed_mps = intervals.v_mps + np.cross(w_imu, T_imu_cam[:3, 3]), np.linalg.norm(seen, axis=1)
    fast = (speed_mps > STANDING_MPS) & (speed_mps >= 0.5 * np.median(speed_mps))
    if fast.sum() < LEAST_INTERVALS:
        return Undecided(f"too little motion: {int(fast.sum())} intervals show a scale, {LEAST_INTERVALS} are needed")
    ratio = np.sum(measured * seen, axis=1)[fast] / speed_mps[fast] ** 2
    after, step = _largest_step(ratio)
    level = LEVEL / (STRETCHES + 1 - 2 * LEAST_STRETCHES)
    sigmas = float(stdtrit(STRETCHES - 2, 1.0 - 0.5 * level))
    least = max(SYSTEMATIC, sigmas * step.error)
    if abs(step.value) < least:
        return _hidden(step, least + abs(step.value))
    frame = intervals.interval[fast][np.argmax(np.arange(len(ratio)) * STRETCHES // len(ratio) == after)]
    at_s = (evidence.sequence.frames_t_ns[frame] - evidence.sequence.frames_t_ns[0]) / NS_PER_S
    return Symptom.warning(
        count=1,
        detail=(
            f"from about {at_s:.0f} s on the odometry's speed relative to the camera's is "
            f"{100.0 * abs(step.value):.1f} +- {100.0 * step.error:.1f} % "
            f"{'higher' if step.value > 0.0 else 'lower'} than before"
        ),
        treatment="wheels, their scale or depths have changed: no constant scale corrects the recording",
    )


def _hidden(step: Scalar, hidden: float) -> Undecided | None:
    """Return the size of a step that variations of the scale may hide, where it is larger than LARGEST_HIDDEN."""
    if hidden < LARGEST_HIDDEN:
        return None
    wanders = f"by {100.0 * step.value:+.1f} +- {100.0 * step.error:.1f} %, as in drives without faults"
    return Undecided(
        f"the odometry's scale changes {wanders}: a step by less than {100.0 * hidden:.0f} % would not show"
    )


def _largest_step(ratio: Array) -> tuple[int, Scalar]:
    """Return the first stretch after the most significant step of ratios (n,) in time, and the size of the step."""
    stretch = np.arange(len(ratio)) * STRETCHES // len(ratio)
    level = np.array([np.median(ratio[stretch == k]) for k in range(STRETCHES)])
    own = np.array([median_error(ratio[stretch == k][:, None])[0] for k in range(STRETCHES)])
    steps = dict[int, Scalar]()
    for k in range(LEAST_STRETCHES, STRETCHES + 1 - LEAST_STRETCHES):
        parts = (level[:k], level[k:])
        scatter = sum(float(np.sum((part - part.mean()) ** 2)) for part in parts) / (STRETCHES - 2)
        variance = max(scatter, float(np.mean(own**2))) * (1.0 / k + 1.0 / (STRETCHES - k))
        steps[k] = Scalar(float(parts[1].mean() - parts[0].mean()), float(np.sqrt(variance)))
    best = max(steps, key=lambda k: abs(steps[k].value) / max(steps[k].error, 1e-12))
    return best, steps[best]


FAULT = Fault(
    "scale-change",
    "odometry whose scale relative to the camera changes during the recording",
    check,
    after=("disagreement",),
)
