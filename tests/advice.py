"""What the messages of modules tell somebody to do, collected from their sources."""

import ast
import re
from collections.abc import Iterable, Iterator
from pathlib import Path

import toolkit

TOOLKIT = Path(toolkit.__file__).parent
# An advice begins with one of these, behind a semicolon, a colon or a comma, or is a text by itself.
_VERBS = (
    "add allow build calibrate change check choose compare conjugate convert copy correct cross cut delete divide "
    "do download drop evaluate exchange export film give install invert keep leave look make move multiply name "
    "pair pip put record rectify remove rename repeat republish run save separate set shift shorten simulate sort "
    "spell stamp start state synchronise take transpose unpack use vary wait write"
).replace(" ", "|")
# What stands behind a semicolon instead: why, or what there is.
_REASONS = (
    "a an at estimators expected flight functions images is it its KITTI nothing one only or please simulated step "
    "stereo the there they this vislam where with without"
).replace(" ", "|")
_ADVICE = re.compile(rf"(?:(?:^|[;:,] )(?:{_VERBS})) (?!of\b)\S[^;]*")


def advice_in(modules: Iterable[Path], *, raised: bool = False) -> set[str]:
    """Return each advice of some modules, {} for what is put in; of texts in raise statements alone, or of all."""
    found = {_ADVICE.search(text) for module in modules for text in _texts(module, raised)}
    return {advice[0].lstrip(";:, ") for advice in found if advice}


def unknown_beginnings(modules: Iterable[Path]) -> set[str]:
    """Return what follows a semicolon in errors and begins neither as an advice nor as a reason."""
    texts = (text for module in modules for text in _texts(module, raised=True))
    ends = {end for text in texts for end in text.split("; ")[1:]}
    return {end for end in ends if not re.match(rf"({_VERBS}|{_REASONS})\b|\W*$|{{|'", end)}


def _texts(module: Path, raised: bool) -> Iterator[str]:
    tree = ast.parse(module.read_text(encoding="utf-8"))
    roots = [node for node in ast.walk(tree) if isinstance(node, ast.Raise)] if raised else [tree]
    nodes = [node for root in roots for node in ast.walk(root)]
    left_out = {id(node.value) for node in nodes if isinstance(node, ast.Expr)}  # docstrings
    left_out |= {id(part) for node in nodes if isinstance(node, ast.JoinedStr) for part in node.values}
    for node in nodes:
        if id(node) not in left_out and isinstance(node, ast.JoinedStr | ast.Constant):
            values = node.values if isinstance(node, ast.JoinedStr) else [node]
            yield "".join(str(value.value) if isinstance(value, ast.Constant) else "{}" for value in values)


def is_followed(advice: str, followed: Iterable[str]) -> bool:
    """Say whether one of the texts that tests follow is of an advice, whatever is put in."""
    longest = max(re.split(r"[{}]+", advice), key=len).strip(" :;,(")
    return any(longest in text or (len(text) > 9 and text in longest) for text in followed)
