"""Run the cases of a baseline in parallel processes, and collect the results by estimator, metric and seed.

A run's processor time is divided by that of a reference workload before and after it, which measures the present speed
of the machine in the operations of estimators: small dense updates in NumPy, a joint filter's matrix products, and
preintegration and elimination in GTSAM. The ratio may be compared between machines and days.
"""

import os
import time
from collections.abc import Iterable
from collections.abc import Sequence as Several
from contextlib import closing
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import gtsam
import numpy as np

from toolkit.answers import Output
from toolkit.datasets import is_built_in
from toolkit.errors import EstimatorError, VislamError
from toolkit.experiment.recording import Recording, prepare
from toolkit.experiment.units import (
    OUTPUTS,
    Outcome,
    Unit,
    outcome_of,
    prepared_of,
    recording_to_prepare,
    run_estimator,
)
from toolkit.experiment.workers import LostUnit, results_of
from toolkit.gate.baseline import COVERAGE, BoundsRecord, Case, Measured, SeriesRecord, Values
from toolkit.geometry import Array
from toolkit.progress import Progress, ProgressFor
from toolkit.registry import find
from toolkit.settings import Settings

DATA_ROOT = "VISLAM_DATA"
# A fingerprint is a hash that survives another processor's rounding: a simulation differs there in its last bits, since
# numeric libraries choose other instructions. Of the content rounded to so many digits of each array's largest value so
# many hexadecimal digits are kept: with a chance below 1e-4 a sequence it is another one for the same content, and any
# other change of a measurement by more than one part in a million shows.
_DIGITS, _LENGTH = 6, 16
_UPDATES, _JOINT, _SAMPLES, _POSES = 30, 20, 1500, 100


@dataclass(frozen=True, eq=False)
class TimedOutcome:
    """An outcome with its processor time over the reference workload's, and the fingerprint of what was read."""

    outcome: Outcome
    speed: float | None = None
    fingerprint: str = ""


def recordings_of(case: Case, settings: Settings) -> list[Recording]:
    """Return the recording of a case under each of its seeds.

    Paths are made absolute here: a process that reads them may have another working directory and environment.
    """
    source, truth = located(case.source), None if case.truth is None else Path(located(case.truth))
    return [Recording.under(settings, source, seed, truth=truth, duration_s=case.duration_s) for seed in case.seeds]


def located(source: str) -> str:
    """Return the absolute path of a source (:func:`place_of`); a built-in name, or a path to nothing, unchanged."""
    place = None if is_built_in(source) else place_of(source)
    return source if place is None else str(place.absolute())


def place_of(path: str) -> Path | None:
    """Return where a path leads, from here or from the folder VISLAM_DATA; None where nothing is."""
    root, here = os.environ.get(DATA_ROOT), Path(path).expanduser()
    places = [here] if root is None else [here, Path(root).expanduser() / path]
    return next((place for place in places if place.exists()), None)


def measure(case: Case, bounds: BoundsRecord, settings: Settings, workers: int, progress_for: ProgressFor) -> Measured:
    """Run every estimator of a case under every seed, for the metrics that have bounds.

    An estimator that is not there is ``absent``, a sequence that cannot be read ``unreadable``; neither is raised as an
    error, because a check reports everything that is missing.
    """
    absent = {name: why for name in case.estimators if (why := _why_absent(name))}
    present = replace(case, estimators=tuple(name for name in case.estimators if name not in absent))
    recordings, entries = recordings_of(present, settings), {name: find(name) for name in present.estimators}
    units = [
        Unit(recording, recording.seed, name, settings, entry=entry)
        for recording in recordings
        for name, entry in entries.items()
    ]
    try:
        if units:  # read anew, whatever this process kept of an earlier check
            prepare(recordings[0])
        with (
            progress_for(f"{case.source}: {len(case.seeds) * len(case.estimators)} runs") as progress,
            closing(results_of(units, workers, timed, progress, recording_to_prepare)) as coming,
        ):
            found = [
                _failed(units[place].estimator, units[place].seed, one.why) if isinstance(one, LostUnit) else one
                for place, one in coming
            ]
    except EstimatorError:
        raise
    except VislamError as error:
        return Measured((), (), {}, absent, unreadable=str(error))
    metrics = (*(bounds.simulated if case.simulated else bounds.recorded), COVERAGE)
    return gathered(present, found, metrics, absent)


def timed(unit: Unit, progress: Progress) -> TimedOutcome:
    """Run and score the estimator of a unit between two reference workloads."""
    prepared = prepared_of(unit)
    reference_s()  # the first one finds cold caches and is not counted
    before_s = reference_s()
    run = run_estimator(unit, prepared, progress)
    reference = (before_s + reference_s()) / 2.0
    outcome = replace(outcome_of(run, prepared.sequence, unit.seed), run=None)
    timings = run.timings if run.status in ("ok", "diverged") else None  # one that failed ended early
    speed = None if timings is None else timings.cpu_s / reference
    return TimedOutcome(outcome, speed, prepared.sequence.content_hash(_DIGITS)[:_LENGTH])


