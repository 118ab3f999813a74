"""Checks that answers are the same bits on one thread and on two, so that results can be repeated anywhere.

The number of threads is fixed when the numeric libraries are loaded, so each number needs a process of its own.
"""

import hashlib
import os
from concurrent.futures import TimeoutError as TookTooLong
from dataclasses import replace

from loky import ProcessPoolExecutor
from loky.process_executor import BrokenProcessPool

from toolkit import runner
from toolkit.errors import EstimatorError, SystemLimitError
from toolkit.experiment.workers import how_it_ended
from toolkit.progress import SILENT
from toolkit.simulation import DRIVE, FLIGHT, simulate
from toolkit.threads import THREAD_VARIABLES
from toolkit.verify.promises import arrays_of, subject_of

UNAVAILABLE = "unavailable"
_DURATION_S, _SEED = 0.8, 4
_TIMEOUT_S = 600


def digests_at(threads: int, estimators: tuple[str, ...]) -> dict[str, str]:
    """Run estimators in a process with a number of threads; return a digest of all answers, by "NAME on SCENARIO".

    Raises EstimatorError where the process does not end well, SystemLimitError where it cannot start.
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


def differing_answers(estimator: str) -> str:
    """Say on which scenario an estimator's answers differ between one thread and two; empty where they do not."""
    one, two = (digests_at(threads, (estimator,)) for threads in (1, 2))
    differing = [key.rpartition(" on ")[2] for key, digest in one.items() if two[key] != digest]
    if not differing:
        return ""
    return f"with two threads its answers differ in bits from those with one, on {', '.join(differing)}"


def _digests(threads: int, estimators: tuple[str, ...]) -> dict[str, str]:
    if hasattr(os, "sched_setaffinity"):  # read by GTSAM's thread pool
        os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:threads])
    digests = {}
    for scenario in (DRIVE, FLIGHT):
        sequence = simulate(replace(scenario, duration_s=_DURATION_S), _SEED)
        assert sequence.prior is not None
        for word in estimators:
            subject = subject_of(word)
            try:
                run = runner.run(subject.name, subject.load(), sequence, sequence.prior, SILENT)
            except EstimatorError:
                digests[f"{word} on {sequence.name}"] = UNAVAILABLE
                continue
            digest = hashlib.sha256()
            for part in (run.causal, run.final, run.landmarks):
                for array in arrays_of(part):
                    digest.update(array.tobytes())
            digests[f"{word} on {sequence.name}"] = digest.hexdigest()
    return digests
