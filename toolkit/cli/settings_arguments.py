"""The options that change settings, and the settings they give together."""

import argparse
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from toolkit.cli.arguments import UsageError, positive_seconds

if TYPE_CHECKING:
    from toolkit.settings import Settings

# Options that are short for a setting, by their names in a parsed command line; messages name them in this order.
_SHORT_FOR = {
    "outliers": "outliers.policy",
    "window": "window.lag_s",
    "start": "start",
    "seed": "first_seed",
    "seeds": "seeds",
    "vary": "vary",
    "tracks": "frontend.tracks",
    "topics": "frontend.topics",
}


class _Once(argparse.Action):
    """Stores the value of an option that is given once: a second one would pass over the first."""

    def __call__(
        self,
        parser: argparse.ArgumentParser,
        namespace: argparse.Namespace,
        values: Any,
        option_string: str | None = None,
    ) -> None:
        if getattr(namespace, self.dest) is not None:
            parser.error(f"{option_string} is given twice; it takes one file, and --set changes single settings")
        setattr(namespace, self.dest, values)


def add_settings_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the file and the single assignments that change settings."""
    parser.add_argument(
        "--config",
        metavar="FILE",
        type=Path,
        action=_Once,
        help="settings in TOML, or the manifest.json of a run to repeat",
    )
    parser.add_argument(
        "--outliers",
        metavar="POLICY",
        help="how every estimator treats inconsistent measurements (see docs/settings.md)",
    )
    parser.add_argument(
        "--window",
        metavar="SECONDS",
        type=positive_seconds,
        help="length of the window of windowed filters and smoothers",
    )
    parser.add_argument(
        "--no-fast",
        action="store_true",
        help="use NumPy only, even where the extra 'fast' provides compiled code for filters",
    )
    parser.add_argument(
        "--set",
        metavar="KEY=VALUE",
        action="append",
        default=[],
        help="one setting, as in window.lag_s=3 (see 'vislam list settings'); may be repeated",
    )


def requested_assignments(options: argparse.Namespace) -> list[str]:
    """Return --outliers, --window, --no-fast and --set, in that order, as assignments.

    Raises UsageError where a setting is given two values.
    """
    check_given_once(_given_by_options(options), options.set)
    arithmetic = "numpy" if options.no_fast else None
    named = {"outliers.policy": options.outliers, "window.lag_s": options.window, "arithmetic": arithmetic}
    return [*(f"{key}={value}" for key, value in named.items() if value is not None), *options.set]


def _given_by_options(options: argparse.Namespace) -> dict[str, tuple[str, Any]]:
    """Return for each setting the option that is short for it, as it was given, and its value."""
    given = {key: (name, getattr(options, name, None)) for name, key in _SHORT_FOR.items()}
    values = {
        key: (f"--{name} {value:g}" if isinstance(value, float) else f"--{name} {value}", value)
        for key, (name, value) in given.items()
        if value is not None
    }
    return values | ({"arithmetic": ("--no-fast", "numpy")} if options.no_fast else {})


def check_given_once(given: Mapping[str, tuple[str, Any]], assignments: Iterable[str]) -> None:
    """Raise UsageError where assignments of --set give a setting another value than an option, or another of them.

    ``given`` has by setting the option that is short for it, as it was given, and its value.
    """
    from toolkit.settings import assigned

    known = dict(given)
    for text in assignments:
        key, value = assigned(text)
        option, before = known.setdefault(key, (f"--set {text}", value))
        if before != value:
            raise UsageError(f"{option} and --set {text} give {key} two values; leave one out")


def requested_settings(options: argparse.Namespace) -> "Settings":
    """Return the settings of --config and --set; raises SettingsError for one that does not exist."""
    from toolkit.experiment.configuration import read_configuration
    from toolkit.settings import settings_of, with_assignments

    values = {} if options.config is None else read_configuration(options.config)[1]
    place = "the command line" if options.config is None else str(options.config)
    return settings_of(with_assignments(values, requested_assignments(options)), place)
