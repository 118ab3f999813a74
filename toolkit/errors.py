"""The errors a user can meet, each with the exit status the command line gives it.

A message says what is wrong, where (file, field, row) and what to do, in one line.
"""

import re
from collections.abc import Iterable
from difflib import get_close_matches
from typing import ClassVar

_LONG_WORD, _SHOWN = re.compile(r"\S{300,}"), 60
# Names that begin with an unknown one are suggested if it has this many letters and no more than this many names do.
_FEWEST_LETTERS, _MOST_BEGUN = 3, 4


class VislamError(Exception):
    """Anything the toolkit refuses to do, with a message of one line."""

    exit_status: ClassVar[int] = 1


class UnknownNameError(VislamError):
    """A name that nothing has, as of a metric."""

    exit_status = 2


class DataError(VislamError):
    """A recording or truth file that cannot be used as it is."""

    exit_status = 3


class OutputError(VislamError):
    """A result that cannot be written where it was asked for."""

    exit_status = 4


class EstimatorError(VislamError):
    """An estimator that is unknown, unavailable or cannot go on with its run."""

    exit_status = 5


class ExtensionError(VislamError):
    """A module of another package, or a file dropped in, that is missing or does not define what it must."""

    exit_status = 70


class SystemLimitError(VislamError):
    """The system does not provide enough processes, open files or shared memory."""

    exit_status = 71


def printable(text: str) -> str:
    """Return a text as one line in which nothing acts on a terminal or splits a table.

    Control and format characters, ends of lines and bytes that are no text, as file names may hold, become escapes.
    """
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode("ascii") for c in text)


def one_line(message: str) -> str:
    """Return a message as one printable line; words longer than a file name may be are cut in the middle."""
    line = printable(" ".join(message.split()))
    return _LONG_WORD.sub(lambda word: f"{word[0][:_SHOWN]}...{word[0][-_SHOWN:]}", line)


def in_words(error: BaseException, where: str = "") -> str:
    """Return the type of an error, where it was raised and the first paragraph of its message, as one line.

    GTSAM's messages begin with an empty line and end with a paragraph of general advice.
    """
    first = re.split(r"\n\s*\n", str(error).strip(), maxsplit=1)[0]
    return one_line(f"{type(error).__name__}{where}: {first}").removesuffix(":")


def nearest(name: str, known: Iterable[str]) -> str:
    """Return the known name most like a misspelt one, whatever the case of its letters, or "" where none is close."""
    by_folded = {candidate.casefold(): candidate for candidate in known}
    close = get_close_matches(name.casefold(), by_folded, n=1)
    return by_folded[close[0]] if close else ""


def _meant(name: str, known: Iterable[str]) -> str:
    """Return the nearest known name or, where none is close, those that begin with what was given, if they are few."""
    names = list(known)
    begun = [one for one in names if len(name) >= _FEWEST_LETTERS and one.casefold().startswith(name.casefold())]
    *others, last = begun if 0 < len(begun) <= _MOST_BEGUN else [""]
    return nearest(name, names) or (f"{', '.join(others)} or {last}" if others else last)


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """Return the end of a message about an unknown name: the known names that are similar, or nothing."""
    close = _meant(name, known)
    return f"; did you mean {close}?" if close else ""


def no_such(kind: str, name: str, known: Iterable[str]) -> str:
    """Return the message for an unknown name: the known names that are similar, then all of them."""
    names = list(known)
    close = _meant(name, names)
    hint = f" (did you mean {close}?)" if close else ""
    return f"no {kind} is called {name}{hint}; there are {', '.join(names)}"


def type_of(value: object) -> str:
    """Say of which type a value is, as in "an int" and "a list"."""
    if value is None:
        return "None"
    name = type(value).__name__
    return f"{'an' if name[0] in 'aeioAEIO' else 'a'} {name}"
