"""The output of estimators: the state at one instant, trajectories, landmarks, and everything one run produced.

An estimator's answers are checked where the runner receives them: they must have the right types and shapes and belong
to frames of the sequence. Values are not checked: a pose that is not finite is a result (``diverged``), an array of
another shape is a mistake in the estimator's code, and is named as such before anything computes with it.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from toolkit.errors import EstimatorError, type_of
from toolkit.geometry import Array, IntArray, read_only
from toolkit.sequence import Packet

Status = Literal["ok", "diverged", "failed"]
STATUS_MEANING: Mapping[Status, str] = {
    "ok": "ran to the end",
    "diverged": "ran to the end with implausible estimates",
    "failed": "could not go on",
}
Output = Literal["causal", "final"]
Arithmetic = Literal["compiled", "numpy"]
# What several runs of an estimator computed with: "both" where they differ.
ArithmeticOfRuns = Literal["compiled", "numpy", "both"]
# Farther than the Moon: no position. Squares of 1e200 m overflow, and a metric would have no value without saying why.
FARTHEST_M = 1e9
# Of the state: the pose; with a gyro bias; with velocity and both biases; with velocity and turn rate.
COV_SIZES = (6, 9, 12, 15)
_STATE: Mapping[str, tuple[tuple[int, ...], ...]] = {"T_world_imu": ((4, 4),), "v_world": ((3,),), "bias": ((6,),)}
_COVARIANCE = {"cov": tuple((size, size) for size in COV_SIZES)}


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
        """Return each state by itself."""

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
        """Return a map without landmarks."""
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


@dataclass(frozen=True, eq=False)
class Timings:
    """Seconds of wall clock per step (K,), of the finish and of all, seconds of CPU, peak memory in MB."""

    step_s: Array
    finish_s: float
    total_s: float
    cpu_s: float
    peak_rss_mb: float | None


@dataclass(frozen=True, eq=False)
class Run:
    """One estimator on one sequence: both kinds of output, the map, diagnostics per step, cost and status.

    ``causal`` is what was known at each frame and is None for an estimator that answers only at the end. ``timings`` is
    None for another system's run, read from a file and not made here. ``info`` holds the diagnostics of the causal
    estimates by name, each (N,), NaN where one was not given. ``arithmetic`` says whether compiled code or NumPy ran,
    where the estimator has both.
    """

    estimator: str
    status: Status
    causal: Trajectory | None
    final: Trajectory | None
    landmarks: Landmarks
    timings: Timings | None
    info: Mapping[str, Array] = field(default_factory=dict)
    log: tuple[str, ...] = ()
    arithmetic: Arithmetic | None = None

    def trajectory(self, output: Output) -> Trajectory | None:
        """Return the trajectory of one kind of output."""
        return self.causal if output == "causal" else self.final

    @property
    def final_is_causal(self) -> bool:
        """Say whether the final output repeats the causal one, poses and covariances, as a filter's does."""
        causal, final = self.causal, self.final
        if causal is None or final is None or not np.array_equal(causal.T_world_imu, final.T_world_imu):
            return False
        if causal.cov is None or final.cov is None:
            return causal.cov is final.cov
        return np.array_equal(causal.cov, final.cov, equal_nan=True)


def checked_estimate(answer: Any, packet: Packet, before: Estimate | None) -> Estimate | None:
    """Return an answer of ``step`` to a packet, as it is; ``before`` is the last one that was no None.

    Raises EstimatorError where it is no Estimate of the packet's frame with arrays of the documented shapes.
    """
    if answer is None:
        return None
    check_state(answer, packet.index)
    where = f"of its answer to frame {packet.index}"
    if not isinstance(answer.t_ns, int | np.integer) or answer.t_ns != packet.frame.t_ns:
        raise EstimatorError(f"t_ns {where} is {answer.t_ns!r}; the frame's is {packet.frame.t_ns}, in whole ns")
    _check_arrays(answer, _COVARIANCE, where)
    earlier = None if before is None else before.cov
    if earlier is not None and answer.cov is not None and earlier.shape != answer.cov.shape:
        raise EstimatorError(f"cov {where} has shape {answer.cov.shape}, and {earlier.shape} before; keep to one")
    _check_info(answer.info, where)
    estimate: Estimate = answer
    return estimate


