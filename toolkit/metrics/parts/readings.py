"""Which convention the covariances of a file are in, by the NEES that each reading of them gives against a truth.

Readings differ by orthogonal matrices and by adjoints, whose determinants are 1, so that of normal errors the likeliest
reading is the one with the least NEES.
"""

from collections.abc import Callable, Iterable, Mapping

import numpy as np

from toolkit.datasets.trajectories.covariances import CONVENTIONS, StatedCovariances
from toolkit.geometry import Array
from toolkit.metrics.parts.consistency import StatedErrors, nees_of
from toolkit.metrics.parts.scores import Unavailable

# The errors of an estimate, with covariances (N, d, d) of all its poses as one reading has them.
Errors = Callable[[Array], StatedErrors]

# A reading is wrong where another has a median NEES this many times smaller: of one that is near 1 itself, or of any.
# Of consistent filters on simulated flights and drives another reading was better by 1.25 at most, by chance.
_TIMES, _NEAR, _TIMES_ANY = 2.0, 3.0, 10.0
# Readings that are told as well as the best one.
_ALIKE = 1.5


def nees_under_each(stated: StatedCovariances, T_world_imu: Array, errors: Errors) -> Mapping[str, float]:
    """Return the median pose NEES over 6 under each convention, of covariances (N, d, d) at poses (N, 4, 4).

    Where the pose's own covariance is not stated, or no pose can be judged, it is empty.
    """
    found = {}
    for name, convention in CONVENTIONS.items():
        try:
            nees = nees_of(errors(stated.read_as(convention, T_world_imu)))
        except Unavailable:
            continue
        found[name] = float(np.median(nees.pose))
    return {name: value for name, value in found.items() if np.isfinite(value) and value > 0.0}


def likelier_reading(stated: StatedCovariances, T_world_imu: Array, errors: Errors) -> str:
    """Return in words under which conventions the covariances fit, where another than theirs, or none, is stated.

    Nothing where theirs fits as well as any.
    """
    under = nees_under_each(stated, T_world_imu, errors)
    if not under:
        return ""
    best = min(under.values())
    alike = " or ".join(name for name, value in under.items() if value <= _ALIKE * best)
    told = f"(median NEES of the pose under each convention: {_listed(under.items())})"
    if stated.convention is None:
        return f"the truth fits them best as {alike} {told}"
    own = under.get(stated.convention.name, np.inf)
    if own < (_TIMES if best <= _NEAR else _TIMES_ANY) * best:
        return ""
    fits = f"the covariances are said to be {stated.convention.name} and fit the errors only as {alike}"
    return f"{fits}: correct its header or, where it names none, --cov-convention {told}"


def _listed(values: Iterable[tuple[str, float]]) -> str:
    return ", ".join(f"{name} {value:.3g}" for name, value in values)
