"""Run one estimator over one sequence: give it the packets, measure its time, keep both kinds of output.

Nothing here knows an estimator by name. A run is ``ok`` only when its estimates are finite, its solves converged,
its trajectory does not contradict the measured motion and its gate lets measurements pass; otherwise it says
``diverged`` or ``failed`` and why.
"""

import ctypes
import re
import resource
import sys
import time
import traceback
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from toolkit.answers import Run, Status, Timings, checked_estimate, checked_finish
from toolkit.divergence import contradiction, gate_collapse
from toolkit.errors import DataError, EstimatorError, in_words, one_line
from toolkit.estimate import Estimate, Landmarks, Trajectory
from toolkit.estimator import Build, Setup
from toolkit.geometry import Array
from toolkit.measurements import Prior, TwistChangeNoise
from toolkit.models.motion import motion_model
from toolkit.progress import SILENT, Progress
from toolkit.sequence import Sequence
from toolkit.settings import DEFAULTS, Scalar, Settings
from toolkit.threads import on_one_thread

# Biases that are fixed keep this share of the standard deviations of their start and walk: none of it matters, and with
# none at all covariances would have no inverse.
_HELD = 1e-3
# Linux: writing to this file resets the peak memory that is read here (proc(5)).
_RESETS_PEAK, _STATUS = Path("/proc/self/clear_refs"), Path("/proc/self/status")


@dataclass
class _Clock:
    """Measures wall clock and CPU of one run; the wall clock of each step apart.

    Building the estimator is not part of it: what a process imports and compiles once is no cost of a run.
    """

    def __post_init__(self) -> None:
        _count_memory_anew()
        self._wall, self._cpu = time.perf_counter(), time.process_time()
        self.steps: list[float] = []
        self.finish_s = 0.0

    def timings(self) -> Timings:
        total_s, cpu_s = time.perf_counter() - self._wall, time.process_time() - self._cpu
        return Timings(np.array(self.steps), self.finish_s, total_s, cpu_s, _peak_rss_mb())


def _count_memory_anew() -> None:
    """Return memory that the allocator keeps from earlier work, and reset the peak where the system allows it."""
    with suppress(OSError, AttributeError):
        ctypes.CDLL(None).malloc_trim(0)
    with suppress(OSError):
        _RESETS_PEAK.write_text("5", encoding="ascii")


def _peak_rss_mb() -> float:
    """Return the peak resident memory of this process; since the process began where it cannot be reset."""
    with suppress(OSError):
        peak = re.search(r"^VmHWM:\s+(\d+) kB$", _STATUS.read_text(encoding="ascii"), re.MULTILINE)
        if peak is not None:
            return int(peak[1]) * 1024 / 1e6
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 1e6


def run(
    name: str,
    build: Build,
    sequence: Sequence,
    prior: Prior,
    progress: Progress = SILENT,
    settings: Settings = DEFAULTS,
) -> Run:
    """Run an estimator over a sequence from a prior.

    Linear algebra runs on one thread meanwhile, so that the same bits and comparable times come out wherever it
    runs. An error inside the estimator ends its run, not the comparison: the run's status is ``failed`` and its
    log says why. Raises DataError where the sequence itself cannot be run.
    """
    with on_one_thread():
        return _run(name, build, sequence, prior, progress, settings)


def _run(name: str, build: Build, sequence: Sequence, prior: Prior, progress: Progress, settings: Settings) -> Run:
    packets = list(sequence.packets())
    setup = setup_of(sequence, prior, settings, settings.options_of(name), progress)
    clock, online = _Clock(), list[Estimate]()
    try:
        estimator = build(setup)
        clock = _Clock()
        for packet in packets:
            began = time.perf_counter()
            answer = estimator.step(packet)
            clock.steps.append(time.perf_counter() - began)
            estimate = checked_estimate(answer, packet, online[-1] if online else None)
            if estimate is not None:
                online.append(estimate)
            progress.advance(packet.index + 1, len(packets))
        began = time.perf_counter()
        finished = estimator.finish()
        clock.finish_s = time.perf_counter() - began
        checked_finish(finished, sequence.frames_t_ns, bool(online))
    except (DataError, KeyboardInterrupt, MemoryError):
        raise
    except (Exception, SystemExit) as error:
        if (interrupt := _interrupt_behind(error)) is not None:
            raise interrupt from None
        return _failed(name, online, clock.timings(), error)
    timings, causal = clock.timings(), Trajectory.of(online) if online else None
    status: Status = "ok"
    log = list(finished.log)
    if not finished.converged:
        status = "failed"
        log.insert(0, "the solve did not converge; its result is shown but is no estimate to rely on")
    run = Run(name, status, causal, finished.trajectory, finished.landmarks, timings, _info(online), tuple(log))
    return with_divergence(run, sequence)


def setup_of(
    sequence: Sequence,
    prior: Prior,
    settings: Settings = DEFAULTS,
    options: Mapping[str, Scalar] | None = None,
    progress: Progress = SILENT,
) -> Setup:
    """Return what an estimator knows of a sequence before the first packet, with the model of its motion."""
    noise = sequence.noise
    if settings.noise.biases == "fixed" and not isinstance(noise, TwistChangeNoise):
        noise, prior = noise.with_biases_held(_HELD), prior.with_biases_held(_HELD)
    return Setup(
        sequence.rig,
        noise,
        prior,
        sequence.gravity_world,
        sequence.motion_kind,
        motion_model(noise, sequence.gravity_world),
        settings,
        options or {},
        progress,
    )


def _interrupt_behind(error: BaseException | None) -> KeyboardInterrupt | None:
    while error is not None and not isinstance(error, KeyboardInterrupt):
        error = error.__cause__
    return error


def _failed(name: str, online: list[Estimate], timings: Timings, error: BaseException) -> Run:
    log = [f"failed after {len(online)} estimates: {_reason(error)}"]
    if not isinstance(error, EstimatorError):
        log += [line.rstrip() for line in traceback.format_exception(error)]
    causal = Trajectory.of(online) if online else None
    return Run(name, "failed", causal, None, Landmarks.none(), timings, _info(online), tuple(log))


def _reason(error: BaseException) -> str:
    if isinstance(error, EstimatorError):
        return one_line(str(error))
    if isinstance(error, np.linalg.LinAlgError):
        return (
            f"rounding left a matrix without a root or an inverse ({in_words(error)}); the usual cause is a "
            "stated noise far below the errors of the measurements: set a larger one "
            "(noise.pixel_sigma_px, noise.motion_scale)"
        )
    return in_words(error)


def with_divergence(run: Run, sequence: Sequence) -> Run:
    """Return a completed run; where it has diverged, with the status ``diverged`` and the reason in its log.

    ``sequence`` is what it read; the truth is not used.
    """
    checked = [] if run.causal is None or run.final_is_causal else [run.causal]
    if run.final is not None:
        # A final state without a covariance is at least as certain as the causal one was.
        lacks = run.final.cov is None and run.causal is not None and np.array_equal(run.causal.t_ns, run.final.t_ns)
        checked.append(replace(run.final, cov=run.causal.cov) if lacks and run.causal is not None else run.final)
    reasons = [*(contradiction(trajectory, sequence) for trajectory in checked), gate_collapse(run.info)]
    found = [f"the trajectory diverged: {reason}" for reason in dict.fromkeys(reasons) if reason is not None]
    return replace(run, status="diverged", log=(*run.log, *found)) if found else run


def _info(online: list[Estimate]) -> dict[str, Array]:
    names = sorted({name for estimate in online for name in estimate.info})
    return {name: np.array([e.info.get(name, np.nan) for e in online], dtype=float) for name in names}
