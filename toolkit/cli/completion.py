"""``vislam completion``: the script with which a shell asks this program to complete a command line (argcomplete)."""

import argparse
from functools import partial

from toolkit.cli.arguments import choice, command
from toolkit.cli.parts import entries

# Which names of vislam list an argument takes, by its destination.
_KINDS = {
    "estimators": "estimators",
    "sequence": "sequences",
    "sequences": "sequences",
    "columns": "metrics",
    "metric": "metrics",
    "keep": "faults",
    "set": "settings",
}


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
            if action.dest in _KINDS:
                action.completer = partial(_known_names, _KINDS[action.dest])
    argcomplete.autocomplete(root)


def _known_names(kind: str, prefix: str, **_: object) -> list[str]:
    """Return the names of a kind behind what stands of a list already."""
    before, comma, _last = prefix.rpartition(",")
    return [f"{before}{comma}{name}{'=' if kind == 'settings' else ''}" for name in entries(kind)]
