"""The promises of every estimator as checks, for ``vislam verify`` and for the contract tests.

Reading order: which estimator, a run of it that is watched, what each promise looks for, and all checks one after the
other: passed, failed with what to do, or not applicable. What looks for a violation returns a sentence about it, or an
empty text.
"""

import hashlib
import importlib
import os
import re
import traceback
import warnings
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import TimeoutError as TookTooLong
from dataclasses import dataclass, fields, is_dataclass, replace
from functools import partial
from itertools import chain, zip_longest
from pathlib import Path
from types import ModuleType
from typing import Annotated, Literal

import numpy as np
from loky import ProcessPoolExecutor
from loky.process_executor import BrokenProcessPool
from msgspec import Meta, Struct

from toolkit import runner
from toolkit.answers import Run, checked_estimate, checked_finish
from toolkit.discovery import FoundModule, shown_name
from toolkit.errors import EstimatorError, SystemLimitError, in_words, one_line
from toolkit.estimate import Estimate, Finished
from toolkit.estimator import Build, Setup
from toolkit.experiment.recording import Recording, prepare
from toolkit.experiment.workers import how_it_ended
from toolkit.geometry import Array, IntArray
from toolkit.measurements import Packet
from toolkit.metrics import Evaluation, Unavailable
from toolkit.metrics.parts.consistency import POSE_DOF, nees_band, nees_over_time
from toolkit.progress import SILENT, Progress
from toolkit.registry import EstimatorEntry, cannot_import, discover, find
from toolkit.sequence import Sequence
from toolkit.simulation import DRIVE, DRIVE_IMU, FLIGHT, Scenario, faults, simulate
from toolkit.threads import THREAD_VARIABLES

_MODULE = re.compile(r"\w+(\.\w+)+")
# Rounding of some hundred products of rotations.
_ROTATION_TOLERANCE = 1e-12
# Of a product that is symmetric but for rounding, in units of the standard deviations.
_SYMMETRY_TOLERANCE = 1e-9
# False alarm rate of the test of mean NEES.
_FALSE_ALARM = 1e-3
SEED = 4
DURATION_S, MAX_TRACKS = 6.0, 40
SEEDS, _NEES_DURATION_S = 8, 10.0
_FEWEST_NEES = 2
# Of the runs on one thread and on two, and how long the process of one may take.
UNAVAILABLE = "unavailable"
_THREADS_DURATION_S, _TIMEOUT_S = 0.8, 600
Result = Literal["passed", "failed", "not applicable"]


class _OwnModule(FoundModule):
    """A module that no package announces, as ``my_package.my_filter``."""

    def load(self) -> ModuleType:
        try:
            return importlib.import_module(self.module)
        except (Exception, SystemExit) as error:  # a script may end where it is imported
            raise cannot_import(self.module, error) from error


def subject_of(word: str) -> EstimatorEntry:
    """Return the estimator that an argument names: ``my_filter.py``, ``my_package.my_filter`` or ``ekf``.

    Raises EstimatorError where it names nothing.
    """
    if _MODULE.fullmatch(word) and not word.endswith(".py") and word not in discover():
        return EstimatorEntry(shown_name(word), _OwnModule(word, Path(word)))
    return find(word)


@dataclass(frozen=True, eq=False)
class Watched:
    """One run over a recording: setup, packets, every answer and the result of ``finish``, with copies of each."""

    build: Build
    sequence: Sequence
    setup: Setup
    packets: tuple[Packet, ...]
    given_copies: tuple[Array, ...]
    online: tuple[Estimate | None, ...]
    online_copies: tuple[tuple[Array, ...], ...]
    finished: Finished


def setup_of(sequence: Sequence) -> Setup:
    assert sequence.prior is not None
    return runner.setup_of(sequence, sequence.prior)


def watch(build: Build, sequence: Sequence) -> Watched:
    """Run an estimator over a recording from its own prior; whatever the estimator raises passes through.

    Raises EstimatorError where an answer is none that the runner takes.
    """
    setup, packets = setup_of(sequence), tuple(sequence.packets())
    given_copies = _copies_of((setup, packets))
    estimator, online, online_copies = build(setup), list[Estimate | None](), list[tuple[Array, ...]]()
    last: Estimate | None = None
    for packet in packets:
        online.append(checked_estimate(estimator.step(packet), packet, last))
        online_copies.append(_copies_of(online[-1]))
        last = last if online[-1] is None else online[-1]
    finished = checked_finish(estimator.finish(), sequence.frames_t_ns, last is not None)
    return Watched(build, sequence, setup, packets, given_copies, tuple(online), tuple(online_copies), finished)


