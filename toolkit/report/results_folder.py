"""The folder of a sweep or an explanation: document, text and figures, beside the outcomes that it is made from."""

import base64
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Protocol, TypeVar

import msgspec

from toolkit.errors import DataError
from toolkit.experiment.outcome_store import OUTCOMES, files_of_ours
from toolkit.files.reading import read_input
from toolkit.files.writing import replaced_directory
from toolkit.report.run_directory import PAGE, take_over
from toolkit.report.text import Table, as_html, in_html

if TYPE_CHECKING:
    from toolkit.report.figures.style import NamedFigure

_FIGURES = "figures"
Record = TypeVar("Record", bound=msgspec.Struct)


class WithFiles(Protocol):
    """A document that names the files of its folder."""

    @property
    def files(self) -> tuple[str, ...]:
        """Return the files, relative to the folder."""


def own_files(directory: Path, document: str, read: Callable[[Path], WithFiles]) -> frozenset[str]:
    """Return what in a folder was written with a document there, by its relative path; folders have a slash behind."""
    files = set(files_of_ours(directory))
    with suppress(DataError):
        files |= {document, PAGE, *read(directory / document).files}
    return frozenset(files | {f"{part.as_posix()}/" for file in files for part in PurePosixPath(file).parents} - {"./"})


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


def results_section(title: str, words: str, table: Table, figures: Mapping[str, str], directory: Path) -> str:
    """Return the section of the page for a folder, with its figures (file -> caption) inside, as HTML.

    Raises DataError where a figure is missing.
    """
    parts = [f"<h2>{in_html(title)}</h2>", f"<p>{in_html(words)}</p>", f'<div class="wide">{as_html(table)}</div>']
    parts += [f'<p class="fine">{in_html(line)}</p>' for line in table.under]
    for name, caption in figures.items():
        image = base64.b64encode(read_input(directory / name)).decode("ascii")
        figure = f'<img src="data:image/png;base64,{image}" alt="{in_html(caption)}" style="max-width: 100%">'
        parts.append(f"<figure>{figure}<figcaption>{in_html(caption)}</figcaption></figure>")
    return f'<section class="card results">{"".join(parts)}</section>'
