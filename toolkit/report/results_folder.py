"""What the commands that write a folder share: which of its files are ours, and how outcomes are kept in it.

The folder of a sweep or an explanation is written here whole: document, text and figures.
"""

import shutil
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import msgspec

from toolkit.errors import DataError
from toolkit.experiment.outcome_store import OUTCOMES, files_of_ours
from toolkit.files.writing import replaced_directory, with_folders

if TYPE_CHECKING:
    from toolkit.report.figures.style import NamedFigure

PAGE = "report.html"
_FIGURES = "figures"
Record = TypeVar("Record", bound=msgspec.Struct)


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
    """Have a file in another place, too."""
    place.parent.mkdir(parents=True, exist_ok=True)
    try:
        place.hardlink_to(file)
    except OSError:  # a file system without links
        shutil.copyfile(file, place)


def write_results(
    target: Path,
    owner: Callable[[Path], frozenset[str]],
    figures: "Sequence[NamedFigure]",
    document: Callable[[dict[str, str], tuple[str, ...]], Record],
    texts: Mapping[str, Callable[[Record], str]],
) -> Record:
    """Write a folder anew: figures, PNG and PDF, then ``texts`` by file name, made of the document; return that.

    ``document`` makes it of the captions by file and of the files there are. Outcomes kept in the folder stay. Raises
    OutputError where it cannot be written or holds something else; nothing is left behind then.
    """
    from toolkit.report.figures import save

    with replaced_directory(target, owner) as directory:
        if (target / OUTCOMES).exists():
            take_over(target / OUTCOMES, directory / OUTCOMES)
        (directory / _FIGURES).mkdir()
        save(figures, directory / _FIGURES, "pdf")
        captions = {f"{_FIGURES}/{name}": text for name, text in save(figures, directory / _FIGURES).items()}
        written = sorted(path.relative_to(directory).as_posix() for path in directory.rglob("*") if path.is_file())
        made = document(captions, (*written, *texts))
        for name, text_of in texts.items():
            (directory / name).write_text(text_of(made), encoding="utf-8")
    return made
