"""Progress of long work: a bar on a terminal, nothing in a log; both look the same to the loop that reports it."""

import time
from types import TracebackType
from typing import Self, TextIO

_WIDTH = 30
_REDRAW_S = 0.1
_ERASE_LINE = "\r\x1b[2K"


class Silent:
    """Progress nobody watches."""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        return None

    def advance(self, done: int, total: int) -> None:
        """Take note of nothing."""


class TerminalBar:
    """One line that redraws itself and is gone when the work is done."""

    def __init__(self, stream: TextIO, label: str) -> None:
        self._stream = stream
        self._label = label
        self._drawn_s = float("-inf")

    def __enter__(self) -> Self:
        self._draw("...")
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._draw("")
        self._stream.write(_ERASE_LINE)
        self._stream.flush()

    def advance(self, done: int, total: int) -> None:
        """Say that ``done`` of ``total`` steps are taken; redraws at most ten times a second."""
        if done >= total:
            # A smoother's work begins here: a full bar that stands still would look like a hang.
            self._draw(f"{total} frames read, finishing")
        elif time.monotonic() - self._drawn_s >= _REDRAW_S:
            filled = _WIDTH * done // total
            self._draw(f"[{'#' * filled}{'.' * (_WIDTH - filled)}] {done}/{total}")

    def _draw(self, text: str) -> None:
        self._drawn_s = time.monotonic()
        self._stream.write(f"{_ERASE_LINE}{self._label} {text}")
        self._stream.flush()


def progress_on(stream: TextIO, label: str) -> Silent | TerminalBar:
    """Return a bar where the stream is a terminal, and silence where it is a file or a pipe."""
    return TerminalBar(stream, label) if stream.isatty() else Silent()
