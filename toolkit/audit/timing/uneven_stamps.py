"""Frames with uneven stamps of evenly taken images: transfer times, a busy computer, every other stamp late.

The motion of a camera from one image to the next is proportional to the time between them. An interval that is longer
by its stamps must show more motion than the intervals around it. Where it shows as much as these, the stamps are not
the times of the images. Only the tracks are used.
"""

import numpy as np

from toolkit.audit.fault import Evidence, Fault, Symptom
from toolkit.audit.parts.intervals import LEAST_INTERVALS, is_comparable
from toolkit.audit.parts.robust import Scalar, slope
from toolkit.geometry import Array, BoolArray
from toolkit.jackknife import jackknife_error
from toolkit.resampling import NS_PER_S

# Least root mean square of the steps' deviation, as a share of the usual step. Real drives have 1.3 % at most, which
# their cameras do not follow either; chosen with them in view.
LEAST_SHARE = 0.03
# The motion follows a share of 1 of the deviations if the stamps are right. The stamps are reported if the share is
# below the second number by so many standard errors, of a jackknife.
SIGMAS, MOST_FOLLOWED = 5.0, 0.5
# The usual step is half of this quantile of two steps together, which are even where every other frame is late. The
# shortest quarter misses no frame, in a recording that has lost half of its frames at most.
UNHURT = 0.25
# Offsets of the intervals around one that show how the camera moves there.
BESIDE = (-2, -1, 1, 2)


def check(evidence: Evidence) -> Symptom | None:
    """Regress the variation of the camera's motion on that of the frames' steps."""
    sequence, camera = evidence.sequence, evidence.camera_motion
    if evidence.spoilt_by or not is_comparable(sequence) or camera.known.sum() < LEAST_INTERVALS:
        return None
    step_s = np.diff(sequence.frames_t_ns) / NS_PER_S
    even_s = _even_steps_s(step_s)
    off_s = step_s - even_s
    if float(np.sqrt(np.mean(off_s[camera.known] ** 2))) < LEAST_SHARE * float(np.median(even_s)):
        return None
    found = _followed(np.hstack([camera.v_mps, camera.w_radps]), step_s, even_s, camera.known)
    if found is None or found.value + SIGMAS * found.error > MOST_FOLLOWED:
        return None
    typical_ms = 1e3 * float(np.median(np.abs(off_s)))
    return Symptom.warning(
        count=1,
        detail=(
            f"the intervals of the frames differ from the usual one by {typical_ms:.2g} ms (median), and the "
            f"camera's motion shows {found.value:.2f} +- {found.error:.2f} of these differences, where it should "
            "show all"
        ),
        treatment="images are taken at more even intervals than stamped: stamp them when they are exposed",
    )


def _even_steps_s(step_s: Array) -> Array:
    """Return the steps (K - 1,) of evenly taken images: multiples of the usual step, for frames may be lost."""
    usual_s = 0.5 * float(np.quantile(step_s[1:] + step_s[:-1], UNHURT))
    for _ in range(2):
        steps = np.maximum(np.round(step_s / usual_s), 1.0)
        usual_s = float(step_s.sum() / steps.sum())
    return np.asarray(usual_s * steps)


def _followed(rates: Array, step_s: Array, even_s: Array, known: BoolArray) -> Scalar | None:
    """Return the share of the variation of the steps that the camera's motion follows, from its rates (K - 1, 6).

    ``even_s`` (K - 1,) are the steps without variation.

    None where the motion is known in too few intervals and those around them.
    """
    rows = np.arange(-BESIDE[0], step_s.size - BESIDE[-1])
    beside = rows[:, None] + np.array(BESIDE)
    usable = known[rows] & known[beside].all(axis=1)
    rows, beside = rows[usable], beside[usable]
    if rows.size < LEAST_INTERVALS:
        return None
    moved = rates * step_s[:, None]
    around = moved[beside].sum(axis=1) / step_s[beside].sum(axis=1)[:, None]
    regressor, response = around * (step_s - even_s)[rows, None], moved[rows] - around * even_s[rows, None]
    return Scalar(_share(regressor, response), jackknife_error(_share, regressor, response))


def _share(regressor: Array, response: Array) -> float:
    return slope(regressor, regressor, response).value


FAULT = Fault(
    "uneven-stamps",
    "frames whose stamps are uneven although the images were taken evenly",
    check,
    after=("stale-frames", "time-gap", "intrinsics", "swapped-coordinates", "no-disparity", "doubled-disparity"),
)
