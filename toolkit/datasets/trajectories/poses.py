"""The content of a trajectory file, and the checks that do not depend on its format."""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from toolkit.errors import DataError
from toolkit.estimate import FARTHEST_M, Trajectory
from toolkit.geometry import Array, IntArray, quaternion_from_rotation, rotation_from_quaternion, se3

# Quaternions printed with four decimals are off by 1e-4; anything beyond 1e-2 is not a rounded rotation.
UNIT_TOLERANCE = 1e-2
TOO_FAR = f"has a position beyond {FARTHEST_M:g} m; check its unit, or remove the line"
# A file whose first four-vector is this close to (1, 0, 0, 0) starts at the identity if it is w first.
_IDENTITY_TOLERANCE = 1e-2
# Mean resultant length of the directions of travel in the body frame: 1 for a vehicle, about 0 for the wrong order.
_VEHICLE_CONCENTRATION, _LEAST_GAIN = 0.9, 0.1


@dataclass(frozen=True)
class OtherOrder:
    """The order that the quaternions of a format have by mistake.

    Rolling what was read as x y z w by ``roll`` gives what the file then means; ``name`` calls the mistake, and
    ``remedy`` is the instruction to correct it.
    """

    roll: int
    name: str
    remedy: str

    def reread(self, R_world_imu: Array) -> Array:
        """Return rotations (N, 3, 3) as they are if the quaternions were in this order."""
        return rotation_from_quaternion(np.roll(quaternion_from_rotation(R_world_imu), self.roll, axis=-1))


@dataclass(frozen=True, eq=False)
class StatedApart:
    """Covariances (N, 3, 3) without what couples them: of orientations, rad^2 in the body frame, and of positions.

    Those of positions are m^2 in the world frame.
    """

    orientation: Array
    position: Array


@dataclass(frozen=True, eq=False)
class PosesFile:
    """The poses (N, 4, 4) of a trajectory file, their stamps (N,) ns, and how its quaternions might be misread.

    Stamps are None where the format has none, and the order where it has no quaternions. ``covariances`` are those of
    the orientation and of the position, where the file has them.
    """

    path: Path
    format: str
    t_ns: IntArray | None
    T_world_imu: Array
    other_order: OtherOrder | None
    covariances: "StatedApart | None" = None

    def __len__(self) -> int:
        return len(self.T_world_imu)


def checked_poses(path: Path, line_numbers: list[int], t_ns: IntArray, values: Array) -> Array:
    """Return the poses (N, 4, 4) of rows (N, 7), x y z in metres and a Hamilton quaternion x y z w.

    Raises DataError, naming the line, where a value is not finite, time does not increase or a quaternion is not
    of unit length.
    """
    checks = (
        (np.isfinite(values).all(axis=1), "holds a value that is not finite; remove the line"),
        (
            np.abs(values[:, :3]).max(axis=1, initial=0.0) < FARTHEST_M,
            TOO_FAR,
        ),
        (np.diff(t_ns, prepend=t_ns[:1] - 1) > 0, "is not later than the line before it; sort the file by time"),
        (
            np.abs(np.linalg.norm(values[:, 3:], axis=1) - 1.0) < UNIT_TOLERANCE,
            "has a quaternion that is not of unit length; check the order of the columns",
        ),
    )
    for passed, complaint in checks:
        if not passed.all():
            raise DataError(f"{path}: line {line_numbers[int(np.argmin(passed))]} {complaint}")
    return se3(rotation_from_quaternion(values[:, 3:]), values[:, :3])


def check_order(path: Path, T_world_imu: Array, other: OtherOrder) -> None:
    """Raise DataError where the trajectory alone shows that its quaternions are in the other order.

    A trajectory inverted as a whole, or in its rotations alone, is named as such.

    A vehicle moves in one direction of its own frame. If that holds in the other order and not as given, the order
    is wrong; where both readings do as well (no turn, or a hand-held camera), a start at the identity decides:
    read in the wrong order it is a start upside down.
    """
    positions, R_world_imu = T_world_imu[:, :3, 3], T_world_imu[:, :3, :3]
    reread = other.reread(R_world_imu)
    as_given, otherwise = _concentration(positions, R_world_imu), _concentration(positions, reread)
    remedy, inverted = max(_inverted(positions, R_world_imu), key=lambda reading: reading[1])
    is_vehicle = otherwise > _VEHICLE_CONCENTRATION and otherwise > as_given + _LEAST_GAIN
    # Where the vehicle turns about one axis only, the wrong order looks right as well: the likelier mistake is named.
    if inverted > max(_VEHICLE_CONCENTRATION, as_given + _LEAST_GAIN) and inverted >= otherwise - _LEAST_GAIN:
        raise DataError(f"{path}: {remedy}")
    starts_at_identity = np.linalg.norm(quaternion_from_rotation(reread[0])[:3]) < _IDENTITY_TOLERANCE
    if is_vehicle or (starts_at_identity and otherwise >= as_given - _LEAST_GAIN):
        raise DataError(f"{path}: {other.remedy}")


def finite(trajectory: Trajectory) -> Trajectory:
    """Return a trajectory without the poses that are not finite, which readers of files reject."""
    kept = np.isfinite(trajectory.T_world_imu).all(axis=(1, 2))
    v_world, bias = (None if one is None else one[kept] for one in (trajectory.v_world, trajectory.bias))
    return Trajectory(trajectory.t_ns[kept], trajectory.T_world_imu[kept], v_world, bias)


def rows_text(header: str, rows: Iterable[tuple[str, list[float]]], separator: str) -> str:
    """Return a file's text: the header, then each row's first entry and its values with 15 digits."""
    lines = (
        separator.join(([first] if first else []) + [f"{value:.15g}" for value in values]) for first, values in rows
    )
    return "\n".join([*([header] if header else []), *lines]) + "\n"


def _inverted(positions: Array, R_world_imu: Array) -> tuple[tuple[str, float], ...]:
    """Return what to do where poses (N, 3), (N, 3, 3) are inverted, in two ways, and how well each reading fits."""
    R_imu_world = np.swapaxes(R_world_imu, 1, 2)
    p_inverted = -np.einsum("nij,nj->ni", R_imu_world, positions)
    return (
        (
            "the poses look like those of the world in the IMU frame: invert each one",
            _concentration(p_inverted, R_imu_world),
        ),
        (
            "the quaternions look like those of the world to the IMU, as JPL and Hamilton mixed up: conjugate them",
            _concentration(positions, R_imu_world),
        ),
    )


def _concentration(positions: Array, R_world_imu: Array) -> float:
    """Return the mean resultant length, 0 to 1, of the body-frame displacements: 1 where all point the same way.

    Displacements are their own weights, so that noise at standstill does not count.
    """
    steps = np.diff(positions, axis=0)
    total = np.linalg.norm(steps, axis=1).sum()
    in_body = np.einsum("nji,nj->ni", R_world_imu[:-1], steps)
    return float(np.linalg.norm(in_body.sum(axis=0)) / total) if total > 0.0 else 0.0
