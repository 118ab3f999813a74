"""Linear algebra on one thread, so that the same bits and comparable times come out wherever it runs."""

import sys
from contextlib import AbstractContextManager
from functools import lru_cache

from threadpoolctl import ThreadpoolController

# Most worker processes on one machine: each has Python with GTSAM, 150 MB or more. --scheduler uses several machines.
MOST_WORKERS = 1024
# Environment variables that set the number of threads of numeric libraries when these are loaded.
THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


def on_one_thread() -> AbstractContextManager[object]:
    """Return a context in which the linear algebra of this process runs on one thread."""
    limited: AbstractContextManager[object] = _libraries(len(sys.modules)).limit(limits=1, user_api="blas")
    return limited


@lru_cache(maxsize=1)
def _libraries(_modules: int) -> ThreadpoolController:
    """Return the libraries of this process. Finding them takes 2 ms and is repeated when more modules are loaded."""
    return ThreadpoolController()
