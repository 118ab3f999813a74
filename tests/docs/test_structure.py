"""What estimators import is what the page on extending names.

What import-linter proves, it proves of the modules that its contracts name: these are all there are.
"""

import ast
import re
import tomllib
from pathlib import Path

PROJECT = Path(__file__).parents[2]


def imports(path: Path) -> set[str]:
    """Return the modules that a file imports, as ``toolkit.models.stereo``."""
    tree = ast.walk(ast.parse(path.read_text(encoding="utf-8")))
    found = [
        [alias.name for alias in node.names] if isinstance(node, ast.Import) else [node.module or ""]
        for node in tree
        if isinstance(node, ast.Import | ast.ImportFrom)
    ]
    return {name for names in found for name in names}


def contract(name: str) -> dict[str, list[str]]:
    """Return the contract of import-linter of that name."""
    contracts = tomllib.loads((PROJECT / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"]
    return next(one for one in contracts if one["name"] == name)


def test_estimators_import_of_the_toolkit_what_the_page_on_extending_names_and_nothing_forbidden() -> None:
    page = (PROJECT / "docs" / "extending.md").read_text(encoding="utf-8")
    named = re.search(r"may import from `toolkit` only what measures and models \(([^)]+)\)", page)
    assert named
    allowed = set(re.findall(r"`(\w+)`", named[1]))
    files = (PROJECT / "filters").rglob("*.py")
    used = {name.split(".")[1] for path in files for name in imports(path) if name.startswith("toolkit.")}
    assert used <= allowed
    forbidden = contract("Estimators see the measurements and the models, not the metrics")["forbidden_modules"]
    # What is left is below the modules that estimators may import, and reached through them alone.
    below = {"discovery", "files", "threads", "track_budget"}
    there = {path.stem for path in (PROJECT / "toolkit").glob("[!_]*.py")}
    there |= {path.parent.name for path in (PROJECT / "toolkit").glob("*/__init__.py")}
    assert there == allowed | below | {name.removeprefix("toolkit.") for name in forbidden}


def test_every_estimator_without_gtsam_is_held_to_infer_nothing_with_it() -> None:
    handwritten = {
        f"filters.{path.stem}"
        for path in (PROJECT / "filters").glob("[!_]*.py")
        if not any(name.startswith(("gtsam", "filters.smoothing")) for name in imports(path))
    }
    held = contract("The handwritten filters infer nothing with GTSAM")["source_modules"]
    assert handwritten | {"filters.kalman"} == set(held)
