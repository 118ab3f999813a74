"""The site's pages are the repository's files in their places, so that a link that works there works here.

A hook of MkDocs. Beside the pages there are the executed notebooks, and every other file or folder that a page links:
source code, workflows, the licence. Formulas become MathML, which browsers draw by themselves.
"""

import ast
import base64
import json
import os
import posixpath
import re
from collections.abc import Iterator
from html import unescape
from pathlib import Path
from typing import Any

from latex2mathml.converter import convert
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File, Files, InclusionLevel
from mkdocs.structure.pages import Page

ROOT = Path(__file__).resolve().parents[2]
_PAGES = ("README.md", "docs/*.md", "notebooks/README.md", "data/README.md", ".github/CONTRIBUTING.md")
_ASSETS = ("docs/images/*", "docs/schemas/*.json", "docs/site/site.css")
_LINK = re.compile(r"\]\(([^)#\s:]+)(?:#[^)\s]*)?\)")
_FORMULA = re.compile(r"\\\((?P<inline>.*?)\\\)|\\\[(?P<block>.*?)\\\]", re.DOTALL)
# Colab opens what is in a branch of a repository: there the workflow puts these, with a first cell that installs it.
_IN_COLAB = ("01_quickstart", "03_why_the_smoother_wins", "05_the_course_exercises")
_COLAB = "https://colab.research.google.com/github"
_FIRST_CELL = """\
# Where the toolkit is not installed, as in Colab, fetch and install it, and go where the notebooks are.
import importlib.util
import os
import subprocess
import sys

if importlib.util.find_spec("toolkit") is None:
    subprocess.run(["git", "clone", "-q", "--depth", "1", "{address}", "vislam-toolkit"], check=True)
    subprocess.run([sys.executable, "-m", "pip", "install", "-q", "./vislam-toolkit"], check=True)
    os.chdir("vislam-toolkit/notebooks")
    sys.path.insert(0, os.getcwd())
    importlib.invalidate_caches()
"""
_LANGUAGES = {".py": "python", ".yml": "yaml", ".toml": "toml"}


