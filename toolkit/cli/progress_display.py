"""Progress of long work on a stream, with the time left: a bar on a terminal, a line from time to time in a log."""

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TextIO

from toolkit.errors import printable
from toolkit.progress import Progress, ProgressFor

# Seconds before the first line and between two lines where the stream is a file or a pipe. For long work the interval
# grows to a share of the time so far, and to five minutes at most.
LOG_EVERY_S, _LOG_SHARE, _LOG_AT_MOST_S = 10.0, 0.05, 300.0
_FORMAT = "{desc} {percentage:3.0f} %|{bar}| {n_fmt}/{total_fmt} [{elapsed}, left {remaining}]"
_LOG_FORMAT = "{desc} {percentage:.0f} % [{elapsed}, left {remaining}]"


def of_this_process() -> ProgressFor:
    return on_stream(sys.stderr)


def on_stream(stream: TextIO) -> ProgressFor:
    """Return a display of progress on a stream: one line, drawn anew, on a terminal, else a line now and then."""

    @contextmanager
    def shown(named: str) -> Iterator[Progress]:
        label = printable(named)
        if not stream.isatty():
            yield _Log(label, stream)
            return
        bar = _Bar(label, stream)
        try:
            yield bar
        finally:
            bar.close()

    return shown


class _Bar:
    """A line on a terminal that redraws itself and is gone when the work is done."""

    def __init__(self, label: str, stream: TextIO) -> None:
        from tqdm import tqdm

        self._label, self._stage = label, ""
        self._bar = tqdm(desc=label, total=0, file=stream, leave=False, dynamic_ncols=True, bar_format=_FORMAT)

    def advance(self, done: int, total: int, stage: str = "") -> None:
        if done < self._bar.n:
            self._bar.reset()
        self._bar.total = total  # which may become known better on the way
        if stage != self._stage:
            self._stage = stage
            self._bar.set_description_str(f"{self._label}, {stage}" if stage else self._label)
        self._bar.update(done - self._bar.n)  # by none as well: the time is drawn anew

    def close(self) -> None:
        self._bar.close()


class _Log:
    """A line now and then in a file or a pipe; work that is soon done leaves none."""

    def __init__(self, label: str, stream: TextIO) -> None:
        self._label, self._stream = label, stream
        self._done, self._began_s = 0, time.monotonic()
        self._first_s = self._shown_s = self._began_s

    def advance(self, done: int, total: int, stage: str = "") -> None:
        """Write a line if enough time has passed since the last one."""
        now_s = time.monotonic()
        if done < self._done:
            self._began_s = now_s
        self._done = done
        if now_s - self._shown_s < max(LOG_EVERY_S, min(_LOG_SHARE * (now_s - self._first_s), _LOG_AT_MOST_S)):
            return
        from tqdm import tqdm

        label = f"{self._label}, {stage}" if stage else self._label
        meter = tqdm.format_meter(done, total, now_s - self._began_s, prefix=label, bar_format=_LOG_FORMAT)
        self._stream.write(f"{meter}\n")
        self._stream.flush()
        self._shown_s = now_s


def print_above(text: str) -> None:
    """Print a text on standard output, above the line that shows progress where there is one."""
    if not sys.stderr.isatty():
        print(text, flush=True)
        return
    from tqdm import tqdm

    tqdm.write(text, file=sys.stdout)
    sys.stdout.flush()
