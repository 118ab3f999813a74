"""What figures, report.json and the page draw alike: errors over time, whole and by component, and colours.

Errors over time are drawn from the common start, which shows drift. Maps are drawn after a fit to the truth. Pairs and
fits are those of the metrics. With an IMU the vertical is measured and only heading and position are fitted (the fit of
ate_yaw_m); from twists alone an estimator does not know the vertical, and a whole rigid motion is fitted (that of
ate_se3_m).
"""

from collections.abc import Callable, Iterable
from typing import NamedTuple, TypeVar

import numpy as np

from toolkit.answers import Output, Run
from toolkit.estimate import Trajectory
from toolkit.experiment.comparison import Comparison, Row
from toolkit.geometry import Array, IntArray, se3_inverse, so3_log, yaw_of
from toolkit.metrics import Evaluation
from toolkit.metrics.parts.against_truth import (
    Alignment,
    associate,
    finite_poses,
    fit_se3,
    fit_yaw,
    median_period_ns,
    place_first,
)
from toolkit.metrics.parts.consistency import POSE_DOF, body_errors, starts_in_the_truths_world
from toolkit.metrics.parts.scores import Unavailable
from toolkit.models.state import POSITION, ROTATION
from toolkit.registry import defaults, discover, ladder
from toolkit.sequence import Sequence, Truth

T = TypeVar("T")
# How many colours there are; a look of a higher number has the colours over again, in other dashes.
COLOURS = 7
_MICROSECONDS = 6
NOT_ALIGNED = Alignment(np.eye(3), np.zeros(3))
_LINES = "Dashed: causal, what was known at the time. Solid: final, which of a filter is its causal output too."
_FROM_START = "All start from the same pose and nothing is fitted, so that the error is what has drifted since."


def available(compute: Callable[[Evaluation], T], run: Run, output: Output, sequence: Sequence) -> T | None:
    """Return what is computed of an output, None where it is unavailable; a diverged run may overflow meanwhile."""
    if run.trajectory(output) is None:
        return None
    try:
        with np.errstate(all="ignore"):
            return compute(Evaluation(run, output, sequence))
    except Unavailable:
        return None


class Errors(NamedTuple):
    """Errors at stamps (N,) and paths (N,) m: distance (N,) m and heading (N,) degrees within +-180."""

    t_ns: IntArray
    path_m: Array
    position_m: Array
    heading_deg: Array


class ReferenceEstimate(NamedTuple):
    """The trajectory that others are compared with where there is no truth, and its name."""

    name: str
    trajectory: Trajectory


def reference_estimate(comparison: Comparison) -> ReferenceEstimate | None:
    """Return the last trajectory made here of a run that is ok: with the defaults, the smoother's.

    Only where there is none is it one that was read from a file; None where no run is ok.
    """
    made_here_last = sorted(comparison.rows, key=lambda row: row.run.timings is not None)
    for row in reversed(made_here_last):
        trajectory = row.run.trajectory(row.output)
        if row.status == "ok" and trajectory is not None:
            return ReferenceEstimate(f"{row.estimator} {row.output}", trajectory)
    return None


def truth_during(sequence: Sequence) -> Truth | None:
    if sequence.truth is None:
        return None
    t_ns = sequence.truth.t_ns
    during = (t_ns >= sequence.frames_t_ns[0]) & (t_ns <= sequence.frames_t_ns[-1])
    return Truth(t_ns[during], sequence.truth.T_world_imu[during]) if during.any() else None


def onto_truth(run: Run, output: Output, sequence: Sequence) -> Alignment:
    """Return the fit of a run to the truth, or no alignment where there is no truth or no fit."""
    fit = fit_yaw if sequence.motion_kind == "imu" else fit_se3
    return available(lambda of: fit(*of.compared.positions), run, output, sequence) or NOT_ALIGNED


def from_start(run: Run, output: Output, sequence: Sequence) -> Alignment:
    """Return what places a run's first pose on the truth; nothing where its start is in the truth's world already."""
    if run.timings is not None and starts_in_the_truths_world(sequence):
        return NOT_ALIGNED
    placed = available(
        lambda of: place_first(of.compared.truth[0], of.compared.estimate[0], of.level), run, output, sequence
    )
    return placed or NOT_ALIGNED


def alignment_text(sequence: Sequence) -> str:
    if sequence.truth is None:
        return "There is no truth; every estimator starts from the same pose and nothing is aligned."
    fit = "yaw and position" if sequence.motion_kind == "imu" else "SE(3)"
    return f"Estimates are aligned to the truth by {fit}."


def errors_to(reference: Truth, trajectory: Trajectory, alignment: Alignment, sequence: Sequence) -> Errors | None:
    """Return the errors of an aligned trajectory at the reference's stamps, or None where it reaches none."""
    pairs = associate(trajectory, reference, median_period_ns(sequence.frames_t_ns))
    if not len(pairs):
        return None
    aligned = alignment.apply(pairs.estimate)
    heading = yaw_of(aligned[:, :3, :3]) - yaw_of(pairs.truth[:, :3, :3])
    return Errors(
        pairs.t_ns,
        pairs.path_m,
        np.linalg.norm(aligned[:, :3, 3] - pairs.truth[:, :3, 3], axis=1),
        np.degrees((heading + np.pi) % (2.0 * np.pi) - np.pi),
    )


