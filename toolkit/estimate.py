"""The output of estimators: the state at one instant, trajectories, and landmarks."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from toolkit.geometry import Array, IntArray, read_only

# Farther than the Moon: no position. Squares of 1e200 m overflow, and a metric would have no value without saying why.
FARTHEST_M = 1e9


@dataclass(frozen=True, eq=False)
class Estimate:
    """The state at one frame as an estimator knew it.

    ``T_world_imu`` (4, 4); ``v_world`` (3,) m/s and ``bias`` (6,) [accel, gyro] where they are estimated;
    ``cov`` (d, d) whose first six rows are the pose in GTSAM's order and side (rotation, position, body
    frame), followed by velocity and biases for d = 15, by the gyro bias for d = 9, or by velocity and turn rate
    for d = 12, where no motion was measured: the turn rate, with the sign changed, then stands for a gyro bias.
    ``info`` holds diagnostics by name; the metrics understand ``nis``, ``nis_dof`` and, where a gate truncates the
    innovations, ``nis_expected``, what ``nis`` is on average in a consistent estimator (``nis_dof`` where it is not
    given).
    """

    t_ns: int
    T_world_imu: Array
    cov: Array | None = None
    v_world: Array | None = None
    bias: Array | None = None
    info: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Trajectory:
    """States on increasing stamps (N,): poses (N, 4, 4) and, where known, velocities, biases, covariances."""

    t_ns: IntArray
    T_world_imu: Array
    v_world: Array | None = None
    bias: Array | None = None
    cov: Array | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "t_ns", read_only(self.t_ns, np.int64))
        for name in ("T_world_imu", "v_world", "bias", "cov"):
            if getattr(self, name) is not None:
                object.__setattr__(self, name, read_only(getattr(self, name)))

    def __len__(self) -> int:
        return self.t_ns.size

    @property
    def positions(self) -> Array:
        """Positions of the IMU in the world (N, 3) m."""
        return self.T_world_imu[:, :3, 3]

    def states(self) -> "list[Estimate]":
        def parts(stacked: Array | None) -> list[Array | None]:
            return [None] * len(self) if stacked is None else list(stacked)

        fields = (parts(self.cov), parts(self.v_world), parts(self.bias))
        return [Estimate(*row) for row in zip(self.t_ns.tolist(), self.T_world_imu, *fields, strict=True)]

    @classmethod
    def of(cls, estimates: "list[Estimate]") -> "Trajectory":
        """Stack estimates; a field that some of them lack is left out."""

        def stacked(name: str) -> Array | None:
            values = [getattr(e, name) for e in estimates]
            return None if not values or any(v is None for v in values) else np.stack(values)

        poses = stacked("T_world_imu")
        return cls(
            np.array([e.t_ns for e in estimates], dtype=np.int64),
            np.empty((0, 4, 4)) if poses is None else poses,
            stacked("v_world"),
            stacked("bias"),
            stacked("cov"),
        )


@dataclass(frozen=True, eq=False)
class Landmarks:
    """Landmarks by track: ids (N,) ascending, positions in the world (N, 3) m, covariances (N, 3, 3) or None."""

    track_ids: IntArray
    points_world: Array
    cov: Array | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "track_ids", read_only(self.track_ids, np.int64))
        object.__setattr__(self, "points_world", read_only(self.points_world))

    def __len__(self) -> int:
        return self.track_ids.size

    @classmethod
    def of(cls, points: Mapping[int, Array]) -> "Landmarks":
        """Collect landmarks from a mapping of track id to point (3,)."""
        ids = np.array(sorted(points), dtype=np.int64)
        return cls(ids, np.array([points[i] for i in ids.tolist()]).reshape(-1, 3))

    @classmethod
    def none(cls) -> "Landmarks":
        return cls(np.empty(0, dtype=np.int64), np.empty((0, 3)))


@dataclass(frozen=True, eq=False)
class Finished:
    """What an estimator returns at the end, when it has read every packet.

    ``converged`` is False where a solve did not converge; ``log`` lists the problems that the estimator recovered from,
    and how.
    """

    trajectory: Trajectory
    landmarks: Landmarks
    converged: bool = True
    log: tuple[str, ...] = ()