def declines(build: Build, sequence: Sequence) -> str:
    """Return why an estimator declines an input, by an EstimatorError before it has answered for the first motion."""
    try:
        for index, _ in enumerate(answers(build, sequence)):
            if index == 1:
                break
    except EstimatorError as error:
        return str(error)
    except Exception:  # anybody's code, which may raise anything; to run it again tells what
        return ""
    return ""


def answers(build: Build, sequence: Sequence) -> Iterator[Estimate | None]:
    estimator = build(setup_of(sequence))
    for packet in sequence.packets():
        yield estimator.step(packet)


def arrays_of(value: object) -> Iterator[Array]:
    for _, array in _named_arrays(value, ""):
        yield array


def _named_arrays(value: object, name: str) -> Iterator[tuple[str, Array]]:
    if isinstance(value, np.ndarray):
        yield name, value
    elif isinstance(value, tuple):
        for item in value:
            yield from _named_arrays(item, name)
    elif is_dataclass(value) and not isinstance(value, type):
        for field in fields(value):
            yield from _named_arrays(getattr(value, field.name), field.name)


def _copies_of(value: object) -> tuple[Array, ...]:
    return tuple(array.copy() for array in arrays_of(value))


def look_ahead(watched: Watched) -> str:
    for count in (2, len(watched.online) // 2):
        early = answers(watched.build, watched.sequence.truncated(count))
        for k, (answer, full) in enumerate(zip(early, watched.online, strict=False)):
            if found := difference(answer, full):
                where = f"its answer to frame {k} differs where the packets from frame {count} on are withheld"
                return f"{where}: {found}"
    return ""


def other_answers(first: Watched) -> str:
    """Say at which frame a second run over the same packets gives another answer."""
    estimator = first.build(first.setup)
    for k, (packet, before) in enumerate(zip(first.packets, first.online, strict=True)):
        if found := difference(estimator.step(packet), before):
            return f"a second run differs at frame {k}: {found}"
    found = difference(estimator.finish(), first.finished)
    return f"a second run has another final result: {found}" if found else ""


def difference(one: Estimate | Finished | None, other: Estimate | Finished | None) -> str:
    """Say how two answers differ; empty where all bits are the same."""
    if (one is None) != (other is None):
        return "one run returns an estimate and the other does not"
    pairs = list(zip_longest(_named_arrays(one, ""), _named_arrays(other, "")))
    if any(left is None or right is None or left[1].shape != right[1].shape for left, right in pairs):
        return "other fields or shapes"
    for (name, left), (_, right) in pairs:
        if not np.array_equal(left, right, equal_nan=True):
            return f"{name} differs by {_largest(left, right):.3g} at most"
    ours, theirs = (dict(answer.info) if isinstance(answer, Estimate) else {} for answer in (one, other))
    same = ours.keys() == theirs.keys() and all(
        np.array_equal(value, theirs[key], equal_nan=True) for key, value in ours.items()
    )
    return "" if same else "its diagnostics (info) differ"


def _largest(left: Array, right: Array) -> float:
    with np.errstate(all="ignore"):
        return float(np.nanmax(np.abs(left - right), initial=0.0))


def changed_later(watched: Watched) -> str:
    for k, (answer, copies) in enumerate(zip(watched.online, watched.online_copies, strict=True)):
        for array, copy in zip(arrays_of(answer), copies, strict=True):
            if not np.array_equal(array, copy, equal_nan=True):
                return f"its answer to frame {k} changed after it was given, by {_largest(array, copy):.3g}"
    return ""


def touched(watched: Watched) -> str:
    given = (watched.setup, watched.packets)
    for array, copy in zip(arrays_of(given), watched.given_copies, strict=True):
        if not np.array_equal(array, copy, equal_nan=True):
            return f"it wrote into what it was given: an array of shape {array.shape} has changed"
    return ""


def not_finite(watched: Watched) -> str:
    final = watched.finished.trajectory
    for name in ("T_world_imu", "v_world", "bias"):
        of_frames = [None if answer is None else getattr(answer, name) for answer in watched.online]
        finals = getattr(final, name)
        for values, where in ((of_frames, "answer to frame {}"), (finals, "final trajectory, state {},")):
            for k, value in enumerate(() if values is None else values):
                if value is not None and not np.isfinite(value).all():
                    return f"{name} of its {where.format(k)} is not finite"
    points = watched.finished.landmarks.points_world
    return "" if np.isfinite(points).all() else "a landmark of its map is not finite"


def unsound_covariance(watched: Watched) -> str:
    """Say which covariance is not finite, not symmetric or not positive definite."""
    landmarks = watched.finished.landmarks.cov
    of_landmarks = ((f"landmark {i}", cov) for i, cov in enumerate(() if landmarks is None else landmarks))
    found = ((where, covariance_fault(cov)) for where, cov in chain(_stated(watched), of_landmarks))
    return next((f"the covariance of {where} {fault}" for where, fault in found if fault), "")


def _stated(watched: Watched) -> Iterator[tuple[str, Array]]:
    for k, answer in enumerate(watched.online):
        if answer is not None and answer.cov is not None:
            yield f"its answer to frame {k}", answer.cov
    finals = watched.finished.trajectory.cov
    for k, cov in enumerate(() if finals is None else finals):
        yield f"its final state {k}", cov


def covariance_fault(cov: Array) -> str:
    """Say what is wrong with a covariance (d, d); nothing where it is sound.

    Units differ by orders of magnitude: what must be positive definite is the matrix of correlations.
    """
    if not np.isfinite(cov).all():
        return "is not finite"
    variances = np.diagonal(cov)
    if (variances <= 0.0).any():
        return f"has the variance {variances.min():.3g} in row {int(variances.argmin())}"
    sigmas = np.sqrt(variances)
    correlations = cov / np.outer(sigmas, sigmas)
    off = _largest(correlations, correlations.T)
    if off > _SYMMETRY_TOLERANCE:
        return f"is not symmetric: it differs from its transpose by {off:.3g} times the standard deviations"
    least = float(np.linalg.eigvalsh(correlations)[0])
    return "" if least > 0.0 else f"is not positive definite: its least eigenvalue is {least:.3g} times its scale"


def no_rotation(watched: Watched) -> str:
    poses = [answer.T_world_imu for answer in watched.online if answer is not None]
    stacked = np.concatenate([np.array(poses).reshape(-1, 4, 4), watched.finished.trajectory.T_world_imu])
    rotations = stacked[:, :3, :3]
    with np.errstate(all="ignore"):
        off = np.abs(rotations @ np.swapaxes(rotations, 1, 2) - np.eye(3)).max(axis=(1, 2))
    bad = np.flatnonzero(~(off < _ROTATION_TOLERANCE))
    return (
        "" if not bad.size else f"{bad.size} of {len(stacked)} rotations are none: R R^T is off by {off[bad].max():.3g}"
    )


def wrong_stamps(watched: Watched) -> str:
    """Say how many frames have no answer; that each has the stamp of its frame is checked where it is received."""
    frames_t_ns = watched.sequence.frames_t_ns
    silent = sum(answer is None for answer in watched.online)
    if silent not in (0, len(watched.online)):
        return f"it answers at {len(watched.online) - silent} of {len(watched.online)} frames; answer at each, or none"
    final = watched.finished.trajectory
    if np.array_equal(final.t_ns, frames_t_ns):
        return ""
    return f"its final trajectory has {len(final)} states, and there are {frames_t_ns.size} frames with their stamps"


def gave_up(run: Run, frames_t_ns: IntArray) -> str:
    """Say why a run did not go on to the end. A run that reports divergence with a reason did."""
    if run.status not in ("ok", "diverged"):
        return run.log[0] if run.log else f"it {run.status}"
    if run.status != "ok" and not run.log:
        return "it diverged and does not say why"
    if run.final is None:
        return "it has no final trajectory"
    for output, trajectory in (("causal", run.causal), ("final", run.final)):
        if trajectory is not None and not np.array_equal(trajectory.t_ns, frames_t_ns):
            return f"its {output} trajectory has {len(trajectory)} states, and there are {frames_t_ns.size} frames"
        if trajectory is not None and not np.isfinite(trajectory.T_world_imu).all():
            return f"its {output} trajectory is not finite"
    return ""


def inconsistency(nees_means: list[float]) -> str:
    """Say whether mean pose NEES over 6, one a run, are above or below a consistent estimator's by more than chance.

    The band is for poses of a run that share one error, the worst case, and holds 99.9 % of consistent estimators.
    """
    low, high = nees_band(POSE_DOF, len(nees_means), 1.0 - _FALSE_ALARM)
    mean = float(np.mean(nees_means))
    if low <= mean <= high:
        return ""
    how = "overconfident" if mean > high else "less certain than it could be"
    return (
        f"it is {how}: mean pose NEES {mean:.3g}, and {low:.2f} to {high:.2f} contains 99.9 % of consistent estimators"
    )


def digests_at(threads: int, estimators: tuple[str, ...]) -> dict[str, str]:
    """Run estimators in a process of its own, for threads are counted when the numeric libraries are loaded.

    Return a digest of all answers by "NAME on SCENARIO". Raises EstimatorError where the process does not end well,
    SystemLimitError where it cannot start.
    """
    # Idle threads sleep at once: spinning, they starve a busy machine.
    environment = dict.fromkeys(THREAD_VARIABLES, str(threads)) | {"OPENBLAS_THREAD_TIMEOUT": "4"}
    executor = ProcessPoolExecutor(1, env=environment)
    try:
        digests: dict[str, str] = executor.submit(_digests, threads, estimators).result(_TIMEOUT_S)
    except TookTooLong as error:
        raise EstimatorError(f"with {threads} threads it did not end within {_TIMEOUT_S} s") from error
    except BrokenProcessPool as error:
        raise EstimatorError(f"with {threads} threads its process {how_it_ended(error)}") from error
    except OSError as error:
        raise SystemLimitError(f"no process can be started ({error.strerror or error})") from error
    finally:
        executor.shutdown(wait=True, kill_workers=True)
    return digests


def _digests(threads: int, estimators: tuple[str, ...]) -> dict[str, str]:
    if hasattr(os, "sched_setaffinity"):  # read by GTSAM's thread pool
        os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:threads])
    digests = {}
    for scenario in (DRIVE, FLIGHT):
        sequence = simulate(replace(scenario, duration_s=_THREADS_DURATION_S), SEED)
        assert sequence.prior is not None
        for word in estimators:
            subject = subject_of(word)
            try:
                run = runner.run(subject.name, subject.load(), sequence, sequence.prior, SILENT)
            except EstimatorError:
                digests[f"{word} on {sequence.name}"] = UNAVAILABLE
                continue
            digest = hashlib.sha256()
            for array in arrays_of((run.causal, run.final, run.landmarks)):
                digest.update(array.tobytes())
            digests[f"{word} on {sequence.name}"] = digest.hexdigest()
    return digests


