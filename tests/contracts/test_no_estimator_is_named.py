"""The toolkit finds estimators and names none: what holds for one holds for anybody's."""

import ast
from pathlib import Path

from toolkit.registry import discover

TOOLKIT = Path(__file__).parents[2] / "toolkit"


def constants(path: Path) -> set[str]:
    """Return the texts of a module; an example in a help text is a sentence, not a name."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    return {node.value for node in ast.walk(tree) if isinstance(node, ast.Constant) and isinstance(node.value, str)}


def test_no_text_of_the_toolkit_is_an_estimators_name() -> None:
    estimators = discover().keys()
    named = {str(path.relative_to(TOOLKIT)): constants(path) & estimators for path in sorted(TOOLKIT.rglob("*.py"))}
    assert {module: names for module, names in named.items() if names} == {}
