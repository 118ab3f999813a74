"""Finds poses whose axes are exchanged or have the wrong sign: exchanged columns in a file, a left-handed world.

Positions that fit the truth's far better after a reflection are mirrored; those that fit, with orientations that are
off by one constant turn, are in other axes than these. The signed permutations are tried: with one of them, and no
other that is as simple, both fit. The fit is Kabsch's, "A solution for the best rotation to relate two sets of vectors"
(1976), without its rotations' handedness where a reflection is allowed.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from itertools import permutations, product
from typing import Literal

import numpy as np

from toolkit.errors import DataError
from toolkit.geometry import Array, nearest_rotation, se3, se3_inverse, so3_log

Struck = Literal["positions alone", "positions and quaternions", "the whole world"]
# Largest errors of a fit: positions in shares of their extent, orientations by an angle. Estimates with more drift are
# not judged.
_FITTING_SHARE, _FITTING_RAD = 0.1, np.deg2rad(10.0)
# As given, positions must have this many times the error under the exchange, and an error above this share of their
# extent ...
_TIMES, _LEAST_SHARE = 3.0, 0.01
# ... or orientations an error above this angle. A path on a line determines neither.
_WRONG_RAD, _LEAST_SIDEWAYS = np.deg2rad(30.0), 0.05
_FEWEST = 10
# Number of poses, evenly spread, that are compared.
_ENOUGH = 500
_NAMES = "xyz"


@dataclass(frozen=True, eq=False)
class Exchange:
    """A signed permutation (3, 3) of axes, and what it has struck."""

    matrix: Array
    struck: Struck

    def reread(self, T_world_body: Array) -> Array:
        """Return poses (n, 4, 4) with the axes set right; an exchange of two undoes itself.

        A quaternion whose three columns are permuted turns about the permuted axis; where that is a reflection, by the
        opposite angle.
        """
        rotations, positions = T_world_body[:, :3, :3], T_world_body[:, :3, 3] @ self.matrix.T
        if self.struck == "positions alone":
            return se3(rotations, positions)
        turned = self.matrix @ rotations @ self.matrix.T
        inverted = self.struck == "positions and quaternions" and np.linalg.det(self.matrix) < 0.0
        return se3(np.swapaxes(turned, 1, 2) if inverted else turned, positions)

    @property
    def description(self) -> str:
        """Say what must be done to the axes: "y and z exchanged (positions alone)"."""
        order = np.abs(self.matrix).argmax(axis=1)
        moved = [axis for axis in range(3) if order[axis] != axis]
        turned = [_NAMES[axis] for axis in range(3) if self.matrix[axis].sum() < 0.0]
        changes = []
        if len(moved) == 2:
            changes.append(f"{_NAMES[moved[0]]} and {_NAMES[moved[1]]} exchanged")
        elif moved:
            changes.append(f"x, y and z read from the columns {', '.join(_NAMES[axis] for axis in order)}")
        if turned:
            changes.append(f"the sign of {' and '.join(turned)} changed")
        return f"{' and '.join(changes)} ({self.struck})"


@cache
def exchanges() -> tuple[Exchange, ...]:
    """Return all signed permutations but the identity, the simplest first."""
    found = []
    for order, signs in product(permutations(range(3)), product((1.0, -1.0), repeat=3)):
        matrix = np.diag(signs) @ np.eye(3)[list(order)]
        moved = sum(axis != place for place, axis in enumerate(order)) + 1.5 * sum(sign < 0.0 for sign in signs)
        found += [(moved, Exchange(matrix, struck)) for struck in _struck(matrix)] if moved else []
    return tuple(exchange for _, exchange in sorted(found, key=lambda one: one[0]))


def _struck(matrix: Array) -> Iterator[Struck]:
    yield "positions alone"
    yield "positions and quaternions"
    if np.linalg.det(matrix) < 0.0:
        yield "the whole world"


def check_mirrored(what: str, truth: Array, estimate: Array) -> None:
    """Raise DataError where positions of poses (n, 4, 4) fit the truth's (n, 4, 4), of the same times, mirrored alone.

    The effect of a reflection on orientations resembles other mistakes in them, so it is checked first.
    """
    fit = _fit(truth, estimate)
    if fit is not None and fit.is_mirrored:
        raise _refused(what, _named(fit) or "its positions mirrored")


def check_axes(what: str, truth: Array, estimate: Array) -> None:
    """Raise DataError where poses (n, 4, 4) fit the truth's (n, 4, 4), of the same times, in exchanged axes alone."""
    found = exchanged(truth, estimate)
    if found is not None:
        raise _refused(what, found)


def exchanged(truth: Array, estimate: Array) -> str | None:
    """Say under which exchange of axes alone poses fit the truth's; None where they do as given, or under none."""
    fit = _fit(truth, estimate)
    if fit is None:
        return None
    if fit.is_mirrored:
        return _named(fit) or "its positions mirrored"
    if not fit.turns or fit.turned_rad(_AS_GIVEN) < _WRONG_RAD or fit.is_other_body:
        return None
    return _named(fit)