# Planted faults by a description for the user. Recordings are audited first, as before every comparison.
PLANTED_FAULTS: Mapping[str, Callable[[Sequence], Sequence]] = {
    "a fifth of the sightings lost": partial(faults.dropped_sightings, dose=0.2),
    "2 s without sightings": partial(faults.blackout, dose=2.0),
    "no sightings at all": partial(faults.dropped_sightings, dose=1.0),
    "one track a frame": partial(faults.few_tracks, dose=1.0),
    "30 % outlier tracks": faults.outlier_tracks,
    "sightings to one side only": faults.one_sided_view,
    "left and right swapped in a fifth of the tracks": partial(faults.swapped_images, dose=0.2),
    "0.5 s without motion samples": faults.motion_gap,
    "0.25 s that is not a number": faults.nan_span,
    "a clock that jumps back": faults.clock_jump,
    "a camera 20 ms late": faults.camera_clock,
    "a camera turned by 3 degrees": faults.turned_camera,
    "a gyro bias of 0.05 rad/s": partial(faults.gyro_bias, dose=0.05),
    "half the noise stated": partial(faults.wrong_noise, dose=0.5),
}


def short(scenario: Scenario, duration_s: float = DURATION_S) -> Scenario:
    """Return a scenario of a few seconds and forty tracks a frame, so that tracks begin and end and runs are short."""
    return replace(scenario, duration_s=duration_s, camera=replace(scenario.camera, max_tracks=MAX_TRACKS))


