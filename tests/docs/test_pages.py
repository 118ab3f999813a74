"""The documentation works as printed: files, programs and commands run, links lead somewhere, tables are the tool's."""

import io
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import redirect_stdout
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import pytest

from toolkit import cli
from toolkit.cli import main
from toolkit.cli.compare import SEQUENCES
from toolkit.errors import VislamError
from toolkit.registry import defaults

PROJECT = Path(__file__).parents[2]
README, EXTENDING, COURSE = PROJECT / "README.md", PROJECT / "docs/extending.md", PROJECT / "docs/course.md"
PAGES = (
    README,
    *sorted((PROJECT / "docs").glob("*.md")),
    PROJECT / "data/README.md",
    PROJECT / ".github/CONTRIBUTING.md",
)

_NUMBER = re.compile(r"(?<!\w)-?\d+(?:\.\d+)?")
_FENCE = re.compile(r"^```(?P<language>\w*)(?: title=\"(?P<title>[^\"]+)\")?\n(?P<text>.*?)^```$", re.M | re.S)


@dataclass(frozen=True)
class Block:
    """One fenced block of a page; one with a title is the file of that name."""

    language: str
    title: str | None
    text: str


def blocks(page: Path) -> list[Block]:
    found = _FENCE.finditer(page.read_text(encoding="utf-8"))
    return [Block(b["language"], b["title"], b["text"]) for b in found]


def commands(block: Block) -> Iterator[str]:
    """Yield each ``vislam`` command; what sets up the environment before it is the CI's to run."""
    if block.language == "sh":
        parts = (part.strip() for line in block.text.splitlines() for part in line.split("&&"))
        yield from (part for part in parts if part.startswith("vislam "))


def carry_out(steps: Sequence[str | Block]) -> list[str]:
    """Do the commands and programs of a page one after the other, as a terminal and a script would.

    Returns what each printed. All is done in this process, where no audit is done twice, no figure is rendered and no
    process is started: see the fixtures of the tests. The first line of the README is run as a stranger runs it.
    """
    printed = []
    for step in steps:
        with redirect_stdout(io.StringIO()) as out:
            if isinstance(step, Block):
                exec(compile(step.text, "a block of the page", "exec"), {"__name__": "__main__"})
            else:
                # 1 is a result, too: an estimator of an example may diverge, and its text says so.
                status = main(shlex.split(step)[1:])
                assert status in (0, 1), (step, status)
        printed.append(out.getvalue())
    return printed


def as_a_stranger(command: str, folder: Path) -> str:
    """Run a command in processes of its own, with as many workers and all the pixels that a user gets."""
    words = [sys.executable, "-m", "toolkit.cli", *shlex.split(command)[1:]]
    ended = subprocess.run(words, cwd=folder, capture_output=True, text=True, timeout=300, check=False)
    assert ended.returncode in (0, 1), ended.stderr
    assert "Traceback" not in ended.stderr, ended.stderr
    return ended.stdout