def check_state(answer: Any, frame: int) -> None:
    """Raise EstimatorError where an answer of ``step`` to a frame is no Estimate of a pose, velocity and biases."""
    if not isinstance(answer, Estimate):
        raise EstimatorError(f"its answer to frame {frame} is {type_of(answer)}; step returns an Estimate or None")
    _check_arrays(answer, _STATE, f"of its answer to frame {frame}")


def checked_finish(answer: Any, frames_t_ns: IntArray, answered: bool) -> Finished:
    """Return what ``finish`` answered, as it is; ``answered`` says whether any step gave an estimate.

    Raises EstimatorError where it is no Finished, is about stamps that are no frames' (F,), or about nothing at all.
    """
    if not isinstance(answer, Finished):
        raise EstimatorError(f"finish returned {type_of(answer)}; it must return a Finished")
    trajectory, landmarks = answer.trajectory, answer.landmarks
    if not isinstance(trajectory, Trajectory):
        raise EstimatorError(f"the trajectory of its finish is {type_of(trajectory)}; it is a Trajectory")
    if not isinstance(landmarks, Landmarks):
        raise EstimatorError(f"the landmarks of its finish are {type_of(landmarks)}; they are Landmarks")
    if isinstance(answer.log, str) or not isinstance(answer.log, Sequence):
        raise EstimatorError(f"the log of its finish is {type_of(answer.log)}; it is a tuple of texts")
    count = len(trajectory)
    stacked = {name: tuple((count, *one) for one in shapes) for name, shapes in {**_STATE, **_COVARIANCE}.items()}
    _check_arrays(trajectory, stacked, "of its final trajectory")
    if (np.diff(trajectory.t_ns) <= 0).any() or not np.isin(trajectory.t_ns, frames_t_ns).all():
        raise EstimatorError("the stamps of its final trajectory are not those of frames, ascending, in whole ns")
    _check_array("points_world of its landmarks", landmarks.points_world, ((len(landmarks), 3),), required=True)
    _check_array("cov of its landmarks", landmarks.cov, ((len(landmarks), 3, 3),), required=False)
    if not answered and not count:
        raise EstimatorError("it returned no estimate for any frame, neither in step nor in finish")
    return answer


def _check_arrays(record: Any, shapes: Mapping[str, tuple[tuple[int, ...], ...]], where: str) -> None:
    for name, allowed in shapes.items():
        _check_array(f"{name} {where}", getattr(record, name), allowed, required=name == "T_world_imu")


def _check_array(what: str, value: Any, shapes: tuple[tuple[int, ...], ...], *, required: bool) -> None:
    if value is None and not required:
        return
    if not isinstance(value, np.ndarray):
        raise EstimatorError(f"{what} is {type_of(value)}; it is an array of numbers")
    if value.dtype.kind not in "fiu":
        raise EstimatorError(f"{what} has the type {value.dtype}; it is an array of real numbers")
    if value.shape not in shapes:
        raise EstimatorError(f"{what} has shape {value.shape}; expected {' or '.join(map(str, shapes))}")


def _check_info(info: Any, where: str) -> None:
    if not isinstance(info, Mapping):
        raise EstimatorError(f"info {where} is {type_of(info)}; it is a dict of numbers by name")
    for name in _not_numbers(info):
        raise EstimatorError(f"info {where} has {name!r}: {info[name]!r}; it is a dict of numbers by name")


def _not_numbers(info: Mapping[Any, Any]) -> Iterator[Any]:
    for name, value in info.items():
        if not isinstance(name, str) or not isinstance(value, float | int | np.number):
            yield name
