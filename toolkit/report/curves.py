"""What figures, report.json and the page draw alike: errors over time, whole and by component, and colours.

Errors over time are drawn from the common start, which shows drift. Maps are drawn after a fit to the truth. Pairs and
fits are those of the metrics. With an IMU the vertical is measured and only heading and position are fitted (the fit of
ate_yaw_m); from twists alone an estimator does not know the vertical, and a whole rigid motion is fitted (that of
ate_se3_m).
"""

from collections.abc import Callable, Iterable, Sized
from typing import Annotated, NamedTuple, TypeVar

import numpy as np
from msgspec import UNSET, Meta, Struct, UnsetType
from msgspec.structs import asdict

from toolkit.answers import Output, Run
from toolkit.estimate import Trajectory
from toolkit.experiment.comparison import Comparison, Row
from toolkit.files.documents import numbers, of_attributes
from toolkit.geometry import Array, IntArray, se3_inverse, so3_log, yaw_of
from toolkit.metrics import Evaluation
from toolkit.metrics.parts.consistency import (
    POSE_DOF,
    body_errors,
    nees_band,
    nees_over_time,
    nis_over_time,
    starts_in_the_truths_world,
)
from toolkit.metrics.parts.evaluation import (
    Alignment,
    associate,
    finite_poses,
    fit_se3,
    fit_yaw,
    median_period_ns,
    place_first,
)
from toolkit.metrics.parts.scores import Unavailable
from toolkit.models.state import POSITION, ROTATION
from toolkit.registry import defaults, discover, ladder
from toolkit.sequence import Sequence, Truth

T = TypeVar("T")
Times = Annotated[tuple[float, ...], Meta(description="seconds from the first frame")]
Numbers = tuple[float | None, ...]
# How many colours there are; a look of a higher number has the colours over again, in other dashes.
COLOURS = 7
_MICROSECONDS = 6
COMPONENTS = ("about_x_deg", "about_y_deg", "about_z_deg", "x_m", "y_m", "z_m")
NOT_ALIGNED = Alignment(np.eye(3), np.zeros(3))
_LINES = "Dashed: causal, what was known at the time. Solid: final, which of a filter is its causal output too."
_FROM_START = "All start from the same pose and nothing is fitted, so that the error is what has drifted since."


class Columns(Struct, frozen=True, kw_only=True):
    """Columns of one table: of equal length, which decoding checks."""

    def __post_init__(self) -> None:
        columns = asdict(self).items()
        check_lengths({name: column for name, column in columns if isinstance(column, tuple) and name != "band"})


def check_lengths(columns: dict[str, Sized]) -> None:
    first, *others = columns
    for name in others:
        if len(columns[name]) != len(columns[first]):
            raise ValueError(f"{name} has {len(columns[name])} entries, {first} has {len(columns[first])}")


class ErrorKind(Struct, frozen=True, kw_only=True):
    """What the errors of this report are."""

    what: Annotated[str, Meta(description="error, or the difference from whom")]
    placing: Annotated[str | UnsetType, Meta(description="how estimates are placed, which old captions say")] = UNSET
    caption: str


class ErrorSeries(Columns, frozen=True, kw_only=True):
    """Errors along the recording, after the alignment."""

    t_s: Times
    path_m: Annotated[Numbers, Meta(description="along the truth")]
    position_m: Numbers
    heading_deg: Numbers


class ComponentSeries(Columns, frozen=True, kw_only=True):
    """Errors by component along the recording, not aligned but placed as for the NEES, and what is stated of them.

    Estimate minus truth, or without truth minus another estimate, along and about the world's axes.
    """

    t_s: Times
    x_m: Numbers
    y_m: Numbers
    z_m: Numbers
    about_x_deg: Numbers
    about_y_deg: Numbers
    about_z_deg: Numbers
    sigma_x_m: Annotated[Numbers, Meta(description="stated standard deviation; null where none is stated")]
    sigma_y_m: Numbers
    sigma_z_m: Numbers
    sigma_about_x_deg: Numbers
    sigma_about_y_deg: Numbers
    sigma_about_z_deg: Numbers


