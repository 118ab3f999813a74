"""``vislam list``: every estimator, sequence, format, metric, fault and setting there is."""

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
        "are recognised, metrics, the faults the audit knows, and settings.",
        epilog=epilog("vislam list"),
    )
    parser.set_defaults(command=command)


def command(_options: argparse.Namespace) -> int:
    """Print the lists."""
    from toolkit import datasets, metrics
    from toolkit.audit import faults
    from toolkit.estimator import discover
    from toolkit.report.prose import width_of_output
    from toolkit.report.terminal import listing_text
    from toolkit.settings import describe

    sections = {
        "estimators": {name: _estimator(entry) for name, entry in discover().items()},
        "built-in sequences": dict.fromkeys(datasets.built_in_names(), ""),
        "formats": datasets.formats() | _marked(datasets.unavailable()),
        "metrics": metrics.describe() | _marked(metrics.unavailable()),
        "faults": faults(),
        "settings": {one.key: _setting(one) for one in describe()},
    }
    print("\n\n".join(listing_text(title, entries, width_of_output()) for title, entries in sections.items()))
    return 0


def _estimator(entry: EstimatorEntry) -> str:
    ignored = "".join(f" (not {rule}: {why})" for rule, why in entry.ignores().items())
    return f"{entry.summary()}{' (default)' if entry.is_default() else ''}{ignored}"


def _setting(one: Described) -> str:
    facts = (one.unit, f"default {one.default}", one.range)
    return f"{one.meaning} [{', '.join(filter(None, facts))}]"


def _marked(unavailable: Mapping[str, str]) -> dict[str, str]:
    return {name: f"unavailable: {why}" for name, why in unavailable.items()}
