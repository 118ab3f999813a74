"""What runs in the place of NumPy, where it can be had and where not, and what is told of it."""

import os
import subprocess
import sys

import pytest

from toolkit import compilation, runner
from toolkit.compilation import Compilation
from toolkit.datasets import load_sequence
from toolkit.errors import EstimatorError
from toolkit.initialization import start_from_truth
from toolkit.registry import find
from toolkit.settings import Settings


@pytest.fixture
def module(tmp_path, monkeypatch):
    """Return a function that writes an importable module of some text and says its name; numba is there."""
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setattr(compilation, "find_spec", lambda name: name)

    def written(name: str, text: str) -> str:
        (tmp_path / f"{name}.py").write_text(text, encoding="utf-8")
        return name

    return written


def test_without_numba_numpy_runs_unless_compiled_is_requested(monkeypatch):
    monkeypatch.setattr(compilation, "find_spec", lambda name: None)
    auto = Compilation("auto")
    assert auto.module("filters.kalman.kernels.track_gate") is None
    assert (auto.ran, auto.log) == ("numpy", ())
    with pytest.raises(EstimatorError, match=r"needs numba.*\[fast\]"):
        Compilation("compiled").module("filters.kalman.kernels.track_gate")
    with pytest.raises(EstimatorError, match="needs numba"):
        find("msckf").check_usable(Settings(arithmetic="compiled"))


def test_a_numba_that_does_not_fit_is_reported_and_numpy_runs(module):
    name = module("numba_does_not_fit", "raise ImportError('Numba needs NumPy 2.5 or less')")
    auto = Compilation("auto")
    assert auto.module(name) is None
    assert auto.ran == "numpy"
    assert auto.log == ("numba cannot be used here, NumPy ran: Numba needs NumPy 2.5 or less",)
    with pytest.raises(EstimatorError, match=r"cannot be used here \(Numba needs NumPy"):
        Compilation("compiled").module(name)


def test_what_was_compiled_is_reported_once_in_a_process_and_what_was_found_is_not(module):
    name, found = module("was_compiled", "COMPILED = 'this was compiled'"), module("was_found", "COMPILED = ''")
    first, second, third = Compilation("auto"), Compilation("auto"), Compilation("auto")
    for one, of in ((first, name), (second, name), (third, found)):
        assert one.module(of) is not None
        assert one.ran == "compiled"
    assert [len(one.log) for one in (first, second, third)] == [1, 0, 0]
    assert first.log[0].startswith("this was compiled (")


@pytest.mark.parametrize(("estimator", "ran"), [("msckf", "numpy"), ("dead-reckoning", None)])
def test_a_run_says_what_computed_where_there_are_both(estimator, ran):
    sequence = load_sequence("drive").truncated(4)
    settings = Settings(arithmetic="numpy")
    run = runner.run(estimator, find(estimator).load(), sequence, start_from_truth(sequence), settings=settings)
    assert run.arithmetic == ran


SLOW_ONCE = """
import time
from pathlib import Path
kept = Path(__file__ + ".kept")
compiled = not kept.exists()
time.sleep(1.0 if compiled else 0.0)
kept.touch()
COMPILED = ""
"""
SHARING = """
import sys, time
from pathlib import Path
from toolkit import compilation
compilation.find_spec = lambda name: name
Path(sys.argv[1]).touch()
while not all(Path(path).exists() for path in "ab"):
    time.sleep(0.01)
requested = compilation.Compilation("auto")
requested.share(["one", "other"])
print(*(requested.module(name).compiled for name in ["one", "other"]))
"""


def test_processes_that_begin_together_share_what_is_to_be_compiled(tmp_path):
    """Two modules that take a while each, once: each process compiles one, and finds the other when it is through."""
    for name in ("one", "other"):
        (tmp_path / f"{name}.py").write_text(SLOW_ONCE)
    where = {**os.environ, "PYTHONPATH": os.pathsep.join([str(tmp_path), *sys.path])}
    both = [
        subprocess.Popen(
            [sys.executable, "-c", SHARING, name], stdout=subprocess.PIPE, text=True, env=where, cwd=tmp_path
        )
        for name in "ab"
    ]
    assert sorted(process.communicate()[0].split() for process in both) == [["False", "True"], ["True", "False"]]


def test_processes_compile_one_after_another(tmp_path):
    """Two that begin together: each module takes a while, and neither begins before the other has ended."""
    (tmp_path / "slow.py").write_text(
        "import time\nbegan = time.monotonic()\ntime.sleep(0.5)\nended = time.monotonic()\nCOMPILED = ''\n"
    )
    code = (
        "from toolkit import compilation\n"
        "compilation.find_spec = lambda name: name\n"
        "slow = compilation.Compilation('auto').module('slow')\n"
        "print(slow.began, slow.ended)"
    )
    where = {**os.environ, "TMPDIR": str(tmp_path), "PYTHONPATH": os.pathsep.join([str(tmp_path), *sys.path])}
    both = [subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True, env=where) for _ in "ab"]
    first, second = sorted(tuple(map(float, process.communicate()[0].split())) for process in both)
    assert first[1] <= second[0]