class NeesSeries(Columns, frozen=True, kw_only=True):
    """NEES along the recording, each over its degrees of freedom."""

    t_s: Times
    pose: Numbers
    orientation: Numbers
    position: Numbers
    band: Annotated[tuple[float, float], Meta(description="95 % band of the pose")]


class NisSeries(Columns, frozen=True, kw_only=True):
    """NIS of each step that reports one."""

    t_s: Times
    per_dof: Annotated[Numbers, Meta(description="over what is expected of the step: its degrees of freedom, or less")]
    low: Annotated[Numbers, Meta(description="lower end of the 95 % band for as many")]
    high: Annotated[Numbers, Meta(description="upper end of the 95 % band for as many")]


def available(compute: Callable[[Evaluation], T], run: Run, output: Output, sequence: Sequence) -> T | None:
    found = computed_or_reason(compute, run, output, sequence)
    return None if isinstance(found, str) else found


def computed_or_reason(compute: Callable[[Evaluation], T], run: Run, output: Output, sequence: Sequence) -> T | str:
    """Return what is computed of an output, or why it is unavailable; a diverged run may overflow meanwhile."""
    if run.trajectory(output) is None:
        return "the run gave no trajectory"
    try:
        with np.errstate(all="ignore"):
            return compute(Evaluation(run, output, sequence))
    except Unavailable as reason:
        return str(reason)


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


def errors_to(reference: Truth, trajectory: Trajectory, alignment: Alignment, sequence: Sequence) -> ErrorSeries | None:
    """Return the errors of an aligned trajectory at the reference's stamps, or None where it reaches none."""
    pairs = associate(trajectory, reference, median_period_ns(sequence.frames_t_ns))
    if not len(pairs):
        return None
    aligned = alignment.apply(pairs.estimate)
    heading = yaw_of(aligned[:, :3, :3]) - yaw_of(pairs.truth[:, :3, :3])
    return ErrorSeries(
        t_s=seconds(sequence, pairs.t_ns),
        path_m=numbers(pairs.path_m),
        position_m=numbers(np.linalg.norm(aligned[:, :3, 3] - pairs.truth[:, :3, 3], axis=1)),
        heading_deg=numbers(np.degrees((heading + np.pi) % (2.0 * np.pi) - np.pi)),
    )


def seconds(sequence: Sequence, t_ns: IntArray) -> tuple[float, ...]:
    """Return stamps (N,) as seconds from the first frame, to the microsecond."""
    return tuple(round(t, _MICROSECONDS) for t in sequence.elapsed_s(t_ns).tolist())


def shown_as(row: Row) -> Output:
    """Return the kind of output whose line a row has: a filter's only answer is drawn as a final one."""
    return "final" if row.label == "both" else row.output


def shown_output(run: Run) -> Output:
    """Return the kind of output a figure with room for one shows: the final one where there is one."""
    return "final" if run.final is not None else "causal"


def error_curves(comparison: Comparison) -> tuple[ErrorKind | None, dict[Row, ErrorSeries]]:
    """Return what the errors are, and each row's: from the common start, without truth differences; None and no row
    where there are none.
    """
    sequence, reference = comparison.sequence, truth_during(comparison.sequence)
    estimate = reference_estimate(comparison) if reference is None else None
    if reference is not None:
        kind = ErrorKind(what="error", placing="from the common start", caption=f"{_FROM_START} {_LINES}")
    elif estimate is not None:
        reference = Truth(estimate.trajectory.t_ns, estimate.trajectory.T_world_imu)
        caption = (
            f"There is no truth: position and heading difference from {estimate.name}, not aligned. "
            "A difference says that two estimators disagree, not which of them is right."
        )
        kind = ErrorKind(what=f"difference from {estimate.name}", placing="not aligned", caption=caption)
    else:
        return None, {}
    curves: dict[Row, ErrorSeries] = {}
    for row in comparison.lines:
        output = shown_as(row)
        trajectory = row.run.trajectory(output)
        if trajectory is None or (estimate is not None and trajectory is estimate.trajectory):
            continue
        placed = NOT_ALIGNED if estimate is not None else from_start(row.run, output, sequence)
        errors = errors_to(reference, trajectory, placed, sequence)
        if errors is not None:
            curves[row] = errors
    return kind if curves else None, curves


