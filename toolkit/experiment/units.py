"""A unit of work: one estimator on one recording, run and scored."""

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace

import numpy as np

from toolkit import runner
from toolkit.answers import Output, Run, Status
from toolkit.arrays import rows_of
from toolkit.datasets.trajectories import tum
from toolkit.errors import DataError
from toolkit.estimator import Build
from toolkit.experiment.recording import Prepared, Recording, prepare_once
from toolkit.geometry import Array, IntArray, se3_inverse
from toolkit.metrics import Evaluation, Scores, repeated, scores_of
from toolkit.metrics.parts.consistency import body_errors, nees_over_time, nis_over_time
from toolkit.metrics.parts.scores import Unavailable
from toolkit.progress import Progress
from toolkit.registry import EstimatorEntry, find
from toolkit.sequence import Sequence
from toolkit.settings import DEFAULTS, Settings

OUTPUTS: tuple[Output, ...] = ("causal", "final")
# Equal stretches of time that a recording is divided into.
STRETCHES = 40


@dataclass(frozen=True, eq=False)
class Unit:
    """What to run. ``recording`` may be prepared already; ``entry`` is the estimator where it is not found by its name.

    ``build`` is a function in the place of an estimator that can be found. ``keep_run`` asks for the run itself with
    its trajectories and landmarks, not for its scores alone; ``keep_trajectories`` for the trajectories as the texts of
    files."""

    recording: Recording | Prepared
    seed: int
    estimator: str
    settings: Settings = DEFAULTS
    build: Build | None = None
    keep_run: bool = False
    keep_trajectories: bool = False
    entry: EstimatorEntry | None = None

    @property
    def requested(self) -> Recording:
        return self.recording.recording if isinstance(self.recording, Prepared) else self.recording


def no_stretches() -> Array:
    return np.full(STRETCHES, np.nan)


@dataclass(frozen=True, eq=False)
class Scored:
    """One output's scores, and at each frame (K,) its pose NEES over 6 and its position error, NaN where unknown.

    ``nis_dof`` is how many degrees of freedom of the mean NIS are independent, None where there is no NIS.
    ``drift_m`` and ``heldout_px`` (40,) are errors over equal stretches of time, whose pairs are compared where there
    is one recording only.
    """

    scores: Scores
    nees_pose: Array
    position_m: Array
    nis_dof: float | None = None
    drift_m: Array = field(default_factory=no_stretches)
    heldout_px: Array = field(default_factory=no_stretches)


@dataclass(frozen=True, eq=False)
class Outcome:
    """The result of one estimator under one seed; ``outputs`` lacks the kinds of output it did not give.

    ``sequence_hash`` is that of the recording it read; ``run`` is there where it was asked for. ``final_is_causal``
    tells that the final output only repeats the causal one, as a filter's does. ``tum`` has, where they are to be kept,
    the trajectories as texts; once they are written ``files`` has the SHA-256 of each by its path in the run directory.
    """

    seed: int
    estimator: str
    status: Status
    outputs: Mapping[Output, Scored] = field(default_factory=dict)
    log: tuple[str, ...] = ()
    sequence_hash: str = ""
    final_is_causal: bool = False
    run: Run | None = None
    tum: Mapping[Output, str] = field(default_factory=dict)
    files: Mapping[str, str] = field(default_factory=dict)

    @property
    def why(self) -> str:
        """Return in one line why the run did not end well; nothing where it did, or its log does not say."""
        if self.status == "ok" or not self.log:
            return ""
        # A run that failed begins with the reason; the runner appends what diverged to the estimator's log.
        return " ".join(self.log[0 if self.status == "failed" else -1].split())


def run_unit(unit: Unit, progress: Progress) -> Outcome:
    """Run the estimator of a unit and score its outputs.

    Raises DataError where the recording cannot be used, EstimatorError where the estimator cannot be used. A recording
    that planted faults make unusable is a run that failed.
    """
    try:
        prepared = prepared_of(unit)
        run = run_estimator(unit, prepared, progress)
    except DataError as error:
        if not unit.requested.faults:
            raise
        return Outcome(unit.seed, unit.estimator, "failed", log=(str(error),))
    requested = unit.settings.metrics.requested()
    outcome = outcome_of(run, prepared.sequence, unit.seed, requested)
    kept = {output: run.trajectory(output) for output in OUTPUTS} if unit.keep_trajectories else {}
    texts = {output: tum.text(trajectory) for output, trajectory in kept.items() if trajectory is not None}
    return replace(outcome, run=run if unit.keep_run else None, tum=texts)


