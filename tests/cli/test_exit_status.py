"""Every kind of trouble has its exit status and one line on stderr, and leaves nothing half-written."""

import os
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import IO

import pytest

from toolkit import runner
from toolkit.experiment import workers
from toolkit.threads import THREAD_VARIABLES

Vislam = Callable[..., int]
OneLine = Callable[[], str]
StartsGroup = Callable[..., subprocess.Popen[str]]
ROOT = Path(__file__).parents[2]
# What hangs is ended after this: a machine under load takes ten times as long to start a process as an idle one.
PATIENCE_S = 300.0
QUICK = ("compare", "drive", "--estimators", "dead-reckoning", "--max-frames", "10", "--workers", "1")


@pytest.mark.usefixtures("unrendered")
def test_a_run_that_is_marked_overconfident_ends_with_0(vislam: Vislam, capsys: pytest.CaptureFixture[str]) -> None:
    assert vislam("compare", "drive", "--estimators", "ekf", "--max-frames", "60", "--workers", "1") == 0
    assert "overconfident: ekf" in capsys.readouterr().out


@pytest.mark.usefixtures("unrendered")
def test_a_diverged_estimator_is_1_and_its_results_are_written(
    vislam: Vislam, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    real = runner.run
    monkeypatch.setattr(runner, "run", lambda *given: replace(real(*given), status="diverged"))
    assert vislam(*QUICK, "--out", "run") == 1
    assert '"status": "diverged"' in Path("run/metrics.json").read_text()
    assert "dead-reckoning diverged" in capsys.readouterr().out


def test_an_interrupt_is_130_and_leaves_nothing(
    vislam: Vislam, one_line: OneLine, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(runner, "run", interrupted)
    assert vislam(*QUICK, "--out", "run") == 130
    assert "interrupted" in one_line()
    assert list(Path().iterdir()) == []


def test_a_reader_that_goes_away_is_no_trouble() -> None:
    """As in ``vislam list | head -0``, with the pipe already closed at the other end."""
    read_end, write_end = os.pipe()
    os.close(read_end)
    with os.fdopen(write_end, "w") as closed_pipe:
        messages = subprocess.run(
            [sys.executable, "-m", "toolkit.cli", "list"],
            stdout=closed_pipe,
            stderr=subprocess.PIPE,
            text=True,
            check=False,
            timeout=PATIENCE_S,
        )
    assert messages.stderr == ""
    assert messages.returncode == 141


def test_nothing_but_results_is_written_when_all_is_well(vislam: Vislam, capsys: pytest.CaptureFixture[str]) -> None:
    assert vislam(*QUICK, "--out", "run") == 0
    messages = capsys.readouterr()
    assert messages.err == ""
    assert "results: run; as a page: vislam report run\n" in messages.out
    assert [path.name for path in Path().iterdir()] == ["run"]


@pytest.mark.parametrize("words", [("list",), ("--help",)])
def test_an_output_on_a_full_disk_is_4_in_one_line(words: tuple[str, ...]) -> None:
    with Path("/dev/full").open("w") as full:
        messages = _vislam(*words, stdout=full)
    assert messages.stderr.startswith("vislam: error: the standard output cannot be written")
    assert messages.stderr.count("\n") == 1
    assert messages.returncode == 4


def test_closed_streams_are_no_trouble_to_processes_either(tmp_path: Path) -> None:
    words = "compare drive --estimators dead-reckoning,mapping --max-frames 4 --workers 2 --figures none --out run"
    program = f"exec {sys.executable} -m toolkit.cli {words} <&- >&- 2>&-"
    assert subprocess.run(["sh", "-c", program], cwd=tmp_path, check=False, timeout=PATIENCE_S).returncode == 0


def test_a_directory_that_is_gone_is_reported(vislam: Vislam, one_line: OneLine) -> None:
    Path("gone").mkdir()
    os.chdir("gone")
    Path("../gone").rmdir()
    assert vislam(*QUICK) == 71
    assert "the current directory is no longer there; change to another one" in one_line()


def test_a_full_shared_memory_is_not_taken_for_a_full_output(
    vislam: Vislam, one_line: OneLine, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(workers, "_executor", _raiser(OSError(28, "No space left on device")))
    assert vislam(*QUICK[:-1], "2", "--out", "run") == 71
    messages = one_line()
    assert "no worker process can be started (No space left on device)" in messages
    assert "/dev/shm" in messages
    assert "--workers 1" in messages


@pytest.mark.parametrize("kilobytes", [150_000, 260_000])
def test_too_little_memory_for_the_libraries_is_71_in_one_line_at_once(kilobytes: int) -> None:
    program = f"ulimit -v {kilobytes}; exec {sys.executable} -m toolkit.cli list"
    environment = {name: value for name, value in os.environ.items() if name not in THREAD_VARIABLES}
    messages = subprocess.run(
        ["sh", "-c", program], check=False, capture_output=True, text=True, env=environment, timeout=PATIENCE_S
    )
    assert messages.returncode == 71
    assert "MB (ulimit -v), and NumPy, SciPy and GTSAM alone need 307 MB" in messages.stderr
    assert messages.stderr.count("\n") == 1


@pytest.mark.parametrize(("limit", "status"), [(2**40, 71), (-1, 70)])
def test_an_interpreter_that_fails_within_a_limit_of_memory_lacks_it(
    vislam: Vislam, one_line: OneLine, monkeypatch: pytest.MonkeyPatch, limit: int, status: int
) -> None:
    monkeypatch.setenv("OPENBLAS_NUM_THREADS", "1")
    monkeypatch.setattr(resource, "getrlimit", lambda _which: (limit, -1))
    monkeypatch.setattr(runner, "run", _raiser(SystemError("returned NULL without setting an exception")))
    assert vislam(*QUICK, "--out", "run") == status
    assert ("out of memory" in one_line()) == (status == 71)


@pytest.mark.parametrize("encoding", ["ascii", "latin-1", "utf-8"])
def test_a_name_that_is_no_text_is_reported_in_any_encoding(encoding: str, tmp_path: Path) -> None:
    name = os.fsdecode(b"caf\xe9 \xe2\x82\xac.npz")
    messages = _vislam("check-data", str(tmp_path / name), environment={"LC_ALL": "C", "PYTHONIOENCODING": encoding})
    assert messages.returncode == 3
    assert messages.stderr.count("\n") == 1
    assert "caf\\udce9" in messages.stderr


@pytest.mark.parametrize(
    ("error", "status", "says"),
    [
        (MemoryError(), 71, "memory"),
        (OSError(24, "Too many open files"), 71, "Too many open files"),
        (ImportError("failed to map segment", path="/lib/_fblas.cpython-311-x86_64-linux-gnu.so"), 71, "more memory"),
        (UnicodeEncodeError("utf-8", "\udcff", 0, 1, "surrogates not allowed"), 71, "rename it"),
        (ZeroDivisionError("float division\nby zero"), 70, "a defect of vislam"),
        (SystemError("\x1b[2J"), 70, "\\x1b[2J"),
    ],
)
def test_whatever_nobody_foresaw_is_one_line_with_a_documented_status(
    vislam: Vislam, one_line: OneLine, monkeypatch: pytest.MonkeyPatch, error: Exception, status: int, says: str
) -> None:
    monkeypatch.setattr(runner, "run", _raiser(error))
    monkeypatch.delenv("VISLAM_TRACEBACK", raising=False)
    assert vislam(*QUICK, "--out", "run") == status
    assert says in one_line()
    assert list(Path().iterdir()) == []


@pytest.mark.parametrize(
    ("lack", "status"), [(OSError(24, "Too many open files"), 71), (FileNotFoundError(2, "no"), 70)]
)
def test_a_lack_of_means_is_reported_where_a_library_hides_it_and_nothing_else_is(
    vislam: Vislam, one_line: OneLine, monkeypatch: pytest.MonkeyPatch, lack: Exception, status: int
) -> None:
    monkeypatch.setattr(runner, "run", _raiser(_hidden(lack)))
    assert vislam(*QUICK, "--out", "run") == status
    assert ("Too many open files" in one_line()) == (status == 71)


def test_the_place_of_a_defect_is_shown_when_requested(
    vislam: Vislam, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(runner, "run", _raiser(ZeroDivisionError()))
    monkeypatch.setenv("VISLAM_TRACEBACK", "1")
    assert vislam(*QUICK, "--out", "run") == 70
    assert "in _raise" in capsys.readouterr().err


@pytest.mark.parametrize("signals", [("SIGINT", "SIGINT"), ("SIGTERM", "SIGINT", "SIGHUP")])
def test_signals_leave_no_file_and_no_process(
    tmp_path: Path, starts_group: StartsGroup, signals: tuple[str, ...]
) -> None:
    words = ("compare", "drive", "--estimators", "dead-reckoning,ekf,batch", "--workers", "2", "--out", "deep/down")
    running = starts_group(("-m", "toolkit.cli", *words), tmp_path, {"PYTHONPATH": str(ROOT)})
    _wait_until(lambda: len(_group(running.pid)) > 2)
    for name in signals:
        os.kill(running.pid, getattr(signal, name))
        time.sleep(0.05)
    _, messages = running.communicate(timeout=PATIENCE_S)
    assert messages == "vislam: error: interrupted; what was not finished is not written\n"
    assert running.returncode == 130
    assert list(tmp_path.iterdir()) == []
    _wait_until(lambda: not _group(running.pid))


def test_an_interrupt_that_comes_out_as_another_error_is_130(
    vislam: Vislam, one_line: OneLine, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As of a library whose compiled code answers one with an error of its own."""

    def interrupted(*_: object) -> None:
        with suppress(KeyboardInterrupt):
            signal.raise_signal(signal.SIGTERM)
        raise ImportError("initialization failed")

    monkeypatch.setattr(runner, "run", interrupted)
    assert vislam(*QUICK, "--out", "run") == 130
    assert "interrupted" in one_line()


def test_a_signal_at_the_end_of_the_interpreter_changes_no_status() -> None:
    program = "import os, signal, sys; from toolkit.cli import main; status = main(); "
    program += "os.kill(os.getpid(), signal.SIGTERM); sys.exit(status)"
    ended = subprocess.run([sys.executable, "-c", program, "list"], capture_output=True, check=False)
    assert ended.returncode == 0


@pytest.mark.usefixtures("unrendered")
def test_a_reader_that_goes_away_costs_no_results(
    vislam: Vislam, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def gone(*_: object) -> None:
        raise BrokenPipeError

    monkeypatch.setattr("toolkit.cli._give_up_output", lambda: None)
    with monkeypatch.context() as patched:
        patched.setattr("toolkit.cli.progress_display.print_above", gone)
        assert vislam(*QUICK, "--out", "run") == 141
    with monkeypatch.context() as patched:
        patched.setattr("toolkit.report.card.card_text", gone)
        assert vislam("card", "drive", "--max-frames", "20", "--json", "card.json") == 141
    assert (tmp_path / "run/metrics.json").exists()
    assert (tmp_path / "card.json").exists()


def test_a_table_does_not_wait_for_figures(
    vislam: Vislam, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Drawing takes seconds, and the first table is the first impression."""
    shown: list[str] = []

    def draw_nothing(*_: object) -> dict[str, str]:
        shown.append(capsys.readouterr().out)
        return {}

    monkeypatch.setattr("toolkit.report.figures.save", draw_nothing)
    assert vislam(*QUICK, "--out", "run") == 0
    assert "dead-reckoning" in shown[0]


def test_an_interrupt_inside_text_that_is_executed_is_130_as_well(tmp_path: Path) -> None:
    """As where a dataclass is being made: CPython would then end ``python -m`` by the signal, caught or not."""
    (tmp_path / "interrupted.py").write_text(
        "import sys\n"
        "from toolkit.cli import main\n"
        "from toolkit.cli.arguments import Parser\n"
        "Parser.parse_args = lambda *_: exec('raise KeyboardInterrupt')\n"
        "sys.exit(main())\n"
    )
    search = {"PYTHONPATH": f"{tmp_path}:{ROOT}"}
    command = [sys.executable, "-m", "interrupted", "list"]
    ended = subprocess.run(command, env={**os.environ, **search}, capture_output=True, text=True, check=False)
    assert (ended.returncode, ended.stderr.count("\n")) == (130, 1)


def _group(group: int) -> list[int]:
    """Return the living processes of a group."""
    found = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        with suppress(OSError):
            state, _parent, of_group = stat.read_text().rpartition(")")[2].split()[:3]
            if int(of_group) == group and state != "Z":
                found.append(int(stat.parent.name))
    return found


def _wait_until(reached: Callable[[], bool]) -> None:
    deadline = time.monotonic() + PATIENCE_S
    while not reached():
        assert time.monotonic() < deadline
        time.sleep(0.05)


def _hidden(lack: Exception) -> Exception:
    """Return an error of a library that has another one behind it."""
    error = UnboundLocalError("cannot access local variable")
    error.__context__ = lack
    return error


def _raiser(error: Exception) -> Callable[..., None]:
    def _raise(*_: object) -> None:
        raise error

    return _raise


def _vislam(
    *words: str, stdout: int | IO[str] = subprocess.PIPE, environment: Mapping[str, str] | None = None
) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "toolkit.cli", *words],
        env={**os.environ, **(environment or {})},
        stdout=stdout,
        stderr=subprocess.PIPE,
        text=True,
        check=False,
        timeout=PATIENCE_S,
    )
