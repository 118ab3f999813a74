"""Checks that answers are the same bits on one thread and on two, so that results can be repeated anywhere.

The number of threads is fixed when the numeric libraries are loaded, so each number needs a process of its own:
``python -m toolkit.verify.threads 2 ekf my_filter.py`` prints a digest of all answers of each estimator on each
scenario.
"""

import hashlib
import json
import os
import subprocess
import sys
from dataclasses import replace

from toolkit import runner
from toolkit.errors import EstimatorError, SystemLimitError
from toolkit.progress import SILENT
from toolkit.simulation import DRIVE, FLIGHT, simulate
from toolkit.threads import THREAD_VARIABLES
from toolkit.verify.promises import arrays_of, subject_of

UNAVAILABLE = "unavailable"
# The first line of a process that has started.
_STARTED = "started"
_DURATION_S, _SEED = 0.8, 4
_TIMEOUT_S = 600


def digests_at(threads: int, estimators: tuple[str, ...]) -> dict[str, str]:
    """Run estimators in a process with a number of threads; return a digest of all answers, by "NAME on SCENARIO".

    Raises EstimatorError where the process does not end well, SystemLimitError where it cannot start.
    """
    # Idle threads sleep at once: spinning, they starve a busy machine.
    environment = os.environ | dict.fromkeys(THREAD_VARIABLES, str(threads)) | {"OPENBLAS_THREAD_TIMEOUT": "4"}
    environment["PYTHONPATH"] = os.pathsep.join(folder or os.getcwd() for folder in sys.path)  # noqa: PTH109
    arguments = [sys.executable, "-m", __name__, str(threads), *estimators]
    try:
        done = subprocess.run(
            arguments, capture_output=True, text=True, env=environment, timeout=_TIMEOUT_S, check=False
        )
    except subprocess.TimeoutExpired as error:
        raise EstimatorError(f"with {threads} threads it did not end within {_TIMEOUT_S} s") from error
    except OSError as error:
        raise SystemLimitError(f"no process can be started ({error.strerror or error})") from error
    last = done.stderr.strip().splitlines()[-1:] or [f"status {done.returncode}"]
    if not done.stdout.startswith(_STARTED):
        raise SystemLimitError(f"its process cannot start: {last[0]}")
    if done.returncode != 0:
        raise EstimatorError(f"with {threads} threads its process ended: {last[0]}")
    digests: dict[str, str] = json.loads(done.stdout.splitlines()[-1])
    return digests


def differing_answers(estimator: str) -> str:
    """Say on which scenario an estimator's answers differ between one thread and two; empty where they do not."""
    one, two = (digests_at(threads, (estimator,)) for threads in (1, 2))
    differing = [key.rpartition(" on ")[2] for key, digest in one.items() if two[key] != digest]
    if not differing:
        return ""
    return f"with two threads its answers differ in bits from those with one, on {', '.join(differing)}"


def _digests(estimators: list[str]) -> dict[str, str]:
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


def main(arguments: list[str]) -> None:
    """Print the digests of the estimators named behind the number of threads."""
    if hasattr(os, "sched_setaffinity"):  # read by GTSAM's thread pool
        os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[: int(arguments[0])])
    print(_STARTED, flush=True)
    print(json.dumps(_digests(arguments[1:])))


if __name__ == "__main__":
    main(sys.argv[1:])
