"""Every promise of one estimator, one after the other: passed, failed with what to do, or not applicable.

One promise is to go on through faults of a recording, which are planted by :mod:`toolkit.simulation.faults`.
"""

import re
import warnings
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Literal

import numpy as np

from toolkit import runner
from toolkit.errors import EstimatorError, SystemLimitError, in_words, one_line
from toolkit.estimator import Build
from toolkit.experiment.recording import Recording, prepare
from toolkit.metrics import Evaluation, Unavailable
from toolkit.metrics.parts.consistency import nees_over_time
from toolkit.progress import SILENT, Progress
from toolkit.sequence import Sequence
from toolkit.simulation import DRIVE, DRIVE_IMU, FLIGHT, Scenario, faults, simulate
from toolkit.verify import promises
from toolkit.verify.promises import Subject, Watched, gave_up, watch
from toolkit.verify.threads import differing_answers

SEED = 4
DURATION_S, MAX_TRACKS = 6.0, 40

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

Result = Literal["passed", "failed", "not applicable"]
SEEDS, _NEES_DURATION_S = 8, 10.0
_FEWEST_NEES = 2


def short(scenario: Scenario, duration_s: float = DURATION_S) -> Scenario:
    """Return a scenario of a few seconds and forty tracks a frame, so that tracks begin and end and runs are short."""
    return replace(scenario, duration_s=duration_s, camera=replace(scenario.camera, max_tracks=MAX_TRACKS))


SCENARIOS: tuple[Scenario, ...] = (short(DRIVE, 4.0), short(DRIVE_IMU, 4.0), short(FLIGHT, 2.0))


def ends_by_fault(name: str, build: Build) -> dict[str, str]:
    """Return, by planted fault, why an estimator did not go on to the end; of an input that it declines, nothing."""
    found = {}
    for scenario in (DRIVE, FLIGHT):
        sound = simulate(short(scenario), SEED)
        if promises.declines(build, sound):
            continue
        for fault, plant in PLANTED_FAULTS.items():
            prepared = prepare(Recording(plant(sound)))
            run = runner.run(name, build, prepared.sequence, prepared.prior, SILENT)
            if why := gave_up(run, prepared.sequence.frames_t_ns):
                found[f"{fault} ({scenario.name})"] = why
    return found


@dataclass(frozen=True)
class CheckedPromise:
    """One promise: its name, the result of the check, and what was found."""

    name: str
    result: Result
    found: str = ""

    @property
    def remedy(self) -> str:
        """Return what to do where it is broken."""
        return _REMEDIES[self.name] if self.result == "failed" else ""


@dataclass(frozen=True)
class Verification:
    """All checks of one estimator."""

    estimator: str
    checks: tuple[CheckedPromise, ...]

    @property
    def passed(self) -> bool:
        """Say whether no promise is broken."""
        return all(check.result != "failed" for check in self.checks)


# Promises checked on one watched run: the function that finds a violation, and what to do about it.
_OF_A_RUN: Mapping[str, tuple[Callable[[Watched], str], str]] = {
    "poses, velocities and biases are numbers": (
        promises.not_finite,
        "look for a division by zero, a logarithm or square root of less than zero, an inverse of a singular "
        "matrix; raise EstimatorError where it cannot go on",
    ),
    "rotations are rotations": (
        promises.no_rotation,
        "compose with se3_exp, so3_exp and products of rotations; project onto SO(3) after many of them",
    ),
    "an answer at each frame, with its stamp": (
        promises.wrong_stamps,
        "answer with packet.frame.t_ns at every step, or with None at every one; finish() has a state for each frame",
    ),
    "causal: later packets change no earlier answer": (
        promises.look_ahead,
        "use what step() was given so far alone: no packets kept from another run, no base of an array that reaches"
        " into later frames",
    ),
    "deterministic: a second run gives the same bits": (
        promises.other_answers,
        "seed every random number in build(); keep nothing in the module or the class between runs",
    ),
    "an answer does not change after it was given": (
        promises.changed_later,
        "return a copy of the state, not the array that the next step writes into",
    ),
    "setup and packets stay untouched": (promises.touched, "copy an array before writing into it"),
}
_RUNS, _COVARIANCE = "it runs to the end", "covariances are finite, symmetric, positive definite"
_NEES, _THREADS = f"consistent: pose NEES over {SEEDS} seeds", "one thread and two give the same bits"
_TROUBLE = "it goes on through every planted fault"
_NO_COVARIANCE = "it states no covariance"
# What to do where a promise is broken.
_REMEDIES: Mapping[str, str] = {name: remedy for name, (_, remedy) in _OF_A_RUN.items()} | {
    _RUNS: "see the line named; raise EstimatorError, with the reason, where it cannot go on, and in build() for an "
    "input that it is not made for (setup.motion_kind)",
    _COVARIANCE: "symmetrise after every update, P = (P + P^T) / 2; look for a subtraction that may leave less than "
    "nothing; the pose comes first, rotation before position, in the body frame",
    _NEES: "above the band it is overconfident: add process noise, correlate landmarks with the pose, or take "
    "Jacobians at first estimates; below it, assume less noise; see docs/metrics.md",
    _THREADS: "sum in a fixed order; leave no result to which thread is first",
    _TROUBLE: "expect frames without sightings, negative disparities, gross outliers; recover and report it in "
    "Finished(log=...)",
}