def gathered(case: Case, found: Iterable[TimedOutcome], metrics: Several[str], absent: dict[str, str]) -> Measured:
    """Arrange outcomes, which come in any order, by estimator and seed; keep the metrics of interest."""
    by_run = {(one.outcome.estimator, one.outcome.seed): one for one in found}
    read = {one.outcome.seed: one for one in by_run.values() if one.outcome.sequence_hash}
    hashes = tuple(read[seed].outcome.sequence_hash if seed in read else "" for seed in case.seeds)
    prints = tuple(read[seed].fingerprint if seed in read else "" for seed in case.seeds)
    by_name = {
        name: [by_run.get((name, seed)) or _failed(name, seed, "it was not run") for seed in case.seeds]
        for name in case.estimators
    }
    runs = {name: _series(ended, metrics) for name, ended in by_name.items()}
    why = {name: next(filter(None, (one.outcome.why for one in ended)), "") for name, ended in by_name.items()}
    return Measured(hashes, prints, runs, absent, why=why)


def _failed(estimator: str, seed: int, why: str) -> TimedOutcome:
    return TimedOutcome(Outcome(seed, estimator, "failed", log=(why,)))


def _why_absent(name: str) -> str:
    try:
        find(name).load()
    except EstimatorError as error:
        return str(error)
    return ""


def _series(found: Several[TimedOutcome], metrics: Several[str]) -> SeriesRecord:
    """Return the series of one estimator; a final output that only repeats the causal one is left out."""
    outcomes = [one.outcome for one in found]
    outputs = [
        {o: s.scores.values for o, s in one.outputs.items() if not (o == "final" and one.final_is_causal)}
        for one in outcomes
    ]
    given: list[Output] = [output for output in OUTPUTS if any(output in one for one in outputs)]
    values: dict[Output, dict[str, Values]] = {
        output: {key: tuple(one.get(output, {}).get(key) for one in outputs) for key in metrics} for output in given
    }
    # A metric without any value, as a NEES without a covariance, is not kept: no check can find it missing.
    kept = {o: {key: v for key, v in by_key.items() if any(x is not None for x in v)} for o, by_key in values.items()}
    status, speed = tuple(one.status for one in outcomes), tuple(one.speed for one in found)
    return SeriesRecord(status=status, speed=speed, **kept)


def reference_s() -> float:
    """Return the seconds of processor time the reference workload takes now: some 20 ms on a core of 2023."""
    roots, jacobians, joint = _problem()
    began = time.process_time()
    _small_updates(roots, jacobians)
    _joint_updates(joint)
    _preintegrate()
    _eliminate()
    return time.process_time() - began


@cache
def _problem() -> tuple[Array, Array, Array]:
    rng = np.random.default_rng(0)
    joint = rng.standard_normal((150, 150))
    return rng.standard_normal((64, 3, 3)), rng.standard_normal((64, 3, 6)), joint @ joint.T + 150.0 * np.eye(150)


def _small_updates(roots: Array, jacobians: Array) -> None:
    """Correct 64 landmarks and the pose they are seen from, as a decoupled filter does in a frame."""
    for _ in range(_UPDATES):
        covs = roots @ np.swapaxes(roots, 1, 2) + np.eye(3)
        weighted = np.swapaxes(jacobians, 1, 2) @ np.linalg.inv(covs)
        np.linalg.solve((weighted @ jacobians).sum(axis=0) + np.eye(6), np.ones(6))


def _joint_updates(joint: Array) -> None:
    rows = joint[:30]
    for _ in range(_JOINT):
        gain = np.linalg.solve(rows[:, :30] + np.eye(30), rows)
        joint - rows.T @ gain


def _preintegrate() -> None:
    imu = gtsam.PreintegratedCombinedMeasurements(gtsam.PreintegrationCombinedParams.MakeSharedU(9.81))
    accel, gyro = np.array([0.1, 0.2, 9.8]), np.array([0.01, -0.02, 0.3])
    for _ in range(_SAMPLES):
        imu.integrateMeasurement(accel, gyro, 0.005)


def _eliminate() -> None:
    """Optimise a chain of poses with a loop every tenth."""
    noise, step = gtsam.noiseModel.Isotropic.Sigma(6, 0.1), gtsam.Pose3(gtsam.Rot3.Rz(0.1), np.array([1.0, 0.0, 0.0]))
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    graph.add(gtsam.PriorFactorPose3(0, gtsam.Pose3(), noise))
    pose = gtsam.Pose3()
    for k in range(_POSES):
        values.insert(k, pose)
        pose = pose.compose(step)
        for back in (1, 10):
            if k >= back:
                between = gtsam.Pose3()
                for _ in range(back):
                    between = between.compose(step)
                graph.add(gtsam.BetweenFactorPose3(k - back, k, between, noise))
    gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
