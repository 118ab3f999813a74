"""Progress is seen on a terminal and leaves nothing in a log."""

import io

from toolkit.progress import progress_on


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def work(stream: io.StringIO) -> str:
    with progress_on(stream, "drive: ekf") as progress:
        for done in range(1, 4):
            progress.advance(done, 3)
    return stream.getvalue()


def test_nothing_is_written_to_a_log() -> None:
    assert work(io.StringIO()) == ""


def test_a_terminal_sees_a_bar_that_is_erased_at_the_end() -> None:
    written = work(Terminal())
    assert "drive: ekf" in written
    assert "\n" not in written
    assert written.endswith("\r\x1b[2K")
