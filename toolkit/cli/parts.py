"""``vislam list``, ``cite``, ``verify`` and ``completion``: what there is, and an estimator of your own."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from functools import partial
from typing import TYPE_CHECKING

from toolkit.cli.arguments import arg, choice, command, output

if TYPE_CHECKING:
    from toolkit.registry import EstimatorEntry

KINDS = ("estimators", "metrics", "faults", "injectors", "settings", "formats", "sequences")
# How many names of each kind stand for all of it.
_EXAMPLES = 4
# Which of these names an argument takes, by its destination.
_KINDS_OF = {
    "estimators": "estimators",
    "start_at": "estimators",
    "goal": "estimators",
    "sequence": "sequences",
    "sequences": "sequences",
    "columns": "metrics",
    "metric": "metrics",
    "keep": "faults",
    "set": "settings",
}


@command(
    "list",
    "list estimators, metrics, faults, injectors of faults, settings, formats and built-in sequences",
    choice("kind KIND", KINDS, f"one of {', '.join(KINDS)}", nargs="?"),
    examples=("vislam list", "vislam list estimators"),
)
def list_parts(options: argparse.Namespace) -> int:
    """Print one kind of what can be named on the command line, a name a line: estimators, metrics, faults the audit
    knows, injectors of faults for vislam sweep, settings, formats that are recognised, built-in sequences. Without a
    kind, how many there are of each.
    """
    if options.kind is None:
        print("\n".join(_summary(kind, list(entries(kind))) for kind in KINDS))
        print(f"\nvislam list KIND prints one of them: {', '.join(KINDS)}")
    else:
        from toolkit.report.text import filled, width_of_output

        of_kind, width = entries(options.kind), width_of_output()
        longest = max(map(len, of_kind), default=0)
        for name, text in of_kind.items():
            print(filled(text, width, f"{name:<{longest}}  ", " " * (longest + 2)).rstrip())
    return 0


def entries(kind: str) -> Mapping[str, str]:
    """Return the names of a kind with their one-line summaries."""
    from toolkit import datasets, metrics
    from toolkit.audit import faults
    from toolkit.registry import discover
    from toolkit.settings.reading import describe
    from toolkit.simulation.faults import INJECTORS

    match kind:
        case "estimators":
            entries: Mapping[str, str] = {name: _estimator(entry) for name, entry in discover().items()}
        case "metrics":
            entries = metrics.describe() | _marked(metrics.unavailable())
        case "faults":
            entries = faults()
        case "injectors":
            entries = {name: f"{one.meaning} [{one.unit}, none at {one.clean:g}]" for name, one in INJECTORS.items()}
        case "settings":
            entries = {
                one.key: f"{one.meaning} [{', '.join(filter(None, (one.unit, f'default {one.default}', one.range)))}]"
                for one in describe()
            }
        case "formats":
            entries = datasets.formats() | _marked(datasets.unavailable())
        case _:
            entries = dict.fromkeys(datasets.built_in_names(), "")
    return entries


def _summary(kind: str, names: list[str]) -> str:
    more = ", ..." if len(names) > _EXAMPLES else ""
    return f"{len(names):>3} {kind:<{max(map(len, KINDS))}}  {', '.join(names[:_EXAMPLES])}{more}"


def _estimator(entry: EstimatorEntry) -> str:
    ignored = "".join(f" (not {rule}: {why})" for rule, why in entry.ignores().items())
    return f"{entry.summary()}{' (default)' if entry.is_default() else ''}{ignored}"


def _marked(unavailable: Mapping[str, str]) -> dict[str, str]:
    return {name: f"unavailable: {why}" for name, why in unavailable.items()}


@command(
    "cite",
    "print BibTeX for estimators and data sets",
    arg("names NAME|RUN_DIR", "an estimator, a format, an estimator's file, a run directory", nargs="*"),
    examples=("vislam cite msckf-fej euroc",),
)
def cite(options: argparse.Namespace) -> int:
    """Print BibTeX for estimators, data sets or whatever a run directory compared; for all of them without a name."""
    from toolkit.report.citations import bibtex, citations

    print(bibtex(citations(options.names)), end="")
    return 0


@command(
    "verify",
    "check that an estimator of your own keeps what every estimator promises",
    arg("estimator FILE.py|NAME", "a file or a module with build(setup), or an installed estimator"),
    output("the result as JSON"),
    examples=("vislam verify dead-reckoning",),
)
def verify(options: argparse.Namespace) -> int:
    """Run an estimator on simulated recordings and check what every estimator promises: it is causal and
    deterministic, on any number of threads; it changes nothing it was given; its numbers are finite, its
    covariances sound and honest; it survives every planted fault. What failed is named, with what to do.
    """
    from toolkit.cli.progress_display import of_this_process
    from toolkit.files.documents import to_text
    from toolkit.report.gate import verification_text
    from toolkit.report.text import width_of_output
    from toolkit.verify import subject_of, verify

    subject = subject_of(options.estimator)
    with of_this_process()(f"{subject.name}: promises") as progress:
        found = verify(subject, options.estimator, progress)
    if options.json:
        print(to_text(found), end="")
    elif not options.quiet:
        print(verification_text(found, width_of_output()))
    return 0 if found.passed else 1


@command(
    "completion",
    "print the script with which a shell completes vislam's commands and options",
    choice("shell", ("bash", "zsh", "fish"), "which shell"),
    examples=("vislam completion bash",),
)
def completion(options: argparse.Namespace) -> int:
    """Print a script that completes commands, options, their choices, and the names of estimators, built-in
    sequences, metrics, faults and settings that are installed. bash and zsh: put eval "$(vislam completion
    bash)" into ~/.bashrc, or zsh into ~/.zshrc. fish: save the output as ~/.config/fish/completions/vislam.fish.
    """
    from argcomplete.shell_integration import shellcode

    print(shellcode(["vislam"], shell=options.shell))
    return 0


def complete(root: argparse.ArgumentParser) -> None:
    """Answer a shell that asks for completions, and leave; return where none does."""
    import argcomplete

    (commands,) = (one for one in root._actions if isinstance(one, argparse._SubParsersAction))
    for parser in commands.choices.values():
        for action in parser._actions:
            if action.dest in _KINDS_OF:
                action.completer = partial(_known_names, _KINDS_OF[action.dest])
    argcomplete.autocomplete(root)


def _known_names(kind: str, prefix: str, **_: object) -> list[str]:
    """Return the names of a kind behind what stands of a list already."""
    before, comma, _last = prefix.rpartition(",")
    return [f"{before}{comma}{name}{'=' if kind == 'settings' else ''}" for name in entries(kind)]