SCENARIOS: tuple[Scenario, ...] = (short(DRIVE, 4.0), short(DRIVE_IMU, 4.0), short(FLIGHT, 2.0))


def ends_by_fault(name: str, build: Build) -> dict[str, str]:
    """Return, by planted fault, why an estimator did not go on to the end; of an input that it declines, nothing."""
    found = {}
    for scenario in (DRIVE, FLIGHT):
        sound = simulate(short(scenario), SEED)
        if declines(build, sound):
            continue
        for fault, plant in PLANTED_FAULTS.items():
            prepared = prepare(Recording(plant(sound)))
            run = runner.run(name, build, prepared.sequence, prepared.prior, SILENT)
            if why := gave_up(run, prepared.sequence.frames_t_ns):
                found[f"{fault} ({scenario.name})"] = why
    return found


class CheckRecord(Struct, frozen=True, kw_only=True):
    """One promise and what came of it."""

    name: str
    result: Result
    found: Annotated[str, Meta(description="what broke it, or why it could not be had")]
    remedy: Annotated[str, Meta(description="what to do; empty where it is kept")]


class VerificationRecord(Struct, frozen=True, kw_only=True):
    """Every promise of an estimator."""

    schema: Literal["vislam.verification/1"]
    estimator: str
    passed: bool
    checks: tuple[CheckRecord, ...]


