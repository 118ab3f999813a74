"""The notebooks: .py and .ipynb are one notebook, it runs on built-in data alone, and what is kept is small."""

import ast
import importlib.util
import os
import re
import runpy
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import nbformat
import pytest

ROOT = Path(__file__).resolve().parents[2]
NOTEBOOKS = ROOT / "notebooks"
SOURCES = sorted(NOTEBOOKS.glob("[0-9][0-9]_*.py"))
MOST_BYTES = 300_000

each = pytest.mark.parametrize("source", SOURCES, ids=lambda source: source.stem)


@pytest.fixture(scope="module")
def execution() -> ModuleType:
    """Return notebooks/execute.py, which is a program and no part of a package."""
    spec = importlib.util.spec_from_file_location("execute_notebooks", NOTEBOOKS / "execute.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@each
def test_the_pair_has_the_same_cells(source: Path, execution: ModuleType) -> None:
    written, kept = execution.read_source(source), nbformat.read(source.with_suffix(".ipynb"), 4)
    assert [(c.cell_type, c.source) for c in kept.cells] == [(c.cell_type, c.source) for c in written.cells], (
        f"python notebooks/execute.py {source.name} writes it again"
    )


@each
def test_what_it_imports_of_the_toolkit_is_there(source: Path) -> None:
    """To execute them takes minutes, and is not done with every run of the tests."""
    for node in ast.walk(ast.parse(source.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("toolkit"):
            exec(f"from {node.module} import {', '.join(alias.name for alias in node.names)}")


@each
def test_what_is_kept_was_executed_without_an_error_and_is_small_and_of_no_machine(
    source: Path, machine_paths: Callable[[str], list[str]]
) -> None:
    kept = source.with_suffix(".ipynb")
    notebook = nbformat.read(kept, 4)
    nbformat.validate(notebook)
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert [cell.execution_count for cell in code] == list(range(1, len(code) + 1))
    assert not [o for cell in code for o in cell.outputs if o.output_type == "error" or o.get("name") == "stderr"]
    assert kept.stat().st_size <= MOST_BYTES
    text = kept.read_text(encoding="utf-8")
    assert machine_paths(text) == []
    places = {Path.home(), Path(tempfile.gettempdir()), ROOT} - {Path("/")}  # the home of a user who has none
    assert not [place for place in places if f"{place}{os.sep}" in text]


@pytest.mark.parametrize("page", [*SOURCES, NOTEBOOKS / "README.md"], ids=lambda page: page.name)
def test_links_lead_somewhere(page: Path) -> None:
    linked = re.findall(r"\]\(([^)#\s]+)", page.read_text(encoding="utf-8"))
    assert not [target for target in linked if not (NOTEBOOKS / target).exists()]


@pytest.mark.notebooks
@each
def test_it_runs_where_no_real_recording_is(
    source: Path, execution: ModuleType, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("VISLAM_DATA", str(tmp_path))
    executed = execution.execute(source)  # raises where a cell fails
    reported = "".join(o.get("text", "") for cell in executed.cells for o in cell.get("outputs", []))
    assert "the real" not in reported


def test_the_first_cell_for_colab_installs_the_toolkit_where_it_is_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("mkdocs", reason='the site is built with mkdocs: pip install ".[docs]"')
    with_first_cell = runpy.run_path(str(ROOT / "docs/site/repository.py"))["with_first_cell"]
    first, second = with_first_cell({"cells": ["the first"]}, "https://example.org/owner/name")["cells"]
    (tmp_path / "vislam-toolkit/notebooks").mkdir(parents=True)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    monkeypatch.setattr(importlib.util, "find_spec", lambda _: None)
    called: list[list[str]] = []
    monkeypatch.setattr(subprocess, "run", lambda words, check: called.append(words))
    exec(first["source"], {})
    assert [(words[-2:], Path.cwd().name) for words in called] == [
        (["https://example.org/owner/name", "vislam-toolkit"], "notebooks"),
        (["-q", "./vislam-toolkit"], "notebooks"),
    ]
    assert second == "the first"
