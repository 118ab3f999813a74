"""The errors a user can meet, each with the exit status the command line gives it.

A message says what is wrong, where (file, field, row) and what to do, in one line.
"""

from typing import ClassVar


class VislamError(Exception):
    """Anything the toolkit refuses to do, told in one line."""

    exit_status: ClassVar[int] = 1


class DataError(VislamError):
    """A recording or truth file that cannot be used as it is."""

    exit_status = 3


class OutputError(VislamError):
    """A result that cannot be written where it was asked for."""

    exit_status = 4


class EstimatorError(VislamError):
    """An estimator that is unknown, unavailable or cannot go on with its run."""

    exit_status = 5