def seconds(sequence: Sequence, t_ns: IntArray) -> tuple[float, ...]:
    """Return stamps (N,) as seconds from the first frame, to the microsecond."""
    return tuple(round(t, _MICROSECONDS) for t in sequence.elapsed_s(t_ns).tolist())


def shown_output(run: Run) -> Output:
    """Return the kind of output a figure with room for one shows: the final one where there is one."""
    return "final" if run.final is not None else "causal"


class ErrorCurves(NamedTuple):
    """The rows with their errors, the name of these ("error", or "difference from" a run), how placed, the caption."""

    of_rows: list[tuple[Row, Errors]]
    what: str
    placing: str
    caption: str


def error_curves(comparison: Comparison) -> ErrorCurves | None:
    """Return every row's errors from the common start (with truth) or differences (without), or None without any."""
    sequence, reference = comparison.sequence, truth_during(comparison.sequence)
    estimate = reference_estimate(comparison) if reference is None else None
    if reference is not None:
        placing, what, caption = "from the common start", "error", f"{_FROM_START} {_LINES}"
    elif estimate is not None:
        reference = Truth(estimate.trajectory.t_ns, estimate.trajectory.T_world_imu)
        placing, what = "not aligned", f"difference from {estimate.name}"
        caption = (
            f"There is no truth: position and heading difference from {estimate.name}, not aligned. "
            "A difference says that two estimators disagree, not which of them is right."
        )
    else:
        return None
    curves: list[tuple[Row, Errors]] = []
    for row in comparison.rows:
        trajectory = row.run.trajectory(row.output)
        repeated = row.output == "causal" and row.run.final_is_causal
        if trajectory is None or repeated or (estimate is not None and trajectory is estimate.trajectory):
            continue
        placed = NOT_ALIGNED if estimate is not None else from_start(row.run, row.output, sequence)
        errors = errors_to(reference, trajectory, placed, sequence)
        if errors is not None:
            curves.append((row, errors))
    return ErrorCurves(curves, what, placing, caption) if curves else None


class Components(NamedTuple):
    """Errors at stamps (n,) in the world's axes (n, 6) and their stated standard deviations (n, 6) or None.

    The first three are rotations about x, y and z in degrees, the others positions along them in metres; each is
    estimate minus truth.
    """

    t_ns: IntArray
    error: Array
    sigma: Array | None


def components(comparison: Comparison, row: Row) -> Components | None:
    """Return the errors of an output as the NEES takes them, or without truth its difference from the last estimate.

    Returns None where there is neither.
    """
    trajectory = row.run.trajectory(row.output)
    if trajectory is None:
        return None
    if comparison.sequence.truth is None:
        return _difference(comparison, row)
    errors = available(body_errors, row.run, row.output, comparison.sequence)
    if errors is None:
        return None
    covs = None if trajectory.cov is None else trajectory.cov[errors.rows]
    return _in_world_axes(errors.t_ns, errors.T_world_imu, errors.T_estimate_truth, covs)


def _difference(comparison: Comparison, row: Row) -> Components | None:
    reference, trajectory = reference_estimate(comparison), row.run.trajectory(row.output)
    if reference is None or trajectory is None or trajectory is reference.trajectory:
        return None
    t_ns, mine, theirs = np.intersect1d(trajectory.t_ns, reference.trajectory.t_ns, return_indices=True)
    poses, others = trajectory.T_world_imu[mine], reference.trajectory.T_world_imu[theirs]
    known = finite_poses(poses) & finite_poses(others)
    covs = None if trajectory.cov is None else trajectory.cov[mine][known]
    return _in_world_axes(t_ns[known], poses[known], se3_inverse(poses[known]) @ others[known], covs)


def _in_world_axes(t_ns: IntArray, poses: Array, T_estimate_truth: Array, covs: Array | None) -> Components | None:
    if not t_ns.size:
        return None
    turn = poses[:, :3, :3]
    in_body = np.stack([np.degrees(so3_log(T_estimate_truth[:, :3, :3])), T_estimate_truth[:, :3, 3]], axis=1)
    error = -np.einsum("nij,nkj->nki", turn, in_body).reshape(-1, POSE_DOF)
    if covs is None or not np.isfinite(covs[:, :POSE_DOF, :POSE_DOF]).any():
        return Components(t_ns, error, None)
    variances = [np.einsum("nij,njk,nik->ni", turn, covs[:, of, of], turn) for of in (ROTATION, POSITION)]
    of_rotation, of_position = (np.sqrt(np.maximum(variance, 0.0)) for variance in variances)
    return Components(t_ns, error, np.hstack([np.degrees(of_rotation), of_position]))


def look_numbers(compared: Iterable[str]) -> dict[str, int]:
    """Return the number of the look of each estimator that is compared, whatever it is compared with.

    Those of this installation have the first numbers: the default ones, then the ladder, then others by name. All
    others, as a file of one's own, have dashes that none of these have, and first colours that no default one has.
    """
    here = list(dict.fromkeys((*defaults(), *(entry.name for entry in ladder()), *discover())))
    own = [name for name in dict.fromkeys(compared) if name not in here]
    first_own = -(-len(here) // COLOURS) * COLOURS + len(defaults())
    return {name: i for i, name in enumerate(here)} | {name: first_own + i for i, name in enumerate(own)}
