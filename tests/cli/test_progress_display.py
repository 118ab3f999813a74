"""Progress: a bar with the time left on a terminal, a line now and then in a log, nothing where nobody watches."""

import io
import itertools

from toolkit.cli import progress_display as progress


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


def test_long_work_leaves_lines_with_the_time_left_in_a_log_and_short_work_nothing(monkeypatch):
    assert work(io.StringIO()) == ""
    monkeypatch.setattr(progress, "LOG_EVERY_S", 0.0)
    monkeypatch.setattr(progress, "_LOG_SHARE", 0.0)
    lines = work(io.StringIO()).splitlines()
    assert len(lines) == 6
    assert lines[1].startswith("drive: batch 67 % [") and "left" in lines[1]
    assert lines[-1].startswith("drive: batch, iteration 5 % [")


def test_lines_of_long_work_are_ever_more_seldom(monkeypatch):
    clock_s = itertools.count()
    monkeypatch.setattr(progress.time, "monotonic", lambda: float(next(clock_s)))
    stream = io.StringIO()
    with progress.on_stream(stream)("sweep") as watched:
        counts = []
        for second in range(1, 4 * 3600):
            watched.advance(second, 4 * 3600)
            counts.append(stream.getvalue().count("\n"))
    assert counts[99] == 10  # one every ten seconds in the first
    assert counts[2 * 3600] < 100
    last_hour = counts[-1] - counts[3 * 3600]
    assert 11 <= last_hour <= 12  # one every five minutes in the end


def test_the_time_is_that_since_the_work_began_whatever_becomes_known_of_its_length(monkeypatch):
    clock_s = itertools.count()
    monkeypatch.setattr(progress.time, "monotonic", lambda: float(next(clock_s)))
    stream = io.StringIO()
    with progress.on_stream(stream)("explain") as watched:
        for done in range(61):
            watched.advance(done, 100 + done)
    assert "explain 37 % [01:00, left 01:41" in stream.getvalue()


def test_a_terminal_sees_a_bar_that_is_gone_at_the_end():
    stream = Terminal()
    with progress.on_stream(stream)("8 runs") as watched:
        watched.advance(0, 800)
        watched.advance(0, 800, "compiling")
        assert "8 runs, compiling" in stream.getvalue()
    written = work(Terminal())
    assert "drive: batch" in written and "drive: batch, iteration" in written
    assert "\n" not in written
    assert written.rstrip("\r").endswith("\r" + " " * len(written.rstrip("\r").rpartition("\r")[2]))
