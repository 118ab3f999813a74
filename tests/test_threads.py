"""Linear algebra runs on one thread where it is asked to, whichever libraries were loaded when."""

import os
import subprocess
import sys
import textwrap

from threadpoolctl import threadpool_info


def test_libraries_run_on_one_thread_those_too_that_are_loaded_after_the_first_time() -> None:
    program = textwrap.dedent("""
        from threadpoolctl import threadpool_info
        from toolkit.threads import on_one_thread

        def threads():
            return {one["filepath"]: one["num_threads"] for one in threadpool_info() if one["user_api"] == "blas"}

        for module in ("numpy", "scipy.linalg"):
            __import__(module)
            before = threads()
            with on_one_thread():
                assert set(threads().values()) == {1}, threads()
            assert threads() == before
    """)
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "2", "MKL_NUM_THREADS": "2", "OMP_NUM_THREADS": "2"}
    ended = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=False, env=environment
    )
    assert ended.returncode == 0, ended.stderr


def test_these_tests_have_as_many_threads_as_requested_and_one_where_nothing_is_requested() -> None:
    """What pytest loads before `conftest` must not load NumPy."""
    reported = {one["num_threads"] for one in threadpool_info() if one["user_api"] == "blas"}
    assert reported == {int(os.environ["OPENBLAS_NUM_THREADS"])}
