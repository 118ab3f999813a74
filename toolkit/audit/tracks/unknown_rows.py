"""Rows of the left and the right image that may differ, in a file that has one for both.

A pair that is not rectified has its right image's rows off the left one's. Files with both rows are refused when they
are read where these differ, and in images the front end matches along the rows alone; where one row is all there is,
nothing is left to compare, and what the wrong row bends looks like a principal point that is off.
"""

from toolkit.audit.fault import Evidence, Fault, Undecided
from toolkit.sequence import ONE_ROW_FOR_BOTH, is_left_only


def check(evidence: Evidence) -> Undecided | None:
    """Say that the rows cannot be compared where the recording has one for both images."""
    sequence = evidence.sequence
    if ONE_ROW_FOR_BOTH not in sequence.provenance.facts or is_left_only(sequence.observations.uv_px).all():
        return None
    return Undecided(f"{ONE_ROW_FOR_BOTH}: that left and right agree in rows, as rectified pairs do, it does not show")


FAULT = Fault("unknown-rows", "rows of left and right that may differ, of a file that has one for both", check)