def verify(subject: Subject, word: str, progress: Progress = SILENT) -> Verification:
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
            if why := promises.declines(build, sequence):
                declined[sequence.name] = one_line(why)
                continue
            try:
                watched.append(watch(build, sequence))
            except Exception as error:  # anybody's code, which may raise anything
                raised = raised or f"{sequence.name}: {_error_message(error)}"
        checks = [_runs(raised, declined)]
        checks += _of_runs(watched) if watched else []
        if watched:
            progress.advance(len(SCENARIOS), steps, "NEES")
            checks.append(_consistent(subject.name, build, declined))
            progress.advance(len(SCENARIOS) + 1, steps, "threads")
            checks.append(_threads(word))
            progress.advance(len(SCENARIOS) + 2, steps, "faults")
            checks.append(_faults(subject.name, build))
    return Verification(subject.name, tuple(checks))


def _runs(raised: str, declined: Mapping[str, str]) -> CheckedPromise:
    """Judge how runs ended; an estimator may decline inputs that it is not made for, but not all."""
    whys = "; ".join(dict.fromkeys(declined.values()))
    if raised or len(declined) == len(SCENARIOS):
        return CheckedPromise(_RUNS, "failed", raised or f"it declines every recording: {whys}")
    return CheckedPromise(_RUNS, "passed", f"not applicable to {', '.join(declined)}: {whys}" if declined else "")


def _of_runs(watched: list[Watched]) -> Iterator[CheckedPromise]:
    for name, (broken, _) in _OF_A_RUN.items():
        yield _check(name, partial(_first, watched, broken))
    if any(promises.states_covariance(one) for one in watched):
        yield _check(_COVARIANCE, lambda: _first(watched, promises.unsound_covariance))
    else:
        yield CheckedPromise(_COVARIANCE, "not applicable", _NO_COVARIANCE)


def _first(watched: list[Watched], broken: Callable[[Watched], str]) -> str:
    for one in watched:
        if found := broken(one):
            return f"{one.sequence.name}: {found}"
    return ""


def _check(name: str, find: Callable[[], str]) -> CheckedPromise:
    try:
        found = find()
    except SystemLimitError:
        raise
    except Exception as error:  # anybody's code, which may raise anything
        found = _error_message(error)
    return CheckedPromise(name, "failed", found) if found else CheckedPromise(name, "passed")


def _error_message(error: Exception) -> str:
    if isinstance(error, EstimatorError):
        return one_line(str(error))
    frames = error.__traceback__
    while frames is not None and frames.tb_next is not None:
        frames = frames.tb_next
    where = "" if frames is None else f" in line {frames.tb_lineno} of {frames.tb_frame.f_code.co_name}"
    return in_words(error, where)


def _consistent(name: str, build: Build, declined: Collection[str]) -> CheckedPromise:
    """Judge the mean NEES of several draws, causal where there is a causal output."""
    taken = next((scenario for scenario in SCENARIOS if scenario.name not in declined), DRIVE)
    scenario, means = short(taken, _NEES_DURATION_S), list[float]()
    why = _NO_COVARIANCE
    for seed in range(SEEDS):
        sequence = simulate(scenario, seed)
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
        return CheckedPromise(_NEES, "not applicable", why)
    found = promises.inconsistency(means)
    if not found and len(means) < SEEDS:
        found = f"{SEEDS - len(means)} of {SEEDS} seeds have none: {why}"
    return CheckedPromise(_NEES, "failed", found) if found else CheckedPromise(_NEES, "passed", f"{np.mean(means):.2f}")


def _threads(word: str) -> CheckedPromise:
    try:
        return _check(_THREADS, lambda: differing_answers(word))
    except SystemLimitError as error:
        return CheckedPromise(_THREADS, "not applicable", f"not checked: {error}")


def _faults(name: str, build: Build) -> CheckedPromise:
    return _check(_TROUBLE, lambda: "; ".join(_causes(ends_by_fault(name, build))))


def _causes(found: Mapping[str, str]) -> Iterator[str]:
    """Yield each cause once, whatever its numbers, with the faults that it follows."""
    by_cause: dict[str, list[str]] = {}
    for fault, why in found.items():
        by_cause.setdefault(re.sub(r"\d+", "", why), []).append(fault)
    for first, *others in by_cause.values():
        more = f" and {len(others)} more" if others else ""
        yield f"{first}{more}: {found[first]}"
