"""A truth by a clock that runs faster or slower than the frames': right in the middle, and ever farther off beyond.

What the camera and the truth turn by tells the pace, as it tells an offset (`truth_mismatch`). Positions do not: where
a vehicle goes evenly, a clock that is fast looks like a truth that is too long.
"""

from toolkit.audit.fault import Evidence, Fault, Symptom, Undecided

# Where the clocks must be farther apart than this (s) to show, it is said: half a metre of a drive.
LARGEST_S = 0.05


def check(evidence: Evidence) -> Symptom | Undecided | None:
    """Tell the pace of the truth's clock beside that of the frames."""
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
        treatment="stamp both by one clock: position errors hold the way that is gone in the time by which they part",
    )


def _unseen(apart_s: float) -> Undecided | None:
    if apart_s < LARGEST_S:
        return None
    hidden = f"one that is off by less than {apart_s:.2g} s would not show"
    if apart_s == float("inf"):
        hidden = "whether it is the frames' is unknown"
    return Undecided(f"too little change of rotation to tell the truth's clock: {hidden}")


FAULT = Fault(
    "truth-clock",
    "a truth by a clock that runs faster or slower than the frames'",
    check,
    after=("disagreement",),
)
