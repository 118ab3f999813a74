"""The notebooks: .py and .ipynb are one notebook, it runs on built-in data alone, and what is kept is small."""

import ast
import importlib.util
import os
import re
import runpy
import subprocess
import sysconfig
import tempfile
import venv
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType

import nbformat
import pytest
from jupyter_client.manager import KernelManager
from nbclient import NotebookClient

ROOT = Path(__file__).resolve().parents[2]
NOTEBOOKS = ROOT / "notebooks"
SOURCES = sorted(NOTEBOOKS.glob("[0-9][0-9]_*.py"))
MOST_BYTES = 300_000

# Notebooks compare a recording several times, and each time it is loaded and audited anew: here that is done once.
AUDITED_ONCE = """
def audited_once():
    from dataclasses import replace
    from functools import cache
    from toolkit.experiment import recording
    from toolkit.settings import DEFAULTS

    # All that neither loading nor auditing looks at is left at its default.
    unread = {"start": "measurements", "noise": DEFAULTS.noise, "tracks": DEFAULTS.tracks, "card": False}
    audited = cache(recording.audited_recording)
    recording.audited_recording = lambda requested, progress=None: audited(replace(requested, **unread))

audited_once()
"""
# What a figure shows is tested elsewhere: here it is drawn, and encoded with few pixels.
FEW_PIXELS = "%config InlineBackend.print_figure_kwargs = {'dpi': 20, 'bbox_inches': None}"

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
def test_what_is_kept_was_executed_without_an_error_and_is_small(source: Path) -> None:
    kept = source.with_suffix(".ipynb")
    notebook = nbformat.read(kept, 4)
    nbformat.validate(notebook)
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert [cell.execution_count for cell in code] == list(range(1, len(code) + 1))
    assert not [o for cell in code for o in cell.outputs if o.output_type == "error" or o.get("name") == "stderr"]
    assert kept.stat().st_size <= MOST_BYTES


@each
def test_no_path_of_one_machine_is_kept(source: Path, machine_paths: Callable[[str], list[str]]) -> None:
    text = source.with_suffix(".ipynb").read_text(encoding="utf-8")
    assert machine_paths(text) == []
    places = {Path.home(), Path(tempfile.gettempdir()), ROOT} - {Path("/")}  # the home of a user who has none
    assert not [place for place in places if f"{place}{os.sep}" in text]


@pytest.mark.parametrize("page", [*SOURCES, NOTEBOOKS / "README.md"], ids=lambda page: page.name)
def test_links_lead_somewhere(page: Path) -> None:
    linked = re.findall(r"\]\(([^)#\s]+)", page.read_text(encoding="utf-8"))
    assert not [target for target in linked if not (NOTEBOOKS / target).exists()]


@pytest.fixture(scope="module")
def kernel(tmp_path_factory: pytest.TempPathFactory) -> Iterator[KernelManager]:
    """Start a kernel in which notebooks run one after the other, on one processor, without real recordings.

    To start one and to import the packages takes three seconds. What is kept was executed in a kernel for each.
    """
    manager = KernelManager()
    # Tests run side by side: what starts threads or processes of its own would only fight for the cores.
    variables = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "VISLAM_DATA": str(tmp_path_factory.mktemp("no"))}
    with _one_processor():
        manager.start_kernel(cwd=str(NOTEBOOKS), env={**os.environ, **variables})
    run(AUDITED_ONCE, manager)
    run(FEW_PIXELS, manager)
    yield manager
    manager.shutdown_kernel(now=True)


def run(cell: str, kernel: KernelManager) -> None:
    """Run a cell in a kernel; raises nbclient's CellExecutionError where it fails."""
    NotebookClient(nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell(cell)]), km=kernel).execute()


@contextmanager
def _one_processor() -> Iterator[None]:
    """Let what is started meanwhile use one processor, another one for each worker that runs tests."""
    if not hasattr(os, "sched_setaffinity"):
        yield
        return
    every = os.sched_getaffinity(0)
    worker = int(os.environ.get("PYTEST_XDIST_WORKER", "gw0").removeprefix("gw"))
    os.sched_setaffinity(0, {sorted(every)[worker % len(every)]})
    try:
        yield
    finally:
        os.sched_setaffinity(0, every)


@pytest.mark.notebooks
@each
def test_it_runs_where_no_real_recording_is(source: Path, execution: ModuleType, kernel: KernelManager) -> None:
    run("%reset -f", kernel)
    executed = execution.execute(source, kernel)  # raises where a cell fails
    reported = "".join(o.get("text", "") for cell in executed.cells for o in cell.get("outputs", []))
    assert "the real" not in reported


@pytest.mark.notebooks
def test_the_first_cell_for_colab_installs_the_toolkit_where_it_is_not(tmp_path: Path) -> None:
    """In an environment that has what the toolkit depends on and not the toolkit itself."""
    pytest.importorskip("mkdocs", reason='the site is built with mkdocs: pip install ".[docs]"')
    if not (ROOT / ".git").exists():
        pytest.skip("no repository that could be cloned")
    venv.create(tmp_path / "empty", with_pip=True)
    python = tmp_path / "empty/bin/python"
    (site_packages,) = (tmp_path / "empty/lib").glob("python*/site-packages")
    (site_packages / "dependencies.pth").write_text(sysconfig.get_path("purelib"))
    prepared = runpy.run_path(str(ROOT / "docs/site/repository.py"))["with_first_cell"]({"cells": []}, ROOT.as_uri())
    uses = "from recordings import real\nimport toolkit, filters\nprint(toolkit.__file__)\n"
    (tmp_path / "cell.py").write_text(prepared["cells"][0]["source"] + uses)
    variables = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    words = [str(python), "cell.py"]
    done = subprocess.run(words, cwd=tmp_path, env=variables, text=True, capture_output=True, check=False)
    if "No matching distribution found for hatchling" in done.stderr:
        pytest.skip("no package index can be reached, from which what builds the toolkit is installed")
    assert done.returncode == 0, done.stderr
    assert Path(done.stdout.splitlines()[-1]).is_relative_to(site_packages)
