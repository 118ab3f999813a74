"""What the validators of the package's JSON contracts share: the schema's name, and fields with their types."""

from collections.abc import Iterator, Mapping

# The types a field may have, and the values one of a few may take, by the field's name.
Types = Mapping[str, tuple[type, ...]]
Choices = Mapping[str, tuple[str, ...]]


def schema_violations(document: Mapping[str, object], schema: str) -> Iterator[str]:
    """Yield what is wrong with the name of the document's schema."""
    if document.get("schema") != schema:
        yield f"schema is {document.get('schema')!r}, not {schema!r}"


def object_violations(item: object, where: str, expected: Types, choices: Choices | None = None) -> Iterator[str]:
    """Yield what is wrong with an object in a document, each with where it is."""
    if not isinstance(item, dict):
        yield f"{where} is not an object"
        return
    for violation in field_violations(item, expected, choices):
        yield f"{where}.{violation}"


def field_violations(item: Mapping[str, object], expected: Types, choices: Choices | None = None) -> Iterator[str]:
    """Yield the fields that are missing, of another type, or none of their choices; others may follow."""
    for name, types in expected.items():
        # type(), not isinstance(): True must not pass for the number 1.
        if name not in item or type(item[name]) not in types:
            yield f"{name} is missing or not {' or '.join(t.__name__ for t in types)}"
        elif choices and name in choices and item[name] not in choices[name]:
            yield f"{name} is {item[name]!r}, not one of {choices[name]}"
