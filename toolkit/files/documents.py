"""The toolkit's JSON documents: typed records of msgspec, written, read back and described by a JSON schema.

A record is a frozen ``msgspec.Struct`` whose first field, ``schema``, is the document's name and version. Its types,
their bounds and its ``__post_init__`` are the contract: what breaks one of them is refused on reading, with the file
and the place in it. Unknown fields are ignored, because a later version may add some.
"""

import json
import math
import re
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Annotated, Any, TypeVar, get_args, get_type_hints

import msgspec
from msgspec import Meta, inspect

from toolkit.errors import DataError, VislamError
from toolkit.files.reading import read_input
from toolkit.geometry import Array

Record = TypeVar("Record", bound=msgspec.Struct)
Json = dict[str, Any]
Older = Mapping[str, Callable[[Json], Json]]
Count = Annotated[int, Meta(ge=0)]
# A value of a metric; a count stays an integer when it is read and written again.
Value = int | float | None

_DIGITS = 6
# JSON's names of the types in msgspec's messages.
_KINDS = {
    "int": "integer",
    "float": "number",
    "str": "string",
    "bool": "true or false",
    "array": "list",
    "_NotFinite": "NaN or infinity",
}
# One step of msgspec's path to a value, such as $.runs[0].metrics[...]: a field, an entry of a list, or one of an
# object whose keys are data, which it does not name.
_STEP = re.compile(r"\.(?P<field>\w+)|\[(?P<index>\d+)\]|\[(?P<entry>\.\.\.)\]")
_NOT_JSON = (ValueError, RecursionError)
_NO_CHOICE = "Invalid enum value"
_PLACED = re.compile(r"(?P<what>.*) - at (`key` in )?`\$(?P<path>[^`]*)`", re.DOTALL)


def of_attributes(
    record: type[Record], value: object, made: Callable[[Any], Any] = lambda value: value, **given: Any
) -> Record:
    """Return the record with the given fields and, for the others, the value's attributes of the same names."""
    rest = [name for name in record.__struct_fields__ if name not in given]
    return record(**given, **{name: made(getattr(value, name)) for name in rest})


def rounded(value: float) -> float:
    """Return a value with the six digits that documents of long series have."""
    return float(f"{value:.{_DIGITS}g}")


def number(value: float) -> float | None:
    """Return a value with six digits, or None where it is not finite, which JSON cannot express."""
    return rounded(value) if math.isfinite(value) else None


def numbers(values: Array) -> tuple[float | None, ...]:
    """Return values (N,) with six digits, None for what is not finite."""
    return tuple(map(number, values.tolist()))


def to_text(record: msgspec.Struct) -> str:
    """Return a record as indented JSON; raises ValueError for NaN and infinity, which are not JSON."""
    return json.dumps(msgspec.to_builtins(record), indent=2, allow_nan=False) + "\n"


def to_line(record: msgspec.Struct) -> str:
    """Return a record as JSON on a single line, for long series; raises ValueError for NaN and infinity."""
    return json.dumps(msgspec.to_builtins(record), allow_nan=False) + "\n"


def reader(record: type[Record], remedy: str, older: Older | None = None) -> Callable[[Path], Record]:
    return partial(read, record=record, remedy=remedy, older=older)


def read(
    path: Path,
    record: type[Record],
    *,
    remedy: str = "make it again",
    error: type[VislamError] = DataError,
    older: Older | None = None,
) -> Record:
    """Read the record in a file; ``older`` has what brings documents of earlier versions up to the present one.

    Raises ``error`` where the file cannot be read or breaks the contract: one line with the file, the place in the
    document, what is wrong there, and ``remedy``.
    """
    try:
        content = read_input(path)
    except DataError as why:
        if isinstance(why.__cause__, FileNotFoundError):
            raise error(f"{path} is missing; {remedy}") from None
        raise error(str(why)) from why
    try:
        return parse(content, record, older)
    except DataError as why:
        raise error(f"{path} {why}; {remedy}") from why


def parse(content: bytes | str, record: type[Record], older: Older | None = None) -> Record:
    """Return the record in the text of a document; raises DataError, which names the place of what is wrong."""
    try:
        # A place with NaN or infinity is left for the record to refuse and name.
        document = json.loads(content, parse_constant=_NotFinite, parse_float=_finite_or_not)
    except _NOT_JSON as why:
        raise DataError(f"cannot be read as JSON ({why})") from why
    known = get_args(get_type_hints(record)["schema"])  # names and versions, the present one last
    given = document.get("schema") if isinstance(document, dict) else None
    wanted = known[-1]
    if older and isinstance(document, dict) and isinstance(given, str) and given in older:
        document, given = {**older[given](document), "schema": wanted}, wanted
    if given not in known:
        what = "it has none" if given is None else f"its schema is {given!r}"
        raise DataError(f"has not the schema {wanted}, which this version reads: {what}")
    try:
        return msgspec.convert(document, record)
    except msgspec.ValidationError as why:
        raise DataError(f"breaks the contract {wanted}: {readable(why, document, record)}") from why


