"""Every setting as documentation and ``vislam list`` show it, read from the records themselves."""

from collections.abc import Iterator
from typing import Any, Literal, NamedTuple, get_args, get_origin, get_type_hints

import msgspec
from msgspec import Meta, Struct

from toolkit.settings.records import Settings

_BOUNDS = {"gt": ">", "ge": ">=", "lt": "<", "le": "<="}


class Described(NamedTuple):
    """One setting as documentation shows it: key, unit, default, range in words, what it is."""

    key: str
    unit: str
    default: str
    range: str
    meaning: str


def describe() -> tuple[Described, ...]:
    """Return every setting, in the order of the record."""
    return tuple(_described(Settings, ""))


def _described(record: type[Struct], prefix: str) -> Iterator[Described]:
    hints = get_type_hints(record, include_extras=True)
    for field in msgspec.structs.fields(record):
        hint = hints[field.name]
        if isinstance(hint, type) and issubclass(hint, Struct):
            yield from _described(hint, f"{field.name}.")
        elif field.name != "estimators":
            yield _one(f"{prefix}{field.name}", hint, field.default)


def _one(key: str, hint: Any, default: Any) -> Described:
    metas = list(_metas(hint))
    extra = {name: text for meta in metas for name, text in (meta.extra or {}).items()}
    bounds = {name: getattr(meta, name) for meta in metas for name in _BOUNDS if getattr(meta, name) is not None}
    words = [f"{_BOUNDS[name]} {bound:g}" for name, bound in bounds.items()]
    words += [" or ".join(map(str, get_args(part))) for part in _parts(hint) if get_origin(part) is Literal]
    meaning = next(meta.description for meta in metas if meta.description)
    shown = extra.get("none", "none") if default is None else _shown(default)
    return Described(key, extra.get("unit", ""), shown, ", ".join(words), meaning)


def _shown(default: Any) -> str:
    return f"{default:.4g}" if isinstance(default, float) else str(default)


def _parts(hint: Any) -> Iterator[Any]:
    """Yield a type annotation and all it is made of."""
    yield hint
    for part in get_args(hint):
        if not isinstance(part, Meta):
            yield from _parts(part)


def _metas(hint: Any) -> Iterator[Meta]:
    for part in _parts(hint):
        yield from (meta for meta in getattr(part, "__metadata__", ()) if isinstance(meta, Meta))
