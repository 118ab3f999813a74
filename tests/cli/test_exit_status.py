"""Every kind of trouble has its exit status and one line on stderr, and leaves nothing half-written."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from toolkit import runner
from toolkit.experiment import workers
from toolkit.threads import THREAD_VARIABLES

ROOT = Path(__file__).parents[2]
# What hangs is ended after this: a machine under load takes ten times as long to start a process as an idle one.
PATIENCE_S = 300.0
QUICK = ("compare", "drive", "--estimators", "dead-reckoning", "--max-frames", "10", "--workers", "1", "--out", "run")


def in_a_process(*words: str, **how: Any) -> subprocess.CompletedProcess[str]:
    """Run words, of Python unless they begin with another program's, in a process of its own."""
    given = {
        "stdout": subprocess.PIPE,
        "stderr": subprocess.PIPE,
        "text": True,
        "timeout": PATIENCE_S,
        "cwd": ROOT,
        **how,
    }
    program = words if words[0] == "sh" else (sys.executable, *words)
    return subprocess.run(program, check=False, **given)


def raiser(error: BaseException) -> Callable[..., None]:
    def _raise(*_: object) -> None:
        raise error

    return _raise


@pytest.mark.usefixtures("unrendered")
def test_a_diverged_estimator_is_1_and_its_results_are_written_but_a_mark_changes_no_status(
    vislam, capsys, monkeypatch
):
    assert vislam("compare", "drive", "--estimators", "ekf", "--max-frames", "60", "--workers", "1") == 0
    assert "overconfident: ekf" in capsys.readouterr().out
    real = runner.run
    monkeypatch.setattr(runner, "run", lambda *given: replace(real(*given), status="diverged"))
    assert vislam(*QUICK) == 1
    assert '"status": "diverged"' in Path("run/metrics.json").read_text()
    assert "dead-reckoning diverged" in capsys.readouterr().out


def test_nothing_but_results_is_written_and_the_table_does_not_wait_for_figures(vislam, monkeypatch, capsys):
    shown: list[str] = []

    def draw_nothing(*_: object) -> dict[str, str]:
        shown.append(capsys.readouterr().out)
        return {}

    monkeypatch.setattr("toolkit.report.figures.save", draw_nothing)
    assert vislam(*QUICK) == 0
    messages = capsys.readouterr()
    assert messages.err == ""
    assert "dead-reckoning" in shown[0]
    assert "results: run; as a page: vislam report run\n" in messages.out
    assert [path.name for path in Path().iterdir()] == ["run"]


def hidden(lack: Exception) -> Exception:
    """Return an error of a library that has another one behind it."""
    error = UnboundLocalError("cannot access local variable")
    error.__context__ = lack
    return error


@pytest.mark.parametrize(
    ("error", "status", "says"),
    [
        (KeyboardInterrupt(), 130, "interrupted"),
        (MemoryError(), 71, "memory"),
        (OSError(24, "Too many open files"), 71, "Too many open files"),
        (hidden(OSError(24, "Too many open files")), 71, "Too many open files"),
        (hidden(FileNotFoundError(2, "no")), 70, "a defect of vislam"),
        (ImportError("failed to map segment", path="/lib/_fblas.cpython-311-x86_64-linux-gnu.so"), 71, "more memory"),
        (UnicodeEncodeError("utf-8", "\udcff", 0, 1, "surrogates not allowed"), 71, "rename it"),
        (ZeroDivisionError("float division\nby zero"), 70, "a defect of vislam"),
        (SystemError("\x1b[2J"), 70, "\\x1b[2J"),
    ],
)
def test_whatever_nobody_foresaw_is_one_line_with_a_documented_status(
    vislam, one_line, monkeypatch, error, status, says
):
    monkeypatch.setattr(runner, "run", raiser(error))
    monkeypatch.delenv("VISLAM_TRACEBACK", raising=False)
    assert vislam(*QUICK) == status
    assert says in one_line()
    assert list(Path().iterdir()) == []


def test_the_place_of_a_defect_is_shown_when_requested(vislam, capsys, monkeypatch):
    monkeypatch.setattr(runner, "run", raiser(ZeroDivisionError()))
    monkeypatch.setenv("VISLAM_TRACEBACK", "1")
    assert vislam(*QUICK) == 70
    assert "in _raise" in capsys.readouterr().err


def test_an_interrupt_that_comes_out_as_another_error_is_130(vislam, one_line, monkeypatch):
    """As of a library whose compiled code answers one with an error of its own."""

    def interrupted(*_: object) -> None:
        with suppress(KeyboardInterrupt):
            signal.raise_signal(signal.SIGTERM)
        raise ImportError("initialization failed")

    monkeypatch.setattr(runner, "run", interrupted)
    assert vislam(*QUICK) == 130
    assert "interrupted" in one_line()


def test_a_directory_that_is_gone_is_reported(vislam, one_line):
    Path("gone").mkdir()
    os.chdir("gone")
    Path("../gone").rmdir()
    assert vislam(*QUICK) == 71
    assert "the current directory is no longer there; change to another one" in one_line()


def test_a_full_shared_memory_is_not_taken_for_a_full_output(vislam, one_line, monkeypatch):
    monkeypatch.setattr(workers, "_executor", raiser(OSError(28, "No space left on device")))
    assert vislam(*QUICK, "--workers", "2") == 71
    messages = one_line()
    assert "no worker process can be started (No space left on device)" in messages
    assert "/dev/shm" in messages
    assert "--workers 1" in messages


