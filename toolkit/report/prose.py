"""Lines of text: wrapped to the width of a terminal, or whole where they go into a file or a pipe."""

import re
import sys
import textwrap
from collections.abc import Iterable, Iterator
from shutil import get_terminal_size

from toolkit.errors import printable

# Widest table and text; on a terminal, text has its width, but at least 40 columns.
WIDTH, _NARROWEST = 100, 40
Width = int | None
_LABEL = 7
# An underscore inside a word is none; a minus, a plus or a number is one only at the beginning of a line.
_MARKUP = re.compile(r"[\\`*<>\[\]|&]|(?<!\w)_|_(?!\w)|^[#~+-]|^\d+(?=[.)] )")


def width_of_output() -> Width:
    """Return the width of text on standard output: None where it is not a terminal."""
    if not sys.stdout.isatty():
        return None
    return min(max(get_terminal_size((WIDTH, 24)).columns, _NARROWEST), WIDTH)


def filled(text: str, width: Width, first: str = "", further: str = "  ") -> str:
    """Return a text in lines no wider than ``width``, behind what its first line and the others begin with."""
    text = printable(text)
    if width is None:
        return first + text
    return textwrap.fill(text, width, initial_indent=first, subsequent_indent=further)


def in_markdown(text: str) -> str:
    """Return a text in one line that Markdown shows as it is: no markup, no table, no HTML, nothing that acts."""
    return _MARKUP.sub(r"\\\g<0>", printable(text))


def markdown_section(title: str, entries: Iterable[str]) -> Iterator[str]:
    """Yield the heading and the list of a section of Markdown, each a paragraph; nothing where there is no entry."""
    lines = [f"- {in_markdown(entry)}" for entry in entries]
    if lines:
        yield f"## {title}"
        yield "\n".join(lines)


def section(title: str, entries: Iterable[str], width: Width) -> Iterator[str]:
    """Yield entries under a title that stands before the first."""
    for i, entry in enumerate(entries):
        label = f"{title}:" if i == 0 else ""
        yield filled(entry, width, f"{label:<{_LABEL}}", " " * (_LABEL + 2))
