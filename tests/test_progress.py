"""Progress: a bar with the time left on a terminal, a line now and then in a log, nothing where nobody watches."""

import io

import pytest

from toolkit import progress


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def work(stream: io.StringIO) -> str:
    with progress.on_stream(stream)("drive: batch") as watched:
        for done in range(1, 4):
            watched.advance(done, 3)
        for done in range(1, 4):
            watched.advance(done, 60, "iteration")
    return stream.getvalue()


def test_short_work_leaves_nothing_in_a_log() -> None:
    assert work(io.StringIO()) == ""


def test_long_work_leaves_lines_with_the_time_left_in_a_log(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(progress, "LOG_EVERY_S", 0.0)
    lines = work(io.StringIO()).splitlines()
    assert len(lines) == 6
    assert lines[1].startswith("drive: batch 2/3 [") and "left" in lines[1]
    assert lines[-1].startswith("drive: batch, iteration 3/60 [")


def test_a_terminal_sees_a_bar_that_is_gone_at_the_end() -> None:
    written = work(Terminal())
    assert "drive: batch" in written and "drive: batch, iteration" in written
    assert "\n" not in written
    assert written.rstrip("\r").endswith("\r" + " " * len(written.rstrip("\r").rpartition("\r")[2]))
