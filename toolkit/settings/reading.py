"""Settings as somebody wrote them, in TOML, a manifest or as ``KEY=VALUE``: made the record, checked key by key."""

import tomllib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, get_args, get_type_hints

import msgspec
from msgspec import Struct

from toolkit.documents import in_words
from toolkit.errors import DataError, did_you_mean, no_such
from toolkit.inputs import read_text_input
from toolkit.settings.described import describe
from toolkit.settings.records import POLICIES, Settings, SettingsError

_POLICY = "outliers.policy"


def settings_of(given: Mapping[str, Any], place: str) -> Settings:
    """Return the record of nested values, the defaults where nothing is given.

    Raises SettingsError for a key that does not exist, naming the nearest that does, and for a value of another type
    or out of range; ``place`` says where the values come from.
    """
    _check_keys(given, Settings, "", place)
    values = _with_policy(_with_none(given, Settings), place)
    try:
        return msgspec.convert(values, Settings)
    except msgspec.ValidationError as error:
        raise SettingsError(f"{place}: {in_words(error, values, Settings)}") from error


def _with_none(given: Mapping[str, Any], record: type[Struct]) -> dict[str, Any]:
    """Return nested values with None for the word "none" where a setting may be none: TOML has no value for it."""
    hints, values = get_type_hints(record), dict(given)
    for key, value in given.items():
        if isinstance(value, Mapping) and isinstance(hints[key], type) and issubclass(hints[key], Struct):
            values[key] = _with_none(value, hints[key])
        elif value == "none" and type(None) in get_args(hints[key]):
            values[key] = None
    return values


def _with_policy(given: Mapping[str, Any], place: str) -> dict[str, Any]:
    """Return nested values with what a named outlier policy consists of, where they do not say otherwise."""
    values, outliers = dict(given), given.get("outliers")
    if isinstance(outliers, Mapping) and "policy" in outliers:
        policy = outliers["policy"]
        if policy not in POLICIES:
            raise SettingsError(f"{place}: {no_such('outlier policy', str(policy), POLICIES)}")
        values["outliers"] = {**msgspec.to_builtins(POLICIES[policy]), **outliers}
    return values


def read_toml(path: Path) -> dict[str, Any]:
    """Return the nested values of a TOML file; raise SettingsError where it cannot be read."""
    try:
        return tomllib.loads(read_text_input(path, "settings are TOML"))
    except DataError as error:
        raise SettingsError(str(error)) from error
    except (tomllib.TOMLDecodeError, RecursionError) as error:
        raise SettingsError(f"{path}: is not TOML ({error})") from error


def with_assignments(given: Mapping[str, Any], assignments: Iterable[str]) -> dict[str, Any]:
    """Return nested values with ``section.key=value`` put in, the value as TOML writes it or a bare word."""
    result: dict[str, Any] = {key: dict(v) if isinstance(v, Mapping) else v for key, v in given.items()}
    for text in assignments:
        key, equals, value = text.partition("=")
        if not equals or not key.strip():
            raise SettingsError(f"--set takes KEY=VALUE, as in window.lag_s=3, not {text!r}")
        *sections, name = key.strip().split(".")
        at = result
        for section in sections:
            at = at.setdefault(section, {})
            if not isinstance(at, dict):
                raise SettingsError(f"--set {text}: {section} is a value and has no keys of its own")
        at[name] = _value(value.strip())
        if key.strip() == _POLICY:
            # A policy is named whole: what was set of another is no part of it.
            result["outliers"] = {"policy": at[name]}
    return result


def _value(text: str) -> Any:
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        return text


def _check_keys(given: Mapping[str, Any], record: type[Struct], prefix: str, place: str) -> None:
    hints = get_type_hints(record)
    for key, value in given.items():
        if key not in hints:
            keys = [described.key for described in describe()]
            known = [*keys, *{section.partition(".")[0] for section in keys}, "estimators"]
            raise SettingsError(f"{place}: there is no setting {prefix}{key}{did_you_mean(prefix + key, known)}")
        if isinstance(hints[key], type) and issubclass(hints[key], Struct) and isinstance(value, Mapping):
            _check_keys(value, hints[key], f"{key}.", place)
