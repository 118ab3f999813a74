"""Sightings that were rounded to whole pixels, to a simple part of one, or to half-precision numbers.

Rounding to steps of s adds errors of s / sqrt(12) to each coordinate (Bennett, "Spectra of quantized signals", 1948).
The depths of far points suffer most, because a disparity of a few pixels has few steps. Half-precision numbers have
steps of half a pixel above 512 px, and of a whole one above 1024 px.
"""

import numpy as np

from toolkit.audit.fault import Evidence, Fault, Symptom
from toolkit.geometry import Array

# Steps (px) that are tried. Smaller ones are not reported, because they add errors of less than 0.03 px.
STEPS_PX = (1.0, 0.5, 0.25, 0.2, 0.125, 0.1)
# Least number of sightings, and least share of rounded ones among the first so many (to look at the rest) and among
# all. In sound recordings at most an eighth of the coordinates are half-precision numbers by chance.
LEAST, SOME, NEARLY_ALL = 100, 0.9, 0.999
# Rounding is a warning from this share of the stated standard deviation on.
MOST_SHARE = 0.5


def check(evidence: Evidence) -> Symptom | None:
    """Report the steps of the coordinates, and what they add to the stated noise."""
    rig, uv_px = evidence.sequence.rig, evidence.sequence.observations.uv_px
    seen_px = uv_px[np.isfinite(uv_px).all(axis=1), :2]  # v may be the mean of two rows, with finer steps
    if len(seen_px) < LEAST:
        return None
    step_px, grid = _step_px(seen_px)
    if step_px is None:
        return None
    rounding_px, stated_px = step_px / np.sqrt(12.0), float(np.sqrt(rig.cov_uv_px2[0, 0]))
    return Symptom(
        count=len(seen_px),
        detail=f"{grid}: rounding adds errors of {rounding_px:.2g} px to the {stated_px:.2g} px stated for uL",
        treatment="write them with all the digits that the tracker has; depths of far points suffer most",
        remedy=None,
        harmful=False,
        warns=bool(rounding_px > MOST_SHARE * stated_px),
    )


def _step_px(uv_px: Array) -> tuple[float | None, str]:
    """Return the step (px) of coordinates (N, 2), and its description; None where there is none."""
    some_px = uv_px[:LEAST]  # enough to exclude it in most recordings
    for step_px in STEPS_PX:
        if _share_round(some_px, step_px) > SOME and _share_round(uv_px, step_px) > NEARLY_ALL:
            return step_px, f"uL and uR are multiples of {step_px:g} px"
    if _share_half(some_px) <= SOME or _share_half(uv_px) <= NEARLY_ALL:
        return None, ""
    step_px = float(np.spacing(np.float16(np.median(np.abs(uv_px[:, 0])))))
    return step_px, f"uL and uR are half-precision numbers, with steps of {step_px:g} px at the median uL"


def _share_round(uv_px: Array, step_px: float) -> float:
    """Return the share of coordinates that are multiples of a step."""
    steps = uv_px / step_px
    return float(np.mean(np.abs(steps - np.round(steps)) < 1e-4))


def _share_half(uv_px: Array) -> float:
    """Return the share of coordinates that are half-precision numbers."""
    with np.errstate(over="ignore"):
        return float(np.mean(uv_px.astype(np.float16) == uv_px))


FAULT = Fault(
    "coarse-pixels",
    "sightings rounded to whole pixels or parts of one, or written as half-precision numbers",
    check,
    after=("not-finite", "implausible", "no-sightings"),
)