# Promises checked on one watched run: the function that finds a violation, and what to do about it.
OF_A_RUN: Mapping[str, tuple[Callable[[Watched], str], str]] = {
    "poses, velocities and biases are numbers": (
        not_finite,
        "look for a division by zero, a logarithm or square root of less than zero, an inverse of a singular "
        "matrix; raise EstimatorError where it cannot go on",
    ),
    "rotations are rotations": (
        no_rotation,
        "compose with se3_exp, so3_exp and products of rotations; project onto SO(3) after many of them",
    ),
    "an answer at each frame, with its stamp": (
        wrong_stamps,
        "answer with packet.frame.t_ns at every step, or with None at every one; finish() has a state for each frame",
    ),
    "causal: later packets change no earlier answer": (
        look_ahead,
        "use what step() was given so far alone: no packets kept from another run, no base of an array that reaches"
        " into later frames",
    ),
    "deterministic: a second run gives the same bits": (
        other_answers,
        "seed every random number in build(); keep nothing in the module or the class between runs",
    ),
    "an answer does not change after it was given": (
        changed_later,
        "return a copy of the state, not the array that the next step writes into",
    ),
    "setup and packets stay untouched": (touched, "copy an array before writing into it"),
}
_RUNS, _COVARIANCE = "it runs to the end", "covariances are finite, symmetric, positive definite"
_NEES, _THREADS = f"consistent: pose NEES over {SEEDS} seeds", "one thread and two give the same bits"
_TROUBLE = "it goes on through every planted fault"
_NO_COVARIANCE = "it states no covariance"
# What to do where a promise is broken.
_REMEDIES: Mapping[str, str] = {name: remedy for name, (_, remedy) in OF_A_RUN.items()} | {
    _RUNS: "see what is named: answer with packet.frame.t_ns and arrays of the shapes in docs/extending.md; raise "
    "EstimatorError, with the reason, where it cannot go on, and in build() for an input that it is not made for "
    "(setup.motion_kind)",
    _COVARIANCE: "symmetrise after every update, P = (P + P^T) / 2; look for a subtraction that may leave less than "
    "nothing; the pose comes first, rotation before position, in the body frame",
    _NEES: "above the band it is overconfident: add process noise, correlate landmarks with the pose, or take "
    "Jacobians at first estimates; below it, assume less noise; see docs/metrics.md",
    _THREADS: "sum in a fixed order; leave no result to which thread is first",
    _TROUBLE: "expect frames without sightings, negative disparities, gross outliers; recover and report it in "
    "Finished(log=...)",
}


