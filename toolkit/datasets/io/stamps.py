"""Time stamps in seconds as nanoseconds, with the mistakes of unit that files make named as such."""

from pathlib import Path

import numpy as np

from toolkit.errors import DataError
from toolkit.geometry import Array, IntArray
from toolkit.resampling import NS_PER_S

# No recording lies beyond the year 5000, nor has a sample only every half minute.
_LATEST_S = 1e11
_LONGEST_STEP_S = 30.0
_UNITS = (
    (1e-9, "nanoseconds: divide by 1e9"),
    (1e-6, "microseconds: divide by 1e6"),
    (1e-3, "milliseconds: divide by 1e3"),
)


def stamps_ns(path: Path, key: str, stamps_s: Array) -> IntArray:
    """Return stamps (N,) given in seconds as int64 nanoseconds.

    Raises DataError naming the first stamp that is not finite, or the unit the stamps are probably in. The
    order is not checked: a recording may be repaired.
    """
    bad = np.flatnonzero(~np.isfinite(stamps_s))
    if bad.size:
        raise DataError(f"{path}: {key}[{bad[0]}] is {stamps_s[bad[0]]} ({bad.size} such stamps); remove these samples")
    unit = probable_unit(stamps_s)
    if unit is not None:
        raise DataError(f"{path}: {key} must be in seconds, but the stamps look like {unit}")
    return np.rint(stamps_s * NS_PER_S).astype(np.int64)


def probable_unit(stamps_s: Array) -> str | None:
    """Return the unit, with its remedy, that stamps (N,) are probably in, or None where seconds are plausible."""
    largest = float(np.abs(stamps_s).max(initial=0.0))
    step = float(np.median(np.abs(np.diff(stamps_s)))) if stamps_s.size > 1 else 0.0
    if largest < _LATEST_S and step < _LONGEST_STEP_S:
        return None
    # Absolute stamps tell their unit by their size (the epoch began 1.3e9 to 1.8e9 s ago), relative ones by their step.
    for scale, name in _UNITS:
        if largest * scale > 1e8 or step * scale > 1e-3:
            return name
    return _UNITS[-1][1]
