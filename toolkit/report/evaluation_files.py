"""The directory an evaluation leaves behind: evaluation.json, the leaderboard as a page and as Markdown."""

from pathlib import Path

from toolkit.errors import DataError
from toolkit.evaluation.document import evaluation_document, read_evaluation
from toolkit.evaluation.standings import EvaluatedSystems
from toolkit.files.documents import to_text
from toolkit.files.writing import check_replaceable, replaced_directory
from toolkit.report.evaluation_text import evaluation_csv, evaluation_markdown
from toolkit.report.html.leaderboard import leaderboard_page

EVALUATION = "evaluation.json"
_FILES = (EVALUATION, "leaderboard.html", "leaderboard.md", "runs.csv")


def check_evaluation_directory(target: Path) -> None:
    """Raise OutputError unless an evaluation can be written at ``target`` without the loss of anybody's files."""
    check_replaceable(target, _written_by_us)


def write_evaluation(evaluation: EvaluatedSystems, target: Path) -> None:
    """Write the directory, in the place of an earlier one; raises OutputError where that cannot be."""
    texts = (
        to_text(evaluation_document(evaluation)),
        leaderboard_page(evaluation),
        evaluation_markdown(evaluation),
        evaluation_csv(evaluation),
    )
    with replaced_directory(target, _written_by_us) as directory:
        for name, text in zip(_FILES, texts, strict=True):
            (directory / name).write_text(text, encoding="utf-8")


def _written_by_us(directory: Path) -> frozenset[str]:
    """Return what in a directory an earlier evaluation wrote; nothing where its document is none of ours."""
    try:
        read_evaluation(directory / EVALUATION)
    except DataError:
        return frozenset()
    return frozenset(_FILES)