class ShownFile(File):
    """A page whose Markdown is made here, of a file that is none."""

    def is_documentation_page(self) -> bool:
        """Return True: MkDocs would only copy the file."""
        return True


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Return the repository's pages, what they show, and whatever else they link, beside the theme's files."""
    found = [_file(path, config) for pattern in (*_PAGES, *_ASSETS) for path in sorted(ROOT.glob(pattern))]
    for notebook in sorted(ROOT.glob("notebooks/*.ipynb")):
        found += _notebook(notebook, config)
    known = {file.src_uri for file in found}
    found += [_source(ROOT / name, config) for name in sorted(_linked(found) - known)]
    if absent := {str(name) for name in config.extra_css} - {file.dest_uri for file in found}:
        raise PluginError(f"mkdocs.yml, extra_css: there is no {', '.join(sorted(absent))}")
    return Files([*(file for file in files if file.src_dir != config.docs_dir), *found])


def on_page_content(html: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    r"""Return a page with its formulas, which arithmatex has left between \( \) or \[ \], as MathML."""
    return _FORMULA.sub(_mathml, html) if "arithmatex" in html else html


def _mathml(found: re.Match[str]) -> str:
    display = "block" if found["inline"] is None else "inline"
    return convert(unescape(found[display]), display=display)


def _file(path: Path, config: MkDocsConfig) -> File:
    file = File(path.relative_to(ROOT).as_posix(), str(ROOT), config.site_dir, config.use_directory_urls)
    return _placed(file, InclusionLevel.INCLUDED)


def _placed(file: File, inclusion: InclusionLevel) -> File:
    """Return a file with its address on the site: pages of docs/ are at the top, and no folder is hidden."""
    file.dest_uri = file.dest_uri.removeprefix("docs/").removeprefix(".")
    file.inclusion = inclusion
    return file


def _shown(name: str, text: str, config: MkDocsConfig, inclusion: InclusionLevel) -> File:
    file = ShownFile(name, None, config.site_dir, config.use_directory_urls)
    file.content_string = text
    file.edit_uri = None
    return _placed(file, inclusion)


def _linked(pages: list[File]) -> set[str]:
    """Return the files and folders of the repository that pages link, by their place in it."""
    names = set()
    for page in pages:
        if page.is_documentation_page():
            here = posixpath.dirname(page.src_uri)
            names |= {posixpath.normpath(posixpath.join(here, link)) for link in _LINK.findall(page.content_string)}
    return {name for name in names if not name.startswith("..") and (ROOT / name).exists()}


def _source(path: Path, config: MkDocsConfig) -> File:
    """Return a page that shows a file, or what the modules of a folder are for."""
    name = path.relative_to(ROOT).as_posix()
    if path.is_dir():
        text = "\n".join(f"- `{module}`: {purpose}" for module, purpose in _modules(path))
    else:
        text = f"````{_LANGUAGES.get(path.suffix, 'text')}\n{path.read_text(encoding='utf-8')}\n````"
    front = f"---\ntitle: {name}\nsearch: {{ exclude: true }}\nhide: [navigation]\n---\n"
    return _shown(name, f"{front}# {name}\n\n{text}\n", config, InclusionLevel.NOT_IN_NAV)


def _modules(folder: Path) -> Iterator[tuple[str, str]]:
    for module in sorted(folder.rglob("*.py")):
        purpose = ast.get_docstring(ast.parse(module.read_text(encoding="utf-8")))
        if purpose:
            yield module.relative_to(folder).as_posix(), purpose.partition("\n")[0]


def _notebook(path: Path, config: MkDocsConfig) -> Iterator[File]:
    """Yield the page of an executed notebook, its pictures, and, where the repository is known, one for Colab."""
    name = path.relative_to(ROOT)
    parts: list[str] = []
    notebook = json.loads(path.read_text(encoding="utf-8"))
    for place, cell in enumerate(notebook["cells"]):
        source = "".join(cell["source"])
        if cell["cell_type"] == "markdown":
            parts.append(source)
            continue
        parts.append(f"```python\n{source}\n```")
        for output in cell["outputs"]:
            picture = f"{name.stem}-{place}.png"
            parts.append(_output(output, picture))
            if "image/png" in output.get("data", {}):
                data = base64.b64decode(output["data"]["image/png"])
                yield _bytes(name.with_name(picture).as_posix(), data, config)
    if (repository := os.environ.get("GITHUB_REPOSITORY")) and name.stem in _IN_COLAB:
        parts.insert(1, f"[Open in Colab]({_COLAB}/{repository}/blob/colab/{path.name})")
        installing = json.dumps(with_first_cell(notebook, f"https://github.com/{repository}")).encode()
        yield _bytes(f"{name.parent}/colab/{path.name}", installing, config)
    yield _shown(name.as_posix(), "\n\n".join(parts), config, InclusionLevel.INCLUDED)


def _output(output: dict[str, Any], picture: str) -> str:
    """Return what a cell put out as Markdown; raises KeyError for a kind that no notebook here has."""
    if output["output_type"] == "stream":
        return f"```{{ .text .output }}\n{''.join(output['text'])}\n```"
    if "image/png" in output["data"]:
        return f"![]({picture})"
    return "".join(output["data"]["text/markdown"])


def with_first_cell(notebook: dict[str, Any], address: str) -> dict[str, Any]:
    """Return a notebook that installs the toolkit from the address of its repository first, where it is not there."""
    source = _FIRST_CELL.format(address=address)
    code = {"execution_count": None, "id": "install", "metadata": {}, "outputs": [], "source": source}
    return {**notebook, "cells": [{"cell_type": "code", **code}, *notebook["cells"]]}


def _bytes(name: str, data: bytes, config: MkDocsConfig) -> File:
    file = File(name, None, config.site_dir, config.use_directory_urls)
    file.content_bytes = data
    return _placed(file, InclusionLevel.INCLUDED)