def verify(subject: EstimatorEntry, word: str, progress: Progress = SILENT) -> VerificationRecord:
    """Check every promise of an estimator; ``word`` names it for checks in another process.

    Raises EstimatorError where it cannot be loaded.
    """
    build, steps = subject.load(), len(SCENARIOS) + 3
    with warnings.catch_warnings(), np.errstate(all="ignore"):  # NumPy's warnings add nothing to the checks
        warnings.simplefilter("ignore")
        watched, declined, raised = list[Watched](), dict[str, str](), ""
        for i, scenario in enumerate(SCENARIOS):
            progress.advance(i, steps, "runs")
            sequence = simulate(scenario, SEED)
            if why := declines(build, sequence):
                declined[sequence.name] = one_line(why)
                continue
            try:
                watched.append(watch(build, sequence))
            except Exception as error:  # anybody's code, which may raise anything
                raised = raised or f"{sequence.name}: {_error_message(error)}"
        # An estimator may decline inputs that it is not made for, but not all.
        whys = "; ".join(dict.fromkeys(declined.values()))
        if raised or len(declined) == len(SCENARIOS):
            checks = [_checked(_RUNS, "failed", raised or f"it declines every recording: {whys}")]
        else:
            told = f"not applicable to {', '.join(declined)}: {whys}" if declined else ""
            checks = [_checked(_RUNS, "passed", told)]
        if watched:
            checks += [_check(name, partial(_first, watched, broken)) for name, (broken, _) in OF_A_RUN.items()]
            if any(next(_stated(one), None) for one in watched):
                checks.append(_check(_COVARIANCE, partial(_first, watched, unsound_covariance)))
            else:
                checks.append(_checked(_COVARIANCE, "not applicable", _NO_COVARIANCE))
            progress.advance(len(SCENARIOS), steps, "NEES")
            checks.append(_consistent(subject.name, build, next(s for s in SCENARIOS if s.name not in declined)))
            progress.advance(len(SCENARIOS) + 1, steps, "threads")
            checks.append(_threads(word))
            progress.advance(len(SCENARIOS) + 2, steps, "faults")
            checks.append(_check(_TROUBLE, lambda: "; ".join(_causes(ends_by_fault(subject.name, build)))))
    return VerificationRecord(
        schema="vislam.verification/1",
        estimator=subject.name,
        passed=all(check.result != "failed" for check in checks),
        checks=tuple(checks),
    )


def _checked(name: str, result: Result, found: str = "") -> CheckRecord:
    return CheckRecord(name=name, result=result, found=found, remedy=_REMEDIES[name] if result == "failed" else "")


def _first(watched: list[Watched], broken: Callable[[Watched], str]) -> str:
    return next((f"{one.sequence.name}: {found}" for one in watched if (found := broken(one))), "")


def _check(name: str, find: Callable[[], str]) -> CheckRecord:
    try:
        found = find()
    except SystemLimitError:
        raise
    except Exception as error:  # anybody's code, which may raise anything
        found = _error_message(error)
    return _checked(name, "failed" if found else "passed", found)


def _error_message(error: Exception) -> str:
    if isinstance(error, EstimatorError):
        return one_line(str(error))
    *_, last = traceback.extract_tb(error.__traceback__)
    return in_words(error, f" in line {last.lineno} of {last.name}")


def _consistent(name: str, build: Build, scenario: Scenario) -> CheckRecord:
    """Judge the mean NEES of several draws, causal where there is a causal output."""
    means, why = list[float](), _NO_COVARIANCE
    for seed in range(SEEDS):
        sequence = simulate(short(scenario, _NEES_DURATION_S), seed)
        assert sequence.prior is not None
        run = runner.run(name, build, sequence, sequence.prior, SILENT)
        output: Literal["causal", "final"] = "final" if run.causal is None else "causal"
        if run.trajectory(output) is None:
            why = run.log[0] if run.log else "it gave no trajectory"
            continue
        try:
            means.append(float(nees_over_time(Evaluation(run, output, sequence)).pose.mean()))
        except Unavailable as lacking:
            why = str(lacking)
    if len(means) < _FEWEST_NEES:
        return _checked(_NEES, "not applicable", why)
    found = inconsistency(means)
    if not found and len(means) < SEEDS:
        found = f"{SEEDS - len(means)} of {SEEDS} seeds have none: {why}"
    return _checked(_NEES, "failed" if found else "passed", found or f"{np.mean(means):.2f}")


def _threads(word: str) -> CheckRecord:
    def differing() -> str:
        one, two = (digests_at(threads, (word,)) for threads in (1, 2))
        where = ", ".join(key.rpartition(" on ")[2] for key, digest in one.items() if two[key] != digest)
        return f"with two threads its answers differ in bits from those with one, on {where}" if where else ""

    try:
        return _check(_THREADS, differing)
    except SystemLimitError as error:
        return _checked(_THREADS, "not applicable", f"not checked: {error}")


def _causes(found: Mapping[str, str]) -> Iterator[str]:
    """Yield each cause once, whatever its numbers, with the faults that it follows."""
    by_cause: dict[str, list[str]] = {}
    for fault, why in found.items():
        by_cause.setdefault(re.sub(r"\d+", "", why), []).append(fault)
    for first, *others in by_cause.values():
        more = f" and {len(others)} more" if others else ""
        yield f"{first}{more}: {found[first]}"
