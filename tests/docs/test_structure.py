"""The tree can be read: short files, short functions, and a folder's __init__ that names what lives there."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

PROJECT = Path(__file__).parents[2]
FILES = sorted(path for package in ("toolkit", "filters") for path in (PROJECT / package).rglob("*.py"))
MOST_LINES, MOST_LINES_OF_A_FUNCTION = 400, 50
# Their modules are found by being there, and any may be taken away: the docstring says where to begin.
FOUND_BY_BEING_THERE = ("filters", "toolkit/audit", "toolkit/datasets", "toolkit/metrics")


def functions(path: Path) -> Iterator[ast.FunctionDef]:
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.FunctionDef):
            yield node


def test_no_file_has_more_than_400_lines() -> None:
    lines = {path.relative_to(PROJECT).as_posix(): len(path.read_text().splitlines()) for path in FILES}
    assert {name: count for name, count in lines.items() if count > MOST_LINES} == {}


def test_no_function_has_more_than_fifty_lines() -> None:
    lines = {
        f"{path.relative_to(PROJECT)}: {function.name}": (function.end_lineno or 0) - function.lineno + 1
        for path in FILES
        for function in functions(path)
    }
    assert {name: count for name, count in lines.items() if count > MOST_LINES_OF_A_FUNCTION} == {}


@pytest.mark.parametrize("init", [path for path in FILES if path.name == "__init__.py"], ids=lambda p: p.parent.name)
def test_a_folder_names_every_module_in_it(init: Path) -> None:
    text = init.read_text(encoding="utf-8")
    assert ast.get_docstring(ast.parse(text))
    if init.parent.relative_to(PROJECT).as_posix() not in FOUND_BY_BEING_THERE:
        inside = {path.stem for path in init.parent.glob("*.py")} - {"__init__", "__main__"}
        inside |= {path.parent.name for path in init.parent.glob("*/__init__.py")}
        assert {name for name in inside if not re.search(rf"\b{name}\b", text)} == set()
