"""Converts settings in files and on the command line to the record, checked key by key; describes each for the docs.

They are given in TOML, in a manifest or as ``KEY=VALUE``. Descriptions are read from the record itself.
"""

import math
import tomllib
from collections.abc import Iterator, Mapping
from datetime import date, time
from numbers import Number
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_args, get_origin, get_type_hints

import msgspec
from msgspec import Meta, Struct

from toolkit.errors import DataError, did_you_mean, no_such, type_of
from toolkit.files.documents import readable
from toolkit.files.reading import read_text_input
from toolkit.settings import POLICIES, Settings, SettingsError

_POLICY = "outliers.policy"
_MEASURED = "the noise of tracks is measured once for all estimators; noise.track_weight sets it"
# Keys of earlier versions, and what is to be used now.
_GONE = {
    **dict.fromkeys(
        [f"noise.{key}" for key in ("tracks", "track_white_px", "track_walk_px", "track_offset_px", "match_tracks")],
        _MEASURED,
    ),
    "noise.match_imu": "the IMU's noise is measured once for all estimators; noise.motion_scale sets it",
    "noise.track_fit_s": "noise.measured_s is the length of the beginning on which noise is measured",
    "arithmetic": "each part of an estimator exists once, the MSCKFs' tracks compiled and all else in NumPy",
    "tracks.leave_out_moving": "each estimator's gate and loss (outliers.policy) refuse what moves",
    "noise.disparity_scale": "no estimator has such a state any more; the audit's vision-scale reports a scale",
}
# Those of them that changed no answer, some at one value only: a document that a run wrote is read without them.
_CHANGED_NO_ANSWER = ("arithmetic",)
_CHANGED_NO_ANSWER_AS = {"tracks": {"leave_out_moving": False}}
_BOUNDS = {"gt": ">", "ge": ">=", "lt": "<", "le": "<="}


def settings_of(given: Mapping[str, Any], place: str) -> Settings:
    """Return the record of nested values, the defaults where nothing is given.

    Raises SettingsError for a key that does not exist, naming the nearest that does, and for a value of another type
    or out of range; ``place`` says where the values come from.
    """
    _check_keys(given, Settings, "", place)
    _check_values(given, "", place)
    values = _with_policy(_with_none(given, Settings), place)
    try:
        return msgspec.convert(values, Settings)
    except msgspec.ValidationError as error:
        # TOML and the command line have no null: the word "none" is used instead.
        what = readable(error, values, Settings).replace(" or null", " or none").replace("object", "a section of keys")
        what = what.replace("only auto", "give a number or auto")
        given_text = _given(what.partition(":")[0], values) if what.endswith("got string") else ""
        raise SettingsError(f"{place}: {what}{given_text}") from error


def without_removed(written: Mapping[str, Any]) -> dict[str, Any]:
    """Return the nested settings of a document, perhaps of an earlier version, without keys that changed no answer."""
    kept = {key: value for key, value in written.items() if key not in _CHANGED_NO_ANSWER}
    for section, unused in _CHANGED_NO_ANSWER_AS.items():
        if isinstance(kept.get(section), Mapping):
            kept[section] = {key: value for key, value in kept[section].items() if (key, value) not in unused.items()}
    return kept


def _given(key: str, values: Mapping[str, Any]) -> str:
    """Return a text that stands where another type is expected, and the unit in which a number is."""
    section, _, name = key.rpartition(".")
    text = values.get(section, {}).get(name) if section else values.get(name)
    if not isinstance(text, str):
        return ""
    unit = next((described.unit for described in describe() if described.key == key), "")
    return f" {text!r}" + (f"; it is a number, in {unit}" if unit else "")


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
    """Return nested values with the values of a named outlier policy, where they give no others."""
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


