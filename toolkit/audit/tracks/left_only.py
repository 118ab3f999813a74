"""Sightings by the left image alone: they are used as they are, and reported as information."""

from toolkit.audit.fault import Evidence, Fault, Symptom
from toolkit.sequence import is_left_only


def check(evidence: Evidence) -> Symptom | None:
    """Count the sightings without the right image; warn where there are no others, so that no point has a depth."""
    uv_px = evidence.sequence.observations.uv_px
    count = int(is_left_only(uv_px).sum())
    if count == 0:
        return None
    none_else = count == len(uv_px)
    return Symptom(
        count=count,
        detail=f"{count} of {len(uv_px)} sightings ({count / len(uv_px):.0%}) lack the right image",
        treatment="without any disparity, depths depend on the motion alone" if none_else else "used for uL and v",
        remedy=None,
        harmful=False,
        warns=none_else,
    )


FAULT = Fault(
    "left-only",
    "sightings that lack the right image",
    check,
    after=("not-finite", "swapped-coordinates", "no-disparity"),
)
