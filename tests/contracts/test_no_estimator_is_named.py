"""The toolkit finds estimators and names none: what holds for one holds for anybody's."""

import ast
from pathlib import Path

import pytest

from toolkit.estimator import discover

TOOLKIT = Path(__file__).parents[2] / "toolkit"


def constants(path: Path) -> set[str]:
    """Return the texts of a module; an example in a help text is a sentence, not a name."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    return {node.value for node in ast.walk(tree) if isinstance(node, ast.Constant) and isinstance(node.value, str)}


@pytest.mark.parametrize("path", sorted(TOOLKIT.rglob("*.py")), ids=lambda path: str(path.relative_to(TOOLKIT)))
def test_no_text_of_the_toolkit_is_an_estimators_name(path: Path) -> None:
    assert not constants(path) & discover().keys()
