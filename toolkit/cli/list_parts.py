"""``vislam list``: every estimator, sequence, format, metric and fault there is."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from typing import TYPE_CHECKING

from toolkit.cli.arguments import epilog

if TYPE_CHECKING:
    from toolkit.cli.arguments import Subcommands
    from toolkit.estimator import EstimatorEntry
    from toolkit.settings import Described


def add_to(subcommands: Subcommands) -> None:
    """Add the subcommand."""
    parser = subcommands.add_parser(
        "list",
        help="list estimators, built-in sequences, formats, metrics, faults and settings",
        description="List what can be named on the command line: estimators, built-in sequences, the formats that "
        "are recognised, metrics, the faults the audit knows, and the settings of --set and --config.",
        epilog=epilog("vislam list"),
    )
    parser.set_defaults(command=command)


def command(_options: argparse.Namespace) -> int:
    """Print the lists."""
    from toolkit import datasets, metrics
    from toolkit.audit import faults
    from toolkit.estimator import discover
    from toolkit.report.terminal import listing_text
    from toolkit.settings import describe

    sections = {
        "estimators": {name: _summary(entry) for name, entry in discover().items()},
        "built-in sequences": dict.fromkeys(datasets.built_in_names(), ""),
        "formats": datasets.formats() | _marked(datasets.unavailable()),
        "metrics": metrics.describe() | _marked(metrics.unavailable()),
        "faults": faults(),
        "settings": {one.key: _setting(one) for one in describe()},
    }
    print("\n\n".join(listing_text(title, entries) for title, entries in sections.items()))
    return 0


def _summary(entry: EstimatorEntry) -> str:
    """Return what an estimator is, that it is compared where none is named, and the settings it alone reads."""
    options = ", ".join(f"estimators.{entry.name}.{option}" for option in sorted(entry.options()))
    marks = [text for text in ("default" if entry.is_default() else "", options and f"settings: {options}") if text]
    return f"{entry.summary()} ({'; '.join(marks)})" if marks else entry.summary()


def _setting(one: Described) -> str:
    """Return what a setting is, its default, unit and range."""
    given = " ".join(filter(None, ("default", one.default, one.unit)))
    return f"{one.meaning} ({', '.join(filter(None, (given, one.range)))})"


def _marked(unavailable: Mapping[str, str]) -> dict[str, str]:
    return {name: f"unavailable: {why}" for name, why in unavailable.items()}
