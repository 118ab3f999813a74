"""Rows of the left and the right image that may differ, in a file that has one for both.

In a pair that is not rectified, the rows of the right image differ from those of the left one. Files with both rows are
refused at reading where these differ, and the front end matches images along rows only. In a file with a single row for
both there is nothing to compare, and the effect of wrong rows looks like a wrong principal point.
"""

from toolkit.audit.fault import Evidence, Fault, Undecided
from toolkit.sequence import ONE_ROW_FOR_BOTH, is_left_only


def check(evidence: Evidence) -> Undecided | None:
    """Report that the rows cannot be compared where the recording has one row for both images."""
    sequence = evidence.sequence
    if ONE_ROW_FOR_BOTH not in sequence.provenance.facts or is_left_only(sequence.observations.uv_px).all():
        return None
    return Undecided(
        f"{ONE_ROW_FOR_BOTH}: whether left and right agree in rows, as rectified pairs do, cannot be checked"
    )


FAULT = Fault("unknown-rows", "rows of left and right image that may differ, in a file with one for both", check)