def schema(record: type[msgspec.Struct]) -> Json:
    # Descriptions are docstrings, which Python indents as their source is, up to 3.12.
    told = re.sub(r"\\n {4,}", r"\\n", json.dumps(msgspec.json.schema(record)))
    # Names of keys are told from msgspec 0.23 on; the schema is the same under all.
    known = json.loads(told, object_hook=lambda part: {key: part[key] for key in part if key != "propertyNames"})
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **known}


class _NotFinite:
    """Placeholder for NaN or infinity in a document, which JSON does not allow: no record accepts its type."""

    def __init__(self, written: str) -> None:
        self._written = written

    def __repr__(self) -> str:
        return self._written


def _finite_or_not(written: str) -> float | _NotFinite:
    value = float(written)
    return value if math.isfinite(value) else _NotFinite(written)


def readable(why: msgspec.ValidationError, document: object, record: type[msgspec.Struct]) -> str:
    """Return a message that says what is wrong and where, with the keys that msgspec leaves out of its paths."""
    what, path = _parts(why)
    steps = _place(path, document, record)
    place = "".join(f"[{step}]" if isinstance(step, int) else f".{step}" for step in steps).removeprefix(".")
    only = f", only {', '.join(_choices(record, steps))}" if what.startswith(_NO_CHOICE) else ""
    return f"{place or 'the document'}: {_plain(what)}{only}"


def _parts(why: msgspec.ValidationError) -> tuple[str, str]:
    placed = _PLACED.fullmatch(str(why))
    return (placed["what"], placed["path"]) if placed else (str(why), "")


def _plain(what: str) -> str:
    named = re.sub(r"`([\w| ]+)`", lambda kinds: _kinds(kinds[1].split(" | ")), what)
    for theirs, ours in (("Object missing required field", "lacks"), (_NO_CHOICE, "cannot be")):
        named = named.replace(theirs, ours)
    return " ".join((named[:1].lower() + named[1:]).split())


def _kinds(kinds: list[str]) -> str:
    return " or ".join(dict.fromkeys(_KINDS.get(kind, kind) for kind in kinds if kind != "int" or "float" not in kinds))


def _choices(record: type[msgspec.Struct], steps: tuple[str | int, ...]) -> Iterator[str]:
    """Yield what the value at a place of a record, or the keys of the object there, may be."""
    kinds: list[inspect.Type] = [inspect.type_info(record)]
    for step in steps:
        kinds = [inner for kind in kinds for inner in _inside(kind, step)]
    for kind in kinds:
        literal = kind.key_type if isinstance(kind, inspect.DictType) else kind
        if isinstance(literal, inspect.LiteralType):
            yield from map(str, literal.values)


def _inside(kind: inspect.Type, step: str | int) -> Iterator[inspect.Type]:
    if isinstance(kind, inspect.StructType):
        yield from (one for field in kind.fields if field.encode_name == step for one in _each(field.type))
    elif isinstance(kind, inspect.DictType):
        yield from _each(kind.value_type)
    elif isinstance(kind, inspect.VarTupleType):
        yield from _each(kind.item_type)


def _each(kind: inspect.Type) -> Iterator[inspect.Type]:
    """Yield a type without its description, and of several each."""
    if isinstance(kind, inspect.Metadata):
        yield from _each(kind.type)
    elif isinstance(kind, inspect.UnionType):
        yield from (one for part in kind.types for one in _each(part))
    else:
        yield kind


def _place(path: str, document: object, record: type[msgspec.Struct]) -> tuple[str | int, ...]:
    """Return the steps to the wrong value, with the key of every entry of an object where it can be found.

    The wrong entry of an object is the one that, alone in the object, is refused at the same path.
    """
    steps: list[str | int] = []
    value: Any = document
    for step in _STEP.finditer(path):
        if step["entry"]:
            key = next((key for key in value if _refused_at(path, value, key, document, record)), None)
        else:
            key = step["field"] or int(step["index"])
        if key is None:
            break
        steps.append(key)
        value = value[key]
    return tuple(steps)


def _refused_at(path: str, entries: Json, key: str, document: object, record: type[msgspec.Struct]) -> bool:
    """Say whether the document is refused at a path with only one of some entries of it."""
    every = dict(entries)
    try:
        entries.clear()
        entries[key] = every[key]
        msgspec.convert(document, record)
    except msgspec.ValidationError as why:
        return _parts(why)[1] == path
    finally:
        entries.clear()
        entries.update(every)
    return False
