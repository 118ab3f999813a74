"""Intrinsics that do not fit the pixels: a principal point outside the sightings, a focal length that no lens has.

Suspects are found from the range of the sightings. They are reported only where ordinary values let the tracks follow
one rigid motion of the camera better. The motion samples are not used.
"""

from dataclasses import replace
from typing import Any

import numpy as np

from toolkit.audit.fault import Evidence, Fault, Symptom
from toolkit.audit.parts.intervals import LEAST_INTERVALS
from toolkit.audit.parts.one_step import own_one_step_px
from toolkit.geometry import Array
from toolkit.models.camera_motion import CameraMotion, camera_motion
from toolkit.sequence import Sequence, StereoRig, is_measured

# Quantiles of the sightings that are taken as their range: tracks may slide out of the image.
RANGE = (0.005, 0.995)
# Limits of the range over the focal length: 2 is a view of 90 degrees, 12 one of 161 degrees, 0.02 one of 1 degree.
WIDEST, NARROWEST = 12.0, 0.02
# Coordinates in pixels exceed this value, normalised ones (in multiples of the focal length) do not.
NORMALISED = 10.0
# A usual range over the focal length, also the least factor between two sizes of an image; and the largest ratio of the
# factors of width and height for one change of size.
USUAL, ALIKE = 1.5, 1.3
# Least share by which other intrinsics must lower the tracks' residual. A principal point that is wrong by half the
# view gives 0.15 and more.
LEAST_GAIN = 0.05
TRIED_FRAMES = 300
# Where the principal point is farther than this share of the range from the middle of the sightings, the middle is
# tried.
MOST_OFF_MIDDLE = 0.2
# Largest ratio of fy and fx in either direction: pixels are square unless an image was rescaled.
MOST_STRETCHED = 1.5


def check(evidence: Evidence) -> Symptom | None:
    """Report the intrinsics that contradict the sightings; the true ones are not in the data, so there is no repair."""
    sequence = evidence.sequence
    uv_px = sequence.observations.uv_px
    if len(uv_px) < LEAST_INTERVALS or not is_measured(uv_px).all():
        return None
    low, high = np.quantile(uv_px[:, [0, 2]], RANGE, axis=0)
    if np.abs([low, high]).max() < NORMALISED and sequence.rig.fx_px > NORMALISED:
        return _normalised(sequence.rig, low, high)
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
    return Symptom(
        count=len(faults),
        detail=(
            f"{'; '.join(summary for _, summary in faults)}: the tracks' residuals against the best-fitting camera "
            f"motion are {given_px:.2f} px, and {other_px:.2f} px with typical values"
        ),
        treatment="the true values are not in the data: correct K, or the pixels",
        remedy=None,
        spoils_vision=True,
    )


def _normalised(rig: StereoRig, low: Array, high: Array) -> Symptom:
    """Report sightings in normalised image coordinates, x / z and y / z of a point, instead of pixels."""
    u, v = (f"{a:.2g} to {b:.2g}" for a, b in zip(low, high, strict=True))
    return Symptom(
        count=1,
        detail=f"the sightings, u {u} and v {v}, are not pixels of fx_px = {rig.fx_px:g}: normalised image coordinates",
        treatment="write fx_px u + cx_px and fy_px v + cy_px for them",
        remedy=None,
        spoils_vision=True,
    )


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
    names = ("fx_px", "fy_px", "cx_px", "cy_px")
    summary = (
        f"K with (cx_px, cy_px) = ({rig.cx_px:.0f}, {rig.cy_px:.0f}) looks like that of images of {1.0 / factor:.2g}"
    )
    return {
        name: factor * getattr(rig, name) for name in names
    }, f"{summary} times the size of those the sightings are in"


def _own_px(sequence: Sequence, camera: CameraMotion) -> float:
    """Return the median residual (px) under the camera's own best motion; infinite where there is none."""
    own_px = own_one_step_px(sequence, camera)
    return own_px if np.isfinite(own_px) else np.inf


FAULT = Fault(
    "intrinsics",
    "a principal point or a focal length that is inconsistent with the sightings",
    check,
    after=("swapped-coordinates", "no-disparity", "time-order", "stale-frames", "doubled-disparity"),
)
