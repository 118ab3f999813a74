"""A unit of work: one estimator on one recording, run and scored."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from toolkit import runner
from toolkit.answers import Output, Run, Status
from toolkit.arrays import rows_of
from toolkit.datasets.trajectories import tum
from toolkit.errors import DataError
from toolkit.estimator import Build
from toolkit.experiment.recording import Prepared, Recording, prepare_once
from toolkit.experiment.stretches import drift_over_stretches, held_out_over_stretches, no_stretches
from toolkit.geometry import Array, IntArray
from toolkit.metrics import Evaluation, Scores, repeated, scores_of
from toolkit.metrics.parts.consistency import body_errors, nees_over_time, nis_over_time
from toolkit.metrics.parts.scores import Unavailable
from toolkit.progress import Progress
from toolkit.registry import EstimatorEntry, find
from toolkit.sequence import Sequence
from toolkit.settings import DEFAULTS, Settings

OUTPUTS: tuple[Output, ...] = ("causal", "final")


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
        """Return the recording as it is asked for."""
        return self.recording.recording if isinstance(self.recording, Prepared) else self.recording


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
    texts = _trajectory_texts(run) if unit.keep_trajectories else {}
    return replace(outcome, run=run if unit.keep_run else None, tum=texts)


def _trajectory_texts(run: Run) -> dict[Output, str]:
    """Return the trajectories of a run as the texts of TUM files."""
    given = {output: run.trajectory(output) for output in OUTPUTS}
    return {output: tum.text(trajectory) for output, trajectory in given.items() if trajectory is not None}


def prepared_of(unit: Unit) -> Prepared:
    """Return a unit's recording, prepared."""
    return unit.recording if isinstance(unit.recording, Prepared) else prepare_once(unit.recording)


def recording_to_prepare(unit: Unit) -> Recording | None:
    """Return the recording that has to be prepared for a unit, which the units of other estimators share."""
    return None if isinstance(unit.recording, Prepared) else unit.recording


def run_estimator(unit: Unit, prepared: Prepared, progress: Progress) -> Run:
    """Run a unit's estimator over its prepared recording."""
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
    return Outcome(
        seed,
        run.estimator,
        run.status,
        outputs,
        run.log,
        sequence.content_hash(),
        run.final_is_causal,
        run,
    )


def _scored(run: Run, output: Output, sequence: Sequence, requested: tuple[str, ...]) -> Scored:
    evaluation = Evaluation(run, output, sequence)
    nees_pose, position_m = (np.full(sequence.frame_count, np.nan) for _ in range(2))
    with np.errstate(all="ignore"):  # a diverged run overflows, as in score_run
        try:
            errors = body_errors(evaluation)
            _put(position_m, sequence.frames_t_ns, errors.t_ns, errors.distance_m)
            nees = nees_over_time(evaluation)
            _put(nees_pose, sequence.frames_t_ns, nees.t_ns, nees.pose)
        except Unavailable:
            pass  # the scores have the reason
        drift_m, heldout_px = drift_over_stretches(evaluation), held_out_over_stretches(evaluation)
    return Scored(scores_of(evaluation, requested), nees_pose, position_m, _nis_dof(evaluation), drift_m, heldout_px)


def _nis_dof(evaluation: Evaluation) -> float | None:
    try:
        return nis_over_time(evaluation).independent_dof
    except Unavailable:
        return None


def _put(series: Array, frames_t_ns: IntArray, t_ns: IntArray, values: Array) -> None:
    """Enter values (n,) at stamps (n,) into a series (K,) by frame; stamps of no frame are left out."""
    row, is_frame = rows_of(t_ns, frames_t_ns)
    series[row[is_frame]] = values[is_frame]