def components(comparison: Comparison, row: Row) -> ComponentSeries | None:
    """Return the errors of an output as the NEES takes them, or without truth its difference from the last estimate.

    Returns None where there is neither.
    """
    trajectory, sequence = row.run.trajectory(row.output), comparison.sequence
    if trajectory is None:
        return None
    if sequence.truth is None:
        return _difference(comparison, trajectory)
    errors = available(body_errors, row.run, row.output, sequence)
    if errors is None:
        return None
    covs = None if trajectory.cov is None else trajectory.cov[errors.rows]
    return _in_world_axes(seconds(sequence, errors.t_ns), errors.T_world_imu, errors.T_estimate_truth, covs)


def _difference(comparison: Comparison, trajectory: Trajectory) -> ComponentSeries | None:
    reference = reference_estimate(comparison)
    if reference is None or trajectory is reference.trajectory:
        return None
    t_ns, mine, theirs = np.intersect1d(trajectory.t_ns, reference.trajectory.t_ns, return_indices=True)
    poses, others = trajectory.T_world_imu[mine], reference.trajectory.T_world_imu[theirs]
    known = finite_poses(poses) & finite_poses(others)
    covs = None if trajectory.cov is None else trajectory.cov[mine][known]
    t_s = seconds(comparison.sequence, t_ns[known])
    return _in_world_axes(t_s, poses[known], se3_inverse(poses[known]) @ others[known], covs)


def _in_world_axes(
    t_s: tuple[float, ...], poses: Array, T_estimate_truth: Array, covs: Array | None
) -> ComponentSeries | None:
    if not t_s:
        return None
    turn, sigma = poses[:, :3, :3], np.full((len(t_s), POSE_DOF), np.nan)
    in_body = np.stack([np.degrees(so3_log(T_estimate_truth[:, :3, :3])), T_estimate_truth[:, :3, 3]], axis=1)
    error = -np.einsum("nij,nkj->nki", turn, in_body).reshape(-1, POSE_DOF)
    if covs is not None:
        with np.errstate(all="ignore"):  # a diverged run overflows; that becomes null
            variances = [np.einsum("nij,njk,nik->ni", turn, covs[:, of, of], turn) for of in (ROTATION, POSITION)]
            of_rotation, of_position = (np.sqrt(np.maximum(variance, 0.0)) for variance in variances)
        sigma = np.hstack([np.degrees(of_rotation), of_position])
    columns = {name: numbers(error[:, i]) for i, name in enumerate(COMPONENTS)}
    stated = {f"sigma_{name}": numbers(sigma[:, i]) for i, name in enumerate(COMPONENTS)}
    return ComponentSeries(t_s=t_s, **columns, **stated)


def nees_series(evaluation: Evaluation) -> NeesSeries:
    nees = nees_over_time(evaluation)
    t_s = seconds(evaluation.sequence, nees.t_ns)
    return of_attributes(NeesSeries, nees, numbers, t_s=t_s, band=nees_band(POSE_DOF))


def nis_series(evaluation: Evaluation) -> NisSeries:
    """Return each step's NIS over what is expected of it, with the two-sided 95 % band of a consistent filter's."""
    nis = nis_over_time(evaluation)
    low, high = map(numbers, nis.bands())
    t_s = seconds(evaluation.sequence, evaluation.estimate.t_ns[nis.rows])
    return NisSeries(t_s=t_s, per_dof=numbers(nis.nis / nis.expected), low=low, high=high)


def look_numbers(compared: Iterable[str]) -> dict[str, int]:
    """Return the number of the look of each estimator that is compared, whatever it is compared with.

    Those of this installation have the first numbers: the default ones, then the ladder, then others by name. All
    others, as a file of one's own, have dashes that none of these have, and first colours that no default one has.
    """
    here = list(dict.fromkeys((*defaults(), *(entry.name for entry in ladder()), *discover())))
    own = [name for name in dict.fromkeys(compared) if name not in here]
    first_own = -(-len(here) // COLOURS) * COLOURS + len(defaults())
    return {name: i for i, name in enumerate(here)} | {name: first_own + i for i, name in enumerate(own)}