def prepared_of(unit: Unit) -> Prepared:
    return unit.recording if isinstance(unit.recording, Prepared) else prepare_once(unit.recording)


def recording_to_prepare(unit: Unit) -> Recording | None:
    """Return the recording that has to be prepared for a unit, which the units of other estimators share."""
    return None if isinstance(unit.recording, Prepared) else unit.recording


def run_estimator(unit: Unit, prepared: Prepared, progress: Progress) -> Run:
    build = unit.build or (unit.entry or find(unit.estimator)).load()
    return runner.run(unit.estimator, build, prepared.sequence, prepared.prior, progress, unit.settings)


def outcome_of(run: Run, sequence: Sequence, seed: int, requested: tuple[str, ...] = ()) -> Outcome:
    """Score every output of a run; ``requested`` names the metrics on request that are asked for."""
    given = [output for output in OUTPUTS if run.trajectory(output) is not None]
    if run.final_is_causal:
        causal = _scored(run, "causal", sequence, requested)
        outputs: dict[Output, Scored] = {"causal": causal, "final": replace(causal, scores=repeated(causal.scores))}
    else:
        outputs = {output: _scored(run, output, sequence, requested) for output in given}
    return Outcome(seed, run.estimator, run.status, outputs, run.log, sequence.content_hash(), run.final_is_causal, run)


def _scored(run: Run, output: Output, sequence: Sequence, requested: tuple[str, ...]) -> Scored:
    evaluation = Evaluation(run, output, sequence)
    nees_pose, position_m = (np.full(sequence.frame_count, np.nan) for _ in range(2))
    nis_dof = None
    with np.errstate(all="ignore"):  # a diverged run overflows, as in score_run
        with suppress(Unavailable):  # the scores have the reason
            errors = body_errors(evaluation)
            _put(position_m, sequence.frames_t_ns, errors.t_ns, errors.distance_m)
            nees = nees_over_time(evaluation)
            _put(nees_pose, sequence.frames_t_ns, nees.t_ns, nees.pose)
        with suppress(Unavailable):
            nis_dof = nis_over_time(evaluation).independent_dof
        drift_m, heldout_px = drift_over_stretches(evaluation), held_out_over_stretches(evaluation)
    return Scored(scores_of(evaluation, requested), nees_pose, position_m, nis_dof, drift_m, heldout_px)


def _put(series: Array, frames_t_ns: IntArray, t_ns: IntArray, values: Array) -> None:
    """Enter values (n,) at stamps (n,) into a series (K,) by frame; stamps of no frame are left out."""
    row, is_frame = rows_of(t_ns, frames_t_ns)
    series[row[is_frame]] = values[is_frame]


def drift_over_stretches(evaluation: Evaluation) -> Array:
    """Return how far an estimate drifts against the truth over each stretch (40,) m, NaN where it lacks an end of it.

    That is the error of the motion from its first pose to its last, for which nothing is aligned.
    """
    try:
        pairs = evaluation.compared
    except Unavailable:
        return no_stretches()
    first_ns, last_ns = evaluation.sequence.frames_t_ns[[0, -1]].tolist()
    ends_ns = np.linspace(first_ns, last_ns, STRETCHES + 1)
    row = np.rint(np.interp(ends_ns, pairs.t_ns, np.arange(len(pairs)))).astype(int)
    near = np.abs(pairs.t_ns[row] - ends_ns) < 0.5 * (ends_ns[1] - ends_ns[0])
    drift_m = np.linalg.norm(drift_in_body(pairs.truth[row], pairs.estimate[row]), axis=1)
    return np.where(near[:-1] & near[1:], drift_m, np.nan)


def drift_in_body(truth: Array, estimate: Array) -> Array:
    """Return how far the motion between neighbouring poses (K + 1, 4, 4) is off, (K, 3) m in the body at its begin."""
    true_step, step = (se3_inverse(poses[:-1]) @ poses[1:] for poses in (truth, estimate))
    return np.asarray(step[:, :3, 3] - true_step[:, :3, 3])


def held_out_over_stretches(evaluation: Evaluation) -> Array:
    """Return the median error of withheld tracks in each stretch (40,) px, NaN where there is none."""
    rows, errors_px = evaluation.held_out_errors
    t_s = evaluation.sequence.frames_s
    stretch = (STRETCHES * t_s[evaluation.sequence.held_out.frame[rows]] / t_s[-1]).astype(int).clip(max=STRETCHES - 1)
    return np.array([np.median(errors_px[of]) if (of := stretch == k).any() else np.nan for k in range(STRETCHES)])
