"""A truth stamped by a clock that runs faster or slower than the frames', so that the clocks differ more and more.

The rate is estimated from the rotations of camera and truth, like an offset (`truth_mismatch`). Positions are not used:
at constant speed a fast clock looks like a wrong scale of the truth.
"""

from toolkit.audit.fault import Evidence, Fault, Symptom, Undecided

# Where only a difference of the clocks larger than this (s), half a metre of a drive, would be found, the finding is
# undecided.
LARGEST_S = 0.05


def check(evidence: Evidence) -> Symptom | Undecided | None:
    """Report the rate of the truth's clock relative to that of the frames."""
    if evidence.spoilt_by or evidence.sequence.truth is None:
        return None
    clock = evidence.truth_clock
    if clock is None:
        return None
    if clock.rate is None or not clock.runs_otherwise:
        return _unseen(clock.unseen_s)
    rate = clock.rate
    return Symptom.warning(
        count=1,
        detail=(
            f"the camera turns as the truth does when time passes {1.0 + rate.value:.4f} +- {rate.error:.4f} times as "
            "fast by the truth's stamps as by the frames'"
        ),
        treatment=(
            "stamp both by one clock: position errors include the distance moved in the time by which they differ"
        ),
    )


def _unseen(apart_s: float) -> Undecided | None:
    if apart_s < LARGEST_S:
        return None
    hidden = f"one that is off by less than {apart_s:.2g} s would not show"
    if apart_s == float("inf"):
        hidden = "whether it is the frames' is unknown"
    return Undecided(f"too little change of rotation to determine the truth's clock: {hidden}")


FAULT = Fault(
    "truth-clock",
    "a truth by a clock that runs faster or slower than the frames'",
    check,
    after=("disagreement",),
)
