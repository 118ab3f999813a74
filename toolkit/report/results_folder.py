"""What the commands that write a folder share: which of its files are ours, and how outcomes are kept in it.

The folder of a sweep or an explanation is written here whole: document, text and figures.
"""

import shutil
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Generic, NamedTuple, TypeVar

from msgspec import Struct

from toolkit.errors import DataError
from toolkit.experiment.outcome_store import OUTCOMES, files_of_ours
from toolkit.files.documents import to_text
from toolkit.files.writing import check_replaceable, replaced_directory, with_folders
from toolkit.report.html import card
from toolkit.report.text import Table, Width, as_markdown, as_text, filled, in_markdown

if TYPE_CHECKING:
    from toolkit.report.figures.style import NamedFigure

PAGE = "report.html"
_FIGURES = "figures"
Record = TypeVar("Record", bound=Struct)


def own_files(directory: Path, written: Callable[[Path], Iterable[str]]) -> frozenset[str]:
    """Return what of ours is in a folder by its relative path, folders with a slash behind.

    It is outcomes, and what was ``written`` as the folder's document says, which may raise DataError where there is no
    such document of ours: many programs write a file of that name.
    """
    files = set(files_of_ours(directory))
    with suppress(DataError):
        files |= set(written(directory))
    return with_folders(files)


def take_over(file: Path, place: Path) -> None:
    place.parent.mkdir(parents=True, exist_ok=True)
    try:
        place.hardlink_to(file)
    except OSError:  # a file system without links
        shutil.copyfile(file, place)


class Shown(NamedTuple):
    """What a document says: title, words, table, captions by figure, and files."""

    title: str
    words: str
    table: Table
    figures: Mapping[str, str]
    files: tuple[str, ...]


@dataclass(frozen=True)
class Results(Generic[Record]):
    """The folder of a kind of results: the names of its document and its Markdown, how one is read and shown."""

    document: str
    markdown: str
    read: Callable[[Path], Record]
    shown: Callable[[Record], Shown]

    def is_in(self, directory: Path) -> bool:
        return (directory / self.document).is_file()

    def check(self, target: Path) -> None:
        """Raise OutputError unless the results can be written at ``target`` without the loss of anybody's files."""
        check_replaceable(target, self._ours)

    def _ours(self, directory: Path) -> frozenset[str]:
        return own_files(directory, lambda at: (self.document, PAGE, *self.shown(self.read(at / self.document)).files))

    def text(self, record: Record, width: Width = None) -> str:
        shown = self.shown(record)
        return f"{filled(shown.words, width, further='')}\n\n{as_text(shown.table)}"

    def as_markdown(self, record: Record) -> str:
        shown = self.shown(record)
        figures = (f"![{in_markdown(said)}]({name})\n\n{in_markdown(said)}" for name, said in shown.figures.items())
        parts = (f"# {in_markdown(shown.title)}", in_markdown(shown.words), as_markdown(shown.table), *figures)
        return "\n\n".join(parts) + "\n"

    def section(self, directory: Path) -> str:
        """Return the section of the page for a folder; raises DataError where its document or a figure is missing."""
        shown = self.shown(self.read(directory / self.document))
        figures = {directory / name: caption for name, caption in shown.figures.items()}
        return card(shown.title, [shown.words], shown.table, figures)

    def write(
        self, target: Path, figures: "Iterable[NamedFigure]", made: Callable[[dict[str, str], tuple[str, ...]], Record]
    ) -> Record:
        """Write the folder anew: figures, PNG and PDF, then the document and its Markdown; return the document.

        It is ``made`` of the captions by file and of the files there are. Outcomes kept in the folder stay. Raises
        OutputError where it cannot be written or holds something else; nothing is left behind then.
        """
        from toolkit.report.figures import save

        drawn, names = list(figures), (self.markdown, self.document)
        with replaced_directory(target, self._ours) as directory:
            if (target / OUTCOMES).exists():
                take_over(target / OUTCOMES, directory / OUTCOMES)
            (directory / _FIGURES).mkdir()
            save(drawn, directory / _FIGURES, "pdf")
            captions = {f"{_FIGURES}/{name}": text for name, text in save(drawn, directory / _FIGURES).items()}
            written = sorted(path.relative_to(directory).as_posix() for path in directory.rglob("*") if path.is_file())
            record = made(captions, (*written, *names))
            for name, text in zip(names, (self.as_markdown(record), to_text(record)), strict=True):
                (directory / name).write_text(text, encoding="utf-8")
        return record
