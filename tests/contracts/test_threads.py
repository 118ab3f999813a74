"""Every estimator says the same bits at one thread and at two: what a report shows can be repeated anywhere.

The number of threads is settled when the numeric libraries are loaded, so each number has a process of its own.
"""

import json
import os
import subprocess
import sys

import pytest

from toolkit.estimator import discover

_SCRIPT = """
import hashlib, json, os, sys
threads = int(sys.argv[1])
if hasattr(os, "sched_setaffinity"):  # what GTSAM's pool goes by
    os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:threads])

from dataclasses import replace
import numpy as np
from toolkit import runner
from toolkit.errors import EstimatorError
from toolkit.estimator import discover
from toolkit.progress import SILENT
from toolkit.simulation import DRIVE, FLIGHT, simulate

def feed(digest, value):
    if isinstance(value, np.ndarray):
        digest.update(np.ascontiguousarray(value).data)
    elif hasattr(value, "__dataclass_fields__"):
        for name in value.__dataclass_fields__:
            feed(digest, getattr(value, name))

said = {}
for scenario in (replace(DRIVE, duration_s=0.8), replace(FLIGHT, duration_s=0.8)):
    sequence = simulate(scenario, 4)
    for name, entry in discover().items():
        digest = hashlib.sha256()
        try:
            run = runner.run(name, entry.load(), sequence, sequence.prior, SILENT)
        except EstimatorError:
            said[f"{name} on {sequence.name}"] = "unavailable"
            continue
        for part in (run.causal, run.final, run.landmarks):
            feed(digest, part)
        said[f"{name} on {sequence.name}"] = digest.hexdigest()
print(json.dumps(said))
"""


def digests_at(threads: int) -> dict[str, str]:
    """Run every estimator in a process of so many threads and return a digest of all it said."""
    variables = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
    environment = os.environ | dict.fromkeys(variables, str(threads))
    environment["OPENBLAS_THREAD_TIMEOUT"] = "4"  # idle threads sleep at once: spinning, they starve a busy machine
    done = subprocess.run(
        [sys.executable, "-c", _SCRIPT, str(threads)], capture_output=True, text=True, env=environment, check=False
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


@pytest.fixture(scope="module")
def digests() -> list[dict[str, str]]:
    return [digests_at(1), digests_at(2)]


@pytest.mark.parametrize("scenario", ["drive", "flight"])
@pytest.mark.parametrize("name", sorted(discover()))
def test_one_thread_and_two_say_the_same_bits(name, scenario, digests) -> None:
    one, two = (said[f"{name} on {scenario}"] for said in digests)
    if one == two == "unavailable":
        pytest.skip(f"{name} is unavailable")
    assert one == two
