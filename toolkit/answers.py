"""Everything that an estimator answered in one run, and the checks of each answer where the runner receives it.

Types, shapes and the frames that an answer is about are checked. Values are not checked: a pose that is not finite is a
result (``diverged``), an array of another shape is a mistake in the estimator's code, and is named as such before
anything computes with it.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from toolkit.errors import EstimatorError, type_of
from toolkit.estimate import Estimate, Finished, Landmarks, Trajectory
from toolkit.geometry import Array, IntArray
from toolkit.measurements import Packet

Status = Literal["ok", "diverged", "failed"]
STATUS_MEANING: Mapping[Status, str] = {
    "ok": "ran to the end",
    "diverged": "ran to the end with implausible estimates",
    "failed": "could not go on",
}
Output = Literal["causal", "final"]
# Of the state: the pose; with a gyro bias; with velocity and both biases; with velocity and turn rate.
_COV_SIZES = (6, 9, 12, 15)
_STATE: Mapping[str, tuple[tuple[int, ...], ...]] = {"T_world_imu": ((4, 4),), "v_world": ((3,),), "bias": ((6,),)}
_COVARIANCE = {"cov": tuple((size, size) for size in _COV_SIZES)}


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
    estimates by name, each (N,), NaN where one was not given.
    """

    estimator: str
    status: Status
    causal: Trajectory | None
    final: Trajectory | None
    landmarks: Landmarks
    timings: Timings | None
    info: Mapping[str, Array] = field(default_factory=dict)
    log: tuple[str, ...] = ()

    def trajectory(self, output: Output) -> Trajectory | None:
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
    where = f"of its answer to frame {packet.index}"
    if not isinstance(answer, Estimate):
        told = f"its answer to frame {packet.index} is {type_of(answer)}"
        raise EstimatorError(f"{told}; step returns an Estimate or None")
    _check_arrays(answer, _STATE, where)
    if not isinstance(answer.t_ns, int | np.integer) or answer.t_ns != packet.frame.t_ns:
        raise EstimatorError(f"t_ns {where} is {answer.t_ns!r}; the frame's is {packet.frame.t_ns}, in whole ns")
    _check_arrays(answer, _COVARIANCE, where)
    earlier = None if before is None else before.cov
    if earlier is not None and answer.cov is not None and earlier.shape != answer.cov.shape:
        raise EstimatorError(f"cov {where} has shape {answer.cov.shape}, and {earlier.shape} before; keep to one")
    if not isinstance(answer.info, Mapping):
        raise EstimatorError(f"info {where} is {type_of(answer.info)}; it is a dict of numbers by name")
    for name, value in answer.info.items():
        if not isinstance(name, str) or not isinstance(value, float | int | np.number):
            raise EstimatorError(f"info {where} has {name!r}: {value!r}; it is a dict of numbers by name")
    return answer


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