def with_changes(given: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """Return nested values with the values of ``section.key`` put in."""
    result: dict[str, Any] = {key: dict(v) if isinstance(v, Mapping) else v for key, v in given.items()}
    # A policy first, which replaces all values of the former one: the single values on top of it hold.
    for key, value in sorted(changes.items(), key=lambda change: change[0] != _POLICY):
        *sections, name = key.split(".")
        at = result
        for section in sections:
            at = at.setdefault(section, {})
            if not isinstance(at, dict):
                raise SettingsError(f"{key} is set, and {section} is a value: it has no keys of its own")
        at[name] = value
        if key == _POLICY:
            result["outliers"] = {"policy": value}
    return result


def value_at(values: Mapping[str, Any], key: str) -> Any:
    """Return the value that nested values have at ``section.key``, None where they have none there."""
    at: Any = values
    for part in key.split("."):
        at = at.get(part) if isinstance(at, Mapping) else None
    return None if isinstance(at, Mapping) else at


def assigned(text: str) -> tuple[str, Any]:
    """Return key and value of ``section.key=value``; raises SettingsError where it is none."""
    key, equals, value = text.partition("=")
    if not equals or not key.strip():
        raise SettingsError(f"--set takes KEY=VALUE, as in window.lag_s=3, not {text!r}")
    try:
        return key.strip(), tomllib.loads(f"value = {value.strip()}")["value"]
    except tomllib.TOMLDecodeError:  # a bare word
        return key.strip(), value.strip()


def _check_keys(given: Mapping[str, Any], record: type[Struct], prefix: str, place: str) -> None:
    hints = get_type_hints(record)
    for key, value in given.items():
        if key not in hints:
            keys = [described.key for described in describe()]
            known = [*keys, *{section.partition(".")[0] for section in keys}, "estimators"]
            section, _, name = key.partition(".")
            if f"{prefix}{key}" in keys and name:
                raise SettingsError(
                    f"{place}: {key!r} is one key here; write {{{section!r}: {{{name!r}: ...}}}}, or in TOML {key} "
                    "without quotes"
                )
            now = _GONE.get(f"{prefix}{key}")
            raise SettingsError(
                f"{place}: there is no setting {prefix}{key}{f': {now}' if now else did_you_mean(prefix + key, known)}"
            )
        if isinstance(hints[key], type) and issubclass(hints[key], Struct) and isinstance(value, Mapping):
            _check_keys(value, hints[key], f"{key}.", place)


def _check_values(given: Mapping[str, Any], prefix: str, place: str) -> None:
    """Raise SettingsError for a value that no TOML file has, as an array, and for a number that no JSON file has."""
    for key, value in given.items():
        if isinstance(value, Mapping):
            _check_values(value, f"{prefix}{key}.", place)
        elif isinstance(value, float) and not math.isfinite(value):
            raise SettingsError(f"{place}: {prefix}{key}: expected a finite number, not {value}")
        elif not isinstance(value, str | Number | list | date | time | None):
            raise SettingsError(f"{place}: {prefix}{key} is {type_of(value)}; give a number, a text, true or false")


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
    metas = [m for part in _parts(hint) for m in getattr(part, "__metadata__", ()) if isinstance(m, Meta)]
    extra = {name: text for meta in metas for name, text in (meta.extra or {}).items()}
    bounds = {name: getattr(meta, name) for meta in metas for name in _BOUNDS if getattr(meta, name) is not None}
    bounds_text = [f"{_BOUNDS[name]} {bound:g}" for name, bound in bounds.items()]
    bounds_text += [" or ".join(map(str, get_args(part))) for part in _parts(hint) if get_origin(part) is Literal]
    meaning = next(meta.description for meta in metas if meta.description)
    shown = extra.get("none", "none") if default is None else _shown(default)
    return Described(key, extra.get("unit", ""), shown, ", ".join(bounds_text), meaning)


def _shown(default: Any) -> str:
    if isinstance(default, bool):  # as TOML writes it
        return str(default).lower()
    return f"{default:.4g}" if isinstance(default, float) else str(default)


def _parts(hint: Any) -> Iterator[Any]:
    """Yield a type annotation and its parts."""
    yield hint
    for part in get_args(hint):
        if not isinstance(part, Meta):
            yield from _parts(part)
