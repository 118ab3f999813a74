"""One trial: the recording of one seed, read by several estimators, each scored as in a single comparison."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np

from toolkit import runner
from toolkit.audit import audit
from toolkit.datasets import load_sequence
from toolkit.estimate import Output, Run, Status
from toolkit.estimator import find
from toolkit.geometry import Array, IntArray
from toolkit.metrics import Evaluation, Scores, score_run
from toolkit.metrics._shared.consistency import body_errors, nees_over_time
from toolkit.metrics._shared.scores import Unavailable
from toolkit.progress import SILENT
from toolkit.sequence import Prior, Sequence

OUTPUTS: tuple[Output, ...] = ("causal", "final")


@dataclass(frozen=True)
class Trial:
    """What to run under one seed. ``start`` gives the prior of every estimator; ``keep`` is for the audit."""

    source: str
    seed: int
    estimators: tuple[str, ...]
    start: Callable[[Sequence], Prior]
    max_frames: int | None = None
    keep: frozenset[str] = frozenset()


@dataclass(frozen=True, eq=False)
class Scored:
    """One output's scores, and at each frame (K,) its pose NEES over 6 and its position error, NaN where unknown."""

    scores: Scores
    nees_pose: Array
    position_m: Array


@dataclass(frozen=True, eq=False)
class Outcome:
    """How one estimator fared under one seed; ``outputs`` lacks the kinds of output it did not give.

    ``sequence_hash`` is that of the recording it read.
    """

    seed: int
    estimator: str
    status: Status
    outputs: Mapping[Output, Scored] = field(default_factory=dict)
    log: tuple[str, ...] = ()
    sequence_hash: str = ""


def sequence_of(trial: Trial) -> Sequence:
    """Return the trial's recording as the estimators read it: audited and cut."""
    sequence = audit(load_sequence(trial.source, trial.seed), trial.keep).sequence
    return sequence if trial.max_frames is None else sequence.truncated(trial.max_frames)


def run_trial(trial: Trial) -> Iterator[Outcome]:
    """Run the estimators one after the other; yield each outcome as it is there."""
    sequence = sequence_of(trial)
    prior, sequence_hash = trial.start(sequence), sequence.content_hash()
    for name in trial.estimators:
        run = runner.run(name, find(name).load(), sequence, prior, SILENT)
        outputs = {output: _scored(run, output, sequence) for output in OUTPUTS if run.trajectory(output) is not None}
        yield Outcome(trial.seed, name, run.status, outputs, run.log, sequence_hash)


def _scored(run: Run, output: Output, sequence: Sequence) -> Scored:
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
    return Scored(score_run(run, output, sequence), nees_pose, position_m)


def _put(series: Array, frames_t_ns: IntArray, t_ns: IntArray, values: Array) -> None:
    """Enter values (n,) at stamps (n,) into a series (K,) by frame; what belongs to no frame is left out."""
    row = np.minimum(np.searchsorted(frames_t_ns, t_ns), frames_t_ns.size - 1)
    same = frames_t_ns[row] == t_ns
    series[row[same]] = values[same]
