"""Frames whose stamps come unevenly while the images do not: transfer times, a busy computer, every other one late.

How far a camera goes and turns from one image to the next is in proportion to the time between them. Beside what it
does in the intervals around, an interval that is stamped longer has to show more motion; where it shows as much as any
other, the stamps do not tell when the images were taken. The tracks alone decide that.
"""

import numpy as np

from toolkit.audit.fault import Evidence, Fault, Symptom
from toolkit.audit.parts.intervals import LEAST_INTERVALS, is_comparable
from toolkit.audit.parts.robust import Scalar, slope
from toolkit.geometry import Array, BoolArray
from toolkit.jackknife import jackknife_error
from toolkit.resampling import NS_PER_S

# Steps whose root mean square off the usual one is less than this share of it harm nobody. Those of real drives are off
# by 1.3 % at most, which their cameras do not follow either; chosen with them in view.
LEAST_SHARE = 0.03
# The share of the steps' unevenness that the motion follows is 1 where stamps are right. It counts below a half by so
# many standard errors, of a jackknife.
SIGMAS, MOST_FOLLOWED = 5.0, 0.5
# Two steps together are as long as ever where every other frame is late. Of those of a recording that has lost frames,
# at most half of them, the shortest quarter has none missing.
UNHURT = 0.25
# The intervals beside one that show how the camera moves there.
BESIDE = (-2, -1, 1, 2)


def check(evidence: Evidence) -> Symptom | None:
    """Hold the unevenness of the frames' steps against that of the camera's."""
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
            f"the steps of the frames are off the usual one by {typical_ms:.2g} ms (median), and of that the camera's "
            f"motion follows {found.value:.2f} +- {found.error:.2f}, where it should follow all"
        ),
        treatment="images come more evenly than their stamps: stamp them when they are exposed",
    )


def _even_steps_s(step_s: Array) -> Array:
    """Return what the steps (K - 1,) are if images come evenly: multiples of a usual one, where frames were lost."""
    usual_s = 0.5 * float(np.quantile(step_s[1:] + step_s[:-1], UNHURT))
    for _ in range(2):
        steps = np.maximum(np.round(step_s / usual_s), 1.0)
        usual_s = float(step_s.sum() / steps.sum())
    return np.asarray(usual_s * steps)


def _followed(rates: Array, step_s: Array, even_s: Array, known: BoolArray) -> Scalar | None:
    """Return the share of the steps' unevenness that is in the camera's motion, from its rates (K - 1, 6).

    ``even_s`` (K - 1,) are the steps without it.

    None where too few intervals are known with those beside them.
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
    "frames whose stamps come unevenly while the images do not",
    check,
    after=("stale-frames", "time-gap", "intrinsics", "swapped-coordinates", "no-disparity", "doubled-disparity"),
)