@pytest.fixture
def alone(one_process: None, unrendered: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return an empty directory, the current one."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


FIRST_LINE = "vislam compare"
# Stands for the digits of a run that diverged: they hang on the last digits of the libraries.
_NO_DIGITS = "..."
MARKS = ("overconfident", "timid", "heavy-tailed", "contradicted")


# The page on extending drops files into the packages. A copy of them is where nothing else sees these.
_IN_A_COPY = """
import json, sys
from pathlib import Path
from matplotlib.figure import Figure
from tests.docs.test_pages import EXTENDING, USE, carry_out, steps_of
from toolkit.experiment import pipeline

pipeline.usable_cpus = lambda: 1
Figure.savefig = lambda figure, path, **options: Path(path).touch()
json.dump(carry_out([*steps_of(EXTENDING), *USE]), sys.stdout)
"""
# What a user does who follows the page.
USE = (
    *(f"vislam list {kind}" for kind in ("estimators", "formats", "metrics")),
    "vislam compare drive --estimators constant-velocity,dead-reckoning --max-frames 60 --out run",
)


class Extended(NamedTuple):
    """What the page on extending, and a user who follows it, are shown, and the folder in which that was."""

    by_page: list[str]
    listed: str
    folder: Path


@pytest.fixture(scope="module")
def extended(tmp_path_factory: pytest.TempPathFactory) -> Extended:
    """Do what the page on extending shows, and then use all that it adds, in one process of a copy of the packages."""
    folder = tmp_path_factory.mktemp("extending")
    for package in ("toolkit", "filters"):
        # With what is compiled, for that takes longer than what the page shows; without what is just being written.
        unfinished = shutil.ignore_patterns("*.pyc.*", "*.tmp.*")
        shutil.copytree(PROJECT / package, folder / package, ignore=unfinished)
    write_files(EXTENDING, folder)
    # -c puts the working directory first on the path, so the copy is what is imported.
    words, path = [sys.executable, "-c", _IN_A_COPY], {**os.environ, "PYTHONPATH": str(PROJECT)}
    ended = subprocess.run(words, cwd=folder, env=path, capture_output=True, text=True, timeout=300, check=False)
    assert ended.returncode == 0, ended.stderr
    assert "Traceback" not in ended.stderr, ended.stderr
    printed = json.loads(ended.stdout)
    return Extended(printed[: -len(USE)], "\n".join(printed[-len(USE) : -1]), folder)


def write_files(page: Path, folder: Path) -> None:
    """Write the files that a page shows to where it says."""
    for block in blocks(page):
        if block.title is not None:
            (folder / block.title).write_text(block.text, encoding="utf-8")


def _name(page: Path) -> str:
    return str(page.relative_to(PROJECT))


def steps_of(page: Path) -> list[str | Block]:
    """Return the commands and the programs of a page, in order."""
    return [
        step
        for block in blocks(page)
        if block.title is None
        for step in ([block] if block.language == "python" else commands(block))
    ]


by_page = pytest.mark.parametrize("page", PAGES, ids=_name)


@pytest.mark.parametrize(
    "page", [page for page in PAGES if steps_of(page) and page not in (README, EXTENDING, COURSE)], ids=_name
)
def test_everything_a_page_shows_runs_and_prints_the_tables_shown(page: Path, alone: Path) -> None:
    write_files(page, alone)
    steps = steps_of(page)
    assert_tables_are_those_shown(page, dict(zip(steps, carry_out(steps), strict=True)))


def test_everything_the_readme_shows_runs_and_prints_the_tables_shown(alone: Path) -> None:
    printed = as_a_stranger(f"{FIRST_LINE} --max-frames 40", alone)
    assert {row[:2] for row in _rows(printed)} == {(name, one) for name in SEQUENCES for one in defaults()}
    assert (alone / "runs").is_dir()
    steps = [step for step in steps_of(README) if step != FIRST_LINE]
    assert_tables_are_those_shown(README, dict(zip(steps, carry_out(steps), strict=True)))


def test_everything_the_page_on_extending_shows_runs_and_prints_the_tables_shown(extended: Extended) -> None:
    assert_tables_are_those_shown(EXTENDING, dict(zip(steps_of(EXTENDING), extended.by_page, strict=True)))


def test_everything_the_page_for_the_course_shows_runs_and_prints_what_is_shown(
    real: Callable[[str], Path], alone: Path
) -> None:
    (alone / "03.npz").symlink_to(real("ucsd/03.npz").resolve())
    steps = steps_of(COURSE)
    printed = dict(zip(steps, carry_out(steps), strict=True))
    assert_tables_are_those_shown(COURSE, printed)
    program, shown = next(pair for pair in pairwise(blocks(COURSE)) if pair[0].language == "python")
    for line, fresh in zip(shown.text.splitlines(), printed[program].splitlines(), strict=True):
        assert _NUMBER.sub("", line) == _NUMBER.sub("", fresh)
        # Metres, after 1.3 km; other versions of the libraries round another way.
        assert [*map(float, _NUMBER.findall(line))] == pytest.approx([*map(float, _NUMBER.findall(fresh))], abs=2.0)


def assert_tables_are_those_shown(page: Path, printed: Mapping[str | Block, str]) -> None:
    """Compare the tables a page shows with those its commands printed."""
    for block in blocks(page):
        if block.language == "text" and block.text.startswith("$ vislam"):
            _assert_tables_agree(block.text, printed[block.text.partition("\n")[0].removeprefix("$ ")])


def _assert_tables_agree(shown: str, printed: str) -> None:
    if shown.startswith("$ vislam check-data"):
        lines, _, rest = shown.partition("\n")[2].partition("...")
        assert rest.strip() == ""
        assert printed.startswith(lines)  # the whole table of findings
    there = _rows(printed)
    for row, cells in _rows(shown).items():
        assert row in there
        if row[3] == "diverged":
            assert {*cells} == {_NO_DIGITS}, row
            continue
        for cell, fresh in zip(cells[:-2], there[row][:-2], strict=True):  # the last two are times of a machine
            if "-" in (cell, fresh):
                assert cell == fresh, row
            else:
                # Two decimals are shown, and other versions of the libraries round another way.
                assert float(cell) == pytest.approx(float(fresh), rel=0.1, abs=0.02), row


def _rows(text: str) -> dict[tuple[str, ...], list[str]]:
    """Return the cells of every row of every table in a text, by sequence, estimator, output, status and mark."""
    rows, sequence, row = dict[tuple[str, ...], list[str]](), "", tuple[str, ...]()
    for line in text.splitlines():
        words = line.split()
        if re.match(r"\S+: \d+ frames, ", line):
            sequence = words[0].rstrip(":")
        elif words[1:2] in (["causal"], ["final"], ["both"]):
            row = (sequence, *words[:3])
            rows[row] = words[3:]
        elif line.strip() in MARKS:
            rows[*row, line.strip()] = rows.pop(row)
    return rows


def test_the_examples_of_extending_do_what_the_page_says(extended: Extended) -> None:
    assert all(name in extended.listed for name in ("constant-velocity", "plain-json", "path_ratio"))
    runs = json.loads((extended.folder / "run/metrics.json").read_text())["runs"]
    assert [run["status"] for run in runs] == ["diverged", "diverged", "ok", "ok"]
    # White noise of 0.1 m on steps of 0.5 m and more lengthens a path by no more than a few percent.
    assert runs[-1]["metrics"]["path_ratio"] == pytest.approx(1.0, abs=0.1)


@by_page
def test_links_lead_somewhere_and_files_that_are_named_exist(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    for target in re.findall(r"\]\(([^)\s]+)\)", text):
        name, _, anchor = target.partition("#")
        if name.startswith("https:"):
            continue
        linked = (page.parent / name).resolve() if name else page
        assert linked.exists(), target
        assert linked.is_relative_to(PROJECT), target
        assert not anchor or anchor in _anchors(linked), target
    for name in re.findall(r"`((?:toolkit|filters|tests|notebooks|docs)/[\w/.]+)`", text):
        assert (PROJECT / name).exists(), name


def _anchors(page: Path) -> set[str]:
    """Return what GitHub calls the headings of a page."""
    headings = re.findall(r"^#+ (.+)$", page.read_text(encoding="utf-8"), flags=re.M)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@by_page
def test_lines_are_short_and_no_path_is_that_of_one_machine(
    page: Path, machine_paths: Callable[[str], list[str]]
) -> None:
    text = page.read_text(encoding="utf-8")
    assert machine_paths(text) == []
    assert f"{PROJECT}/" not in text
    prose = [line for line in text.splitlines() if not line.startswith("|")]
    assert max(map(len, prose)) <= 120


def test_every_exit_status_is_in_the_docs() -> None:
    """Those that errors carry, and those of a run that ended well, found something, or was ended from outside."""
    listed = map(int, re.findall(r"^\| (\d+) \|", (PROJECT / "docs/runs.md").read_text(encoding="utf-8"), flags=re.M))
    kinds = {VislamError}
    for _ in range(5):
        kinds |= {one for kind in kinds for one in kind.__subclasses__()}
    of_a_command = {cli._DEFECT, cli._SYSTEM, cli._INTERRUPTED, cli._READER_GONE}
    assert [*listed] == sorted({0, 1} | {kind.exit_status for kind in kinds} | of_a_command)