@pytest.mark.usefixtures("unrendered")
def test_a_reader_that_goes_away_costs_no_results(vislam, monkeypatch):
    monkeypatch.setattr("toolkit.cli._give_up_output", lambda: None)
    monkeypatch.setattr("toolkit.cli.progress_display.print_above", raiser(BrokenPipeError()))
    monkeypatch.setattr("toolkit.report.card.card_text", raiser(BrokenPipeError()))
    assert vislam(*QUICK) == 141
    assert vislam("card", "drive", "--max-frames", "20", "--json", "card.json") == 141
    assert Path("run/metrics.json").exists()
    assert Path("card.json").exists()


def test_a_closed_pipe_and_a_full_disk_have_their_statuses():
    read_end, write_end = os.pipe()
    os.close(read_end)
    with os.fdopen(write_end, "w") as closed_pipe:  # as in ``vislam list | head -0``
        messages = in_a_process("-m", "toolkit.cli", "list", stdout=closed_pipe)
    assert (messages.stderr, messages.returncode) == ("", 141)
    for words in (("list",), ("--help",)):
        with Path("/dev/full").open("w") as full:
            messages = in_a_process("-m", "toolkit.cli", *words, stdout=full)
        assert messages.stderr.startswith("vislam: error: the standard output cannot be written")
        assert (messages.stderr.count("\n"), messages.returncode) == (1, 4)


def test_closed_streams_are_no_trouble_to_processes_either(tmp_path):
    words = "compare drive --estimators dead-reckoning,mapping --max-frames 4 --workers 2 --figures none --out run"
    program = f"exec {sys.executable} -m toolkit.cli {words} <&- >&- 2>&-"
    assert in_a_process("sh", "-c", program, cwd=tmp_path, env={**os.environ, "PYTHONPATH": str(ROOT)}).returncode == 0


def test_too_little_memory_for_the_libraries_is_71_in_one_line_at_once():
    environment = {name: value for name, value in os.environ.items() if name not in THREAD_VARIABLES}
    program = f"ulimit -v 200000; exec {sys.executable} -m toolkit.cli list"
    messages = in_a_process("sh", "-c", program, env=environment)
    assert messages.returncode == 71
    assert "MB (ulimit -v), and NumPy, SciPy and GTSAM alone need 307 MB" in messages.stderr
    assert messages.stderr.count("\n") == 1


@pytest.mark.parametrize("encoding", ["ascii", "utf-8"])
def test_a_name_that_is_no_text_is_reported_in_any_encoding(encoding, tmp_path):
    path = str(tmp_path / os.fsdecode(b"caf\xe9 \xe2\x82\xac.npz"))
    environment = {**os.environ, "LC_ALL": "C", "PYTHONIOENCODING": encoding}
    messages = in_a_process("-m", "toolkit.cli", "check-data", path, env=environment)
    assert (messages.returncode, messages.stderr.count("\n")) == (3, 1)
    assert "caf\\udce9" in messages.stderr


@pytest.mark.parametrize(
    "numbers", [(signal.SIGTERM, signal.SIGINT, signal.SIGHUP), ()], ids=["its own", "of a terminal"]
)
def test_signals_leave_no_file_and_no_process(tmp_path, starts_group, numbers):
    words = ("compare", "drive", "--estimators", "dead-reckoning,ekf,batch", "--workers", "2", "--out", "deep/down")
    running = starts_group(("-m", "toolkit.cli", *words), tmp_path, {"PYTHONPATH": str(ROOT)})
    wait_until(lambda: len(living(running.pid)) > 2)
    for number in numbers:
        os.kill(running.pid, number)
        time.sleep(0.05)
    if not numbers:  # a terminal interrupts every process of the group
        os.killpg(running.pid, signal.SIGINT)
    _, messages = running.communicate(timeout=PATIENCE_S)
    assert messages == "vislam: error: interrupted; what was not finished is not written\n"
    assert running.returncode == 130
    assert list(tmp_path.iterdir()) == []
    wait_until(lambda: not living(running.pid))


def living(group: int) -> list[int]:
    """Return the living processes of a group."""
    found = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        with suppress(OSError):
            state, _parent, of_group = stat.read_text().rpartition(")")[2].split()[:3]
            if int(of_group) == group and state != "Z":
                found.append(int(stat.parent.name))
    return found


def wait_until(reached: Callable[[], bool]) -> None:
    deadline = time.monotonic() + PATIENCE_S
    while not reached():
        assert time.monotonic() < deadline
        time.sleep(0.05)


def test_a_signal_at_the_end_of_the_interpreter_changes_no_status():
    program = "import os, signal, sys; from toolkit.cli import main; status = main(); "
    program += "os.kill(os.getpid(), signal.SIGTERM); sys.exit(status)"
    assert in_a_process("-c", program, "list").returncode == 0


def test_an_interrupt_inside_text_that_is_executed_is_130_as_well(tmp_path):
    """As where a dataclass is being made: CPython would then end ``python -m`` by the signal, caught or not."""
    (tmp_path / "interrupted.py").write_text(
        "import sys\n"
        "from toolkit.cli import main\n"
        "from toolkit.cli.arguments import Parser\n"
        "Parser.parse_args = lambda *_: exec('raise KeyboardInterrupt')\n"
        "sys.exit(main())\n"
    )
    ended = in_a_process("-m", "interrupted", "list", env={**os.environ, "PYTHONPATH": f"{tmp_path}:{ROOT}"})
    assert (ended.returncode, ended.stderr.count("\n")) == (130, 1)
