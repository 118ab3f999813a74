"""What long work reports its progress to; :mod:`toolkit.cli.progress_display` shows it."""

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from typing import Protocol


class Progress(Protocol):
    """Receives the number of steps done, of how many."""

    def advance(self, done: int, total: int, stage: str = "") -> None:
        """Report the steps done; ``stage`` names the current part of the work, such as a solver's iteration.

        A different total, or fewer steps done than before, begins another count, and its time is measured anew.
        """


class Silent:
    """Progress that is not displayed."""

    def advance(self, done: int, total: int, stage: str = "") -> None:
        """Do nothing."""


SILENT = Silent()
# Begins a named piece of work: a context manager that returns the Progress to report to; the work ends with the
# context.
ProgressFor = Callable[[str], AbstractContextManager[Progress]]


@contextmanager
def silent(_label: str) -> Iterator[Progress]:
    yield SILENT
