"""Which convention the covariances of a file are in: how each reading fits the errors, and the estimate's own motion.

Readings differ by orthogonal matrices and by adjoints, whose determinants are 1, so that of normal errors the likeliest
reading is the one with the least NEES. The errors of a run are few independent ones, though, and need not be those that
are stated. So it is asked as well how much the covariances change from pose to pose: the error T exp(xi) of one pose is
T exp(Ad xi) of the next, Ad being that of the motion back, so that in the right reading what remains is what the motion
adds and what is measured. A constant factor on all covariances changes nothing in that.
"""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace

import numpy as np

from toolkit.datasets.trajectories.covariances import CONVENTIONS, StatedCovariances
from toolkit.geometry import Array, se3_adjoint, se3_inverse, transposed
from toolkit.metrics.parts.consistency import StatedErrors, nees_of
from toolkit.metrics.parts.scores import Unavailable

# The errors of an estimate, with covariances (N, d, d) of all its poses as one reading has them.
Errors = Callable[[Array], StatedErrors]

# A reading is wrong where another has a median NEES this many times smaller: of one that is near 1 itself, or of any.
# Of consistent filters on simulated flights and drives another reading was better by 1.25 at most, by chance.
_TIMES, _NEAR, _TIMES_ANY = 2.0, 3.0, 10.0
# Readings that are told as well as the best one, where that is near 1.
_ALIKE = 1.5
# A reading is wrong where in another one the covariances change this many times less. Of 288 files that stated theirs
# rightly none had another in which they change less by more than 0.2 % (docs/conventions.md).
_STEADIER = 1.25
# The change is the median over so many poses, spread over the file.
_FEWEST_POSES, _MOST_POSES = 10, 1000
# In these a covariance that is the same in each line, whatever it means, does not change at all.
_STATIC = frozenset(name for name, convention in CONVENTIONS.items() if convention.perturbation == "left")


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


def change_under_each(stated: StatedCovariances, T_world_imu: Array) -> Mapping[str, float]:
    """Return by how much covariances (N, d, d) at poses (N, 4, 4) change from pose to pose under each convention.

    That is the median distance of a pose's to the one carried on from the pose before, the root of the sum of ln^2 of
    their generalised eigenvalues (Foerstner & Moonen, "A metric for covariance matrices", 1999). Empty where few poses
    in succession state the whole covariance, and one that is positive definite.
    """
    whole = np.asarray(np.isfinite(stated.values[:, :6, :6]).all(axis=(1, 2)))
    pairs = np.flatnonzero(whole[:-1] & whole[1:])
    pairs = pairs[np.unique(np.linspace(0, pairs.size - 1, min(pairs.size, _MOST_POSES)).astype(int))]
    own = stated.values[np.stack([pairs, pairs + 1]), :6, :6]
    definite = (np.linalg.eigvalsh(own)[..., 0] > 0.0).all(axis=0)
    if definite.sum() < _FEWEST_POSES:
        return {}
    before, after = (replace(stated, values=values[definite]) for values in own)
    T_world_before, T_world_after = T_world_imu[pairs[definite]], T_world_imu[pairs[definite] + 1]
    onward = se3_adjoint(se3_inverse(T_world_after) @ T_world_before)
    found = {}
    for name, convention in CONVENTIONS.items():
        carried = onward @ before.read_as(convention, T_world_before) @ transposed(onward)
        ratios = np.abs(np.linalg.eigvals(np.linalg.solve(carried, after.read_as(convention, T_world_after))))
        found[name] = float(np.median(np.sqrt(np.sum(np.log(ratios) ** 2, axis=1))))
    return found


def likelier_reading(stated: StatedCovariances, T_world_imu: Array, errors: Errors) -> str:
    """Say under which conventions the covariances fit, where theirs does not fit as well as any, or none is stated."""
    under = nees_under_each(stated, T_world_imu, errors)
    if not under:
        return ""
    change = change_under_each(stated, T_world_imu)
    least, steady = min(under.values()), _steady(change)
    is_near = least <= _NEAR
    fitting = [name for name, value in under.items() if value <= (_ALIKE if is_near else _TIMES_ANY) * least]
    likely = [name for name in fitting if name in steady] or steady or fitting
    told = f"median NEES of the pose under each convention: {_listed(under.items())}"
    if stated.convention is None:
        return f"the truth fits them best as {' or '.join(likely)} ({told})"
    said = stated.convention.name
    fits = under.get(said, np.inf) < (_TIMES if is_near else _TIMES_ANY) * least
    if said in steady or (fits and not steady):
        return ""
    how = "follow the motion" if fits or likely[0] not in fitting else "fit the errors"
    told += f"; change from pose to pose: {_listed(change.items())}" if steady else ""
    return (
        f"the covariances are said to be {said} and {how} only as {' or '.join(likely)}: correct its header or, where "
        f"it names none, --cov-convention ({told})"
    )


def _steady(change: Mapping[str, float]) -> list[str]:
    """Return the readings under which covariances change the least; none where they do not follow the motion.

    They do not where they change as little if they are taken for those that no motion changes: constant ones, and those
    of a filter that anchors each pose anew, whatever they are called.
    """
    least = min(change.values(), default=0.0)
    steady = [name for name, value in change.items() if value < _STEADIER * least]
    return [] if _STATIC & set(steady) else steady


def _listed(values: Iterable[tuple[str, float]]) -> str:
    return ", ".join(f"{name} {value:.3g}" for name, value in values)
