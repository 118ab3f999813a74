"""The files a check of the gate leaves behind: JUnit XML, Markdown and JSON, each only where it is asked for."""

from collections.abc import Callable, Mapping
from datetime import UTC, datetime
from pathlib import Path

import toolkit
from toolkit.errors import OutputError
from toolkit.files import check_parent, replaced_file
from toolkit.gate.verdict import Check
from toolkit.report.gate_json import gate_json
from toolkit.report.gate_junit import gate_junit
from toolkit.report.gate_words import gate_markdown
from toolkit.report.manifest import cpu_model, git_revision
from toolkit.report.metrics_json import to_text

WRITERS: Mapping[str, Callable[[Check], str]] = {
    "junit": gate_junit,
    "markdown": gate_markdown,
    "json": lambda check: to_text(gate_json(check)),
}


def check_writable(path: Path) -> None:
    """Raise OutputError unless a file can be written at ``path``; replaces nothing."""
    if path.is_dir():
        raise OutputError(f"{path} is a directory; name a file")
    check_parent(path.parent)


def write_check(check: Check, files: Mapping[str, Path]) -> None:
    """Write a check in each of the kinds of WRITERS that has a file; raise OutputError where one cannot be written."""
    for kind, path in files.items():
        write_text(path, WRITERS[kind](check))


def write_text(path: Path, text: str) -> None:
    """Write a text file at once or not at all, in the place of an earlier one if there is one."""
    with replaced_file(path) as partial:
        partial.write_text(text, encoding="utf-8")


def made_here(command: str) -> dict[str, str]:
    """Return what a baseline says of how, when and where it was made."""
    return {
        "command": command,
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "git_revision": git_revision(Path(toolkit.__file__).parent) or "not from a checkout",
        "cpu": cpu_model(),
    }
