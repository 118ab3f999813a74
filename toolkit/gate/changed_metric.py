"""Tell a metric that was changed from a trajectory that was: the same poses cannot have another error.

The median reprojection of withheld tracks, the errors of the positions and the NEES are all computed from the same
poses. Where one of them is the same to six digits under every seed, so are the poses, and whatever else moved by a
thousandth is computed otherwise than it was. A NEES alone may also move with the covariance: it is a witness of the
others, and never accused.
"""

from collections.abc import Mapping

import numpy as np

from toolkit.geometry import Array

Sides = tuple[Array, Array]

_STILL, _MOVED = 1e-6, 1e-3
_WITNESSES = {"ate_": ("heldout_", "nees_"), "rpe_": ("heldout_", "nees_"), "heldout_": ("ate_", "nees_")}


def changed_metrics(values: Mapping[str, Sides]) -> dict[str, str]:
    """Return the metrics of one output that were changed, each with the metric that says so.

    ``values`` are those before and now (n,) of each metric, under the seeds that both sides have.
    """
    found = {}
    for key, sides in values.items():
        families = next((given for family, given in _WITNESSES.items() if key.startswith(family)), ())
        witnesses = [other for other in values if other.startswith(families) and _is_still(values[other])]
        if families and witnesses and _has_moved(sides):
            found[key] = witnesses[0]
    return found


def _is_still(sides: Sides) -> bool:
    before, after = sides
    return bool(before.size) and bool(np.all(np.abs(after - before) <= _STILL * np.abs(before)))


def _has_moved(sides: Sides) -> bool:
    before, after = sides
    return bool(before.size) and float(np.median(np.abs(after - before) - _MOVED * np.abs(before))) > 0.0
