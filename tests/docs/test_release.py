"""What goes out with a release: changes, citation, pictures and the site's menu belong to the version there is."""

import datetime
import re
import runpy
import tomllib
from pathlib import Path

import pytest
import yaml

import toolkit
from toolkit.cli import main

PROJECT = Path(__file__).parents[2]
DOCS = PROJECT / "docs"
VERSION = tomllib.loads((PROJECT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["version"]


def _released() -> tuple[str, str]:
    """Return the latest version of the changes and its date."""
    changes = (DOCS / "CHANGELOG.md").read_text(encoding="utf-8")
    return re.findall(r"^## \[(\d[^\]]*)\] - (\S+)$", changes, flags=re.M)[0]


def test_the_changes_begin_with_what_is_not_released_and_then_this_version() -> None:
    changes = (DOCS / "CHANGELOG.md").read_text(encoding="utf-8")
    headings = re.findall(r"^## \[([^\]]+)\]", changes, flags=re.M)
    assert headings[:2] == ["Unreleased", VERSION]
    kinds = set(re.findall(r"^### (.+)$", changes, flags=re.M))
    assert kinds <= {"Added", "Changed", "Deprecated", "Removed", "Fixed", "Security"}  # those of Keep a Changelog
    datetime.date.fromisoformat(_released()[1])


def test_the_installed_toolkit_says_the_same_version(capsys: pytest.CaptureFixture[str]) -> None:
    assert toolkit.__version__ == VERSION, "pip install -e . again"
    with pytest.raises(SystemExit):
        main(["--version"])
    assert capsys.readouterr().out == f"vislam {VERSION}\n"


def test_the_citation_is_of_the_format_and_of_the_version_released_last() -> None:
    # PyYAML makes a date of an unquoted one; the format means its text.
    citation = yaml.load((DOCS / "CITATION.cff").read_text(encoding="utf-8"), Loader=yaml.BaseLoader)
    assert {"cff-version", "message", "title", "authors"} <= citation.keys()  # what the format requires
    assert citation["cff-version"] == "1.2.0"
    assert (citation["version"], citation["date-released"]) == _released()


def test_every_page_and_notebook_has_its_place_in_the_sites_menu() -> None:
    menu = (DOCS / "site/mkdocs.yml").read_text(encoding="utf-8").partition("\nnav:")[2]
    named = re.findall(r": (\S+\.(?:md|ipynb))$", menu, flags=re.M)
    pages = [*DOCS.glob("*.md"), *(PROJECT / "notebooks").glob("*.ipynb"), PROJECT / "README.md"]
    assert {str(page.relative_to(PROJECT)) for page in pages} <= set(named)
    assert len(named) == len(set(named))
    assert not [name for name in named if not (PROJECT / name).exists()]


def test_every_picture_is_small_and_shown_and_can_be_made_again() -> None:
    pages = "".join(page.read_text(encoding="utf-8") for page in [*DOCS.glob("*.md"), PROJECT / "README.md"])
    made = runpy.run_path(str(DOCS / "site/pictures.py"))["FIGURES"]
    pictures = {picture.name: picture.stat().st_size for picture in (DOCS / "images").iterdir()}
    assert max(pictures.values()) <= 150_000
    assert {name for name in pictures if f"images/{name})" not in pages} == set()
    assert {name for name in pictures if name.endswith(".png")} == set(made)