def _refused(what: str, found: str) -> DataError:
    return DataError(
        f"{what}: it fits the truth with {found}, and not as given; one of the two is written in other axes than it is "
        "read in: write both in the same"
    )


def _fit(truth: Array, estimate: Array) -> "_Fit | None":
    """Return the fit of poses (n, 4, 4); None where they are few, on a line, or near the truth in no axes."""
    finite = np.isfinite(truth).all(axis=(1, 2)) & np.isfinite(estimate).all(axis=(1, 2))
    rows = np.flatnonzero(finite)[:: 1 + len(truth) // _ENOUGH]
    if rows.size < _FEWEST:
        return None
    fit = _Fit(truth[rows], estimate[rows])
    return fit if fit.is_determined and fit.is_near else None


def _named(fit: "_Fit") -> str | None:
    """Name the simplest exchange under which positions and orientations fit, these far better than as given."""
    inverse = fit.of_inverse()
    if inverse.is_near and not inverse.is_mirrored and inverse.turned_rad(_AS_GIVEN) < _FITTING_RAD:
        return "each pose inverted"
    if not fit.turns:
        return None
    least_rad = min(_FITTING_RAD, fit.turned_rad(_AS_GIVEN) / _TIMES)
    fitting = (one for one in exchanges() if fit.off_share(one.matrix) < _FITTING_SHARE)
    return next((one.description for one in fitting if fit.turned_rad(one) < least_rad), None)


_AS_GIVEN = Exchange(np.eye(3), "positions alone")


class _Fit:
    """Poses (n, 4, 4) against the truth's, positions laid over each other under any exchange of their axes."""

    def __init__(self, truth: Array, estimate: Array) -> None:
        y, x = (poses[:, :3, 3] - poses[:, :3, 3].mean(axis=0) for poses in (truth, estimate))
        self._truth, self._estimate = truth, estimate
        self._variance = float((y**2).sum() + (x**2).sum()) / len(y)
        self._extent = float(np.sqrt((y**2).sum() / len(y)))
        self._covariance = y.T @ x / len(y)

    @property
    def is_determined(self) -> bool:
        """Say whether the positions leave a line."""
        _, overlaps = nearest_rotation(self._covariance)
        return bool(self._extent > 0.0 and overlaps[1] > _LEAST_SIDEWAYS**2 * overlaps[0])

    @property
    def is_near(self) -> bool:
        """Say whether the positions fit as given, or mirrored."""
        return min(self.off_share(np.eye(3)), self.off_share(-np.eye(3))) < _FITTING_SHARE

    @property
    def is_mirrored(self) -> bool:
        """Say whether the positions fit far better after a reflection."""
        return bool(self.off_share(np.eye(3)) > max(_TIMES * self.off_share(-np.eye(3)), _LEAST_SHARE))

    def of_inverse(self) -> "_Fit":
        """Return the fit of the inverse poses."""
        return _Fit(self._truth, se3_inverse(self._estimate))

    @property
    def turns(self) -> bool:
        """Say whether both have orientations that change."""
        return all(_spread_rad(poses[:, :3, :3]) > _FITTING_RAD for poses in (self._truth, self._estimate))

    @property
    def is_other_body(self) -> bool:
        """Say whether the orientations differ by a constant turn of the body, as a camera's from an IMU's do."""
        R_truth_estimate = self._rotation(np.eye(3)) @ self._estimate[:, :3, :3]
        return bool(_spread_rad(np.swapaxes(self._truth[:, :3, :3], 1, 2) @ R_truth_estimate) < _FITTING_RAD)

    def off_share(self, matrix: Array) -> float:
        """Return how far positions whose axes are exchanged are off the truth's, of the truth's extent."""
        _, overlaps = nearest_rotation(self._covariance @ matrix.T)
        squared = self._variance - 2.0 * float(overlaps.sum())
        return float(np.sqrt(max(squared, 0.0))) / self._extent

    def turned_rad(self, exchange: Exchange) -> float:
        """Return the median angle between the truth's orientations and those under an exchange."""
        R_world_body = exchange.reread(self._estimate)[:, :3, :3]
        off = self._rotation(exchange.matrix) @ R_world_body @ np.swapaxes(self._truth[:, :3, :3], 1, 2)
        return float(np.median(np.linalg.norm(so3_log(off), axis=1)))

    def _rotation(self, matrix: Array) -> Array:
        return nearest_rotation(self._covariance @ matrix.T)[0]


def _spread_rad(rotations: Array) -> float:
    """Return the median angle of rotations (n, 3, 3) from their mean (the nearest rotation to the mean matrix)."""
    mean, _ = nearest_rotation(rotations.mean(axis=0))
    return float(np.median(np.linalg.norm(so3_log(mean.T @ rotations), axis=1)))
