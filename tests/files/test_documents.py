"""A document is what its record says, and what is wrong with a file is told in one line: file, place, what, remedy."""

from pathlib import Path
from typing import Annotated, Literal

import pytest
from msgspec import UNSET, Meta, Struct, UnsetType

from toolkit.errors import DataError, OutputError
from toolkit.files.documents import parse, read, to_line, to_text


class Leaf(Struct, frozen=True, kw_only=True):
    """A part with a rule of its own."""

    count: Annotated[int, Meta(ge=0)]
    values: tuple[float | None, ...] = ()
    side: Annotated[Literal["left", "right"], Meta(description="of the stem")] | None = None

    def __post_init__(self) -> None:
        if len(self.values) > self.count:
            raise ValueError("values has more entries than count says")


class Tree(Struct, frozen=True, kw_only=True):
    """A document."""

    schema: Literal["test.tree/1"]
    leaves: dict[str, Leaf] = {}
    rows: tuple[dict[str, dict[str, float]], ...] = ()
    way: Literal["up", "down"] = "up"
    ends: Annotated[dict[Literal["here", "nowhere"], int], Meta(description="by place")] = {}
    note: str | UnsetType = UNSET


def reported(text: str | bytes) -> str:
    with pytest.raises(DataError) as raised:
        parse(text, Tree)
    assert "\n" not in str(raised.value)
    return str(raised.value)


def of(body: str) -> str:
    return f'{{"schema": "test.tree/1", {body}}}'


def test_a_record_is_read_as_it_was_written() -> None:
    tree = Tree(schema="test.tree/1", leaves={"a": Leaf(count=2, values=(0.1, None))}, rows=({"b": {"c": 1e-300}},))
    assert parse(to_text(tree), Tree) == parse(to_line(tree), Tree) == tree
    assert to_line(tree).count("\n") == 1
    assert "note" not in to_text(tree)


def test_not_a_number_is_never_written() -> None:
    with pytest.raises(ValueError, match="not JSON compliant"):
        to_text(Tree(schema="test.tree/1", rows=({"a": {"b": float("nan")}},)))


@pytest.mark.parametrize(
    ("body", "expected"),
    [
        ('"leaves": {"a": {"count": 1}, "b": {"count": -1}}', "leaves.b.count: expected integer >= 0"),
        ('"leaves": {"a": {"count": 1}, "b": {}}', "leaves.b: lacks count"),
        ('"leaves": {"a": {"count": 1}, "b": {"count": 0, "values": [1]}}', "leaves.b: values has more entries"),
        (
            '"leaves": {"a": {"count": 9, "values": [1, "2"]}}',
            "leaves.a.values[1]: expected number or null, got string",
        ),
        ('"leaves": {"a": {"count": true}}', "leaves.a.count: expected integer, got true or false"),
        ('"rows": [{}, {"x": {"y": 1}, "z": {"u": 1, "v": null}}]', "rows[1].z.v: expected number, got null"),
        ('"rows": [{"x": {"y": NaN}}]', "rows[0].x.y: expected number, got NaN or infinity"),
        ('"rows": [{"x": {"y": 1e999}}]', "rows[0].x.y: expected number, got NaN or infinity"),
        ('"rows": [{"x": {"y": -Infinity}}]', "rows[0].x.y: expected number, got NaN or infinity"),
        ('"rows": {}', "rows: expected list, got object"),
        ('"way": "left\\n - at `$.x`"', "way: cannot be 'left\\n - at `$.x`', only down, up"),
        ('"leaves": {"a": {"count": 1, "side": "top"}}', "leaves.a.side: cannot be 'top', only left, right"),
        ('"ends": {"here": 1, "there": 2}', "ends: cannot be 'there', only here, nowhere"),
    ],
)
def test_the_place_is_named_with_every_key(body: str, expected: str) -> None:
    assert expected in reported(of(body))


def test_the_file_and_the_remedy_are_reported(tmp_path: Path) -> None:
    path = tmp_path / "tree.json"
    with pytest.raises(DataError, match=r"tree\.json is missing; plant one$"):
        read(path, Tree, remedy="plant one")
    path.write_text(of('"way": 3'))
    with pytest.raises(OutputError, match=r"tree\.json breaks the contract test\.tree/1: way: expected .*; plant one$"):
        read(path, Tree, remedy="plant one", error=OutputError)
    with pytest.raises(DataError, match="cannot be read"):
        read(tmp_path, Tree)


@pytest.mark.parametrize(
    ("texts", "expected"),
    [
        (("", "{", "\x00", "[" * 100_000, b"\xff\xfe\x00", '{"schema": "test.tree/1"'), "cannot be read as JSON"),
        (("[]", "3", "{}", '{"schema": null}', '{"schema": NaN}'), "has not the schema test.tree/1"),
    ],
)
def test_what_is_no_document_is_reported(texts: tuple[str | bytes, ...], expected: str) -> None:
    assert not [text for text in texts if expected not in reported(text)]
