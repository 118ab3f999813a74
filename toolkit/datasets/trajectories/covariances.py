"""What the covariance of a pose means in a file: the order of its blocks, and which perturbation it is of.

A covariance belongs to a small error of a pose T = (R, p). Programs disagree on whether the rotation or the position
comes first, and on the error itself. The four that are in use differ by an adjoint, or by a turn of one block, exactly:
their derivatives at zero are here, once, for reading and for writing. Sources: GTSAM's math.pdf and Sola, Deray &
Atchuthan, "A micro Lie theory for state estimation in robotics" (2018), eqs. 30-31, 54-55 (right, left); the definition
of geometry_msgs/PoseWithCovariance (fixed); Geneva et al., "OpenVINS" (ICRA 2020) (mixed). The header of a file names
its convention, as does one of the SQUARE format of smfeval, whose triangle is the lower one.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, NamedTuple, get_args

import numpy as np

from toolkit.errors import DataError, no_such
from toolkit.geometry import Array, se3_adjoint, se3_inverse, transposed

Order = Literal["rot-pos", "pos-rot"]
Perturbation = Literal["right", "left", "fixed", "mixed"]
MEANINGS: Mapping[Perturbation, str] = {
    "right": "T exp(xi): both in the body frame",
    "left": "exp(xi) T: both in the world frame, turning about its origin",
    "fixed": "R <- exp(theta) R, p <- p + dp: turns about the axes of the world through the body, shifts in the world",
    "mixed": "R <- R exp(theta), p <- p + dp: turns about the axes of the body, shifts in the world",
}
_SAID = re.compile(r"cov-convention\s*[:=]?\s*([\w/-]+)")
_SQUARE_ORDER, _SQUARE_SIDE = re.compile(r"TANGENT_ORDER\s+(\w+)"), re.compile(r"TANGENT_CONVENTION\s+(\w+)_perturb")
# The rows of a state's covariance in a file: turn, position, velocity, gyro bias, accelerometer bias, three each; and
# where those of an Estimate's covariance stand there, by its size.
STATE = 15
_PLACES = {6: np.r_[0:6], 9: np.r_[0:6, 9:12], 12: np.r_[0:12], STATE: np.r_[0:9, 12:15, 9:12]}
_POSITION_FIRST = np.r_[3:6, 0:3]


class CovConvention(NamedTuple):
    """Which block comes first, and which perturbation a covariance is of (see ``MEANINGS``)."""

    order: Order
    perturbation: Perturbation

    @property
    def name(self) -> str:
        return f"{self.order}/{self.perturbation}"

    @property
    def words(self) -> str:
        blocks = "rotation (rad), position (m)" if self.order == "rot-pos" else "position (m), rotation (rad)"
        return f"cov-convention {self.name}: {blocks}; {MEANINGS[self.perturbation]}"


CONVENTIONS: Mapping[str, CovConvention] = {
    one.name: one for order in get_args(Order) for kind in MEANINGS if (one := CovConvention(order, kind))
}
# That of every Estimate, GTSAM's; of ROS; of OpenVINS.
OURS, ROS, OPENVINS = (CONVENTIONS[name] for name in ("rot-pos/right", "pos-rot/fixed", "rot-pos/mixed"))


def convention_called(name: str) -> CovConvention:
    """Return the convention of a name; raises DataError, with the nearest one, where there is none."""
    if name not in CONVENTIONS:
        raise DataError(no_such("convention of covariances", name, CONVENTIONS))
    return CONVENTIONS[name]


def said_in(header: str) -> tuple[CovConvention | None, bool]:
    """Return the convention that the header of a file names, if it does, and whether its triangle is the lower one.

    Raises DataError where it names one that there is not.
    """
    order, side, said = _SQUARE_ORDER.search(header), _SQUARE_SIDE.search(header), _SAID.search(header)
    if order and side:
        first = "pos-rot" if order[1].startswith("translation") else "rot-pos"
        return convention_called(f"{first}/{side[1]}"), True
    return (convention_called(said[1].rstrip(".,;:")) if said else None), False


def to_right(perturbation: Perturbation, T_world_imu: Array) -> Array:
    """Return the derivatives (N, 6, 6), at zero, of right perturbations of poses (N, 4, 4) by those of another kind.

    Both are in the order rotation, position. Those the other way are of the inverse poses.
    """
    R_imu_world = transposed(T_world_imu[:, :3, :3])
    if perturbation == "left":  # exp(xi) T = T exp(Ad(T^-1) xi)
        return se3_adjoint(se3_inverse(T_world_imu))
    jacobians = np.tile(np.eye(6), (len(T_world_imu), 1, 1))
    if perturbation != "right":
        jacobians[:, 3:, 3:] = R_imu_world
    if perturbation == "fixed":
        jacobians[:, :3, :3] = R_imu_world
    return jacobians


@dataclass(frozen=True, eq=False)
class StatedCovariances:
    """Covariances (N, d, d) as a file has them: d = 6, or 15 of the whole state; NaN where an entry is not stated.

    ``convention`` is None where neither the file nor the user says it.
    """

    values: Array
    convention: CovConvention | None

    def read_as(self, convention: CovConvention, T_world_imu: Array) -> Array:
        """Return them as an Estimate has them (N, d, d) if their convention is this one, at poses (N, 4, 4).

        Rows of a state that is known in part are left out: d is 6, 9, 12 or 15.
        """
        own = self.values
        if convention.order == "pos-rot":
            places = np.r_[_POSITION_FIRST, 6 : own.shape[-1]]
            own = own[:, places[:, None], places]
        moved = _moved(own, to_right(convention.perturbation, T_world_imu), transposed(T_world_imu[:, :3, :3]))
        if own.shape[-1] != STATE:
            return moved
        known = np.isfinite(np.einsum("nii->ni", moved)).any(axis=0)[6::3]
        size = 6 if not known[1] else (STATE if known[2] else (12 if known[0] else 9))
        return moved[:, _PLACES[size][:, None], _PLACES[size]]

    def of(self, T_world_imu: Array) -> Array | None:
        """Return them as an Estimate has them, None where their convention is not known."""
        return None if self.convention is None else self.read_as(self.convention, T_world_imu)


def written_as(convention: CovConvention, T_world_imu: Array, cov: Array, size: int) -> Array:
    """Return covariances (N, d, d) of an Estimate at poses (N, 4, 4) as a file has them, (N, size, size).

    ``size`` is 6, the pose, or 15, the state, where rows that d does not have are NaN. The inverse of ``read_as``.
    """
    d = 6 if size == 6 else cov.shape[-1]
    own = np.full((len(cov), size, size), np.nan)
    own[:, _PLACES[d][:, None], _PLACES[d]] = cov[:, :d, :d]
    moved = _moved(own, to_right(convention.perturbation, se3_inverse(T_world_imu)), T_world_imu[:, :3, :3])
    places = np.r_[_POSITION_FIRST, 6:size] if convention.order == "pos-rot" else np.arange(size)
    return moved[:, places[:, None], places]


def _moved(values: Array, of_pose: Array, of_velocity: Array) -> Array:
    """Return J P J^T, J being of the pose (N, 6, 6), of the velocity (N, 3, 3), and of biases the identity.

    What depends on an entry that is not stated is NaN.
    """
    jacobians = np.tile(np.eye(values.shape[-1]), (len(values), 1, 1))
    jacobians[:, :6, :6] = of_pose
    if values.shape[-1] > 6:
        jacobians[:, 6:9, 6:9] = of_velocity
    unknown = ~np.isfinite(values)
    moved: Array = jacobians @ np.where(unknown, 0.0, values) @ transposed(jacobians)
    if unknown.any():
        touches = (jacobians != 0.0).astype(float)
        moved[touches @ unknown.astype(float) @ transposed(touches) > 0.0] = np.nan
    return moved


def from_triangle(entries: Array, *, lower: bool = False) -> Array:
    """Return symmetric matrices (N, d, d) of their upper, or lower, triangles (N, d (d + 1) / 2), row by row."""
    size = round((np.sqrt(8 * entries.shape[-1] + 1) - 1) / 2)
    rows, columns = np.tril_indices(size) if lower else np.triu_indices(size)
    matrices = np.empty((len(entries), size, size))
    matrices[:, rows, columns] = matrices[:, columns, rows] = entries
    return matrices
