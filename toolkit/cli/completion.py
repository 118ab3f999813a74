"""``vislam completion``: what a shell needs to complete commands, options, their choices and the names they take."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING, NamedTuple

from toolkit.cli.arguments import choice, command

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping


class _Option(NamedTuple):
    """The words of an option, what it is for, which words may follow it, and whether a value does."""

    words: tuple[str, ...]
    help: str
    choices: tuple[str, ...]
    takes_value: bool


class _Command(NamedTuple):
    """A subcommand, what it is for, and its options."""

    name: str
    help: str
    options: tuple[_Option, ...]


@command(
    "completion",
    "print the script with which a shell completes vislam's commands and options",
    choice("shell", ("bash", "zsh", "fish"), "which shell"),
    examples=("vislam completion bash",),
)
def completion(options: argparse.Namespace) -> int:
    """Print a script that completes commands, options, their choices, and the names of estimators, built-in
    sequences, metrics, faults and settings that are installed now. bash and zsh: put eval "$(vislam completion
    bash)" into ~/.bashrc, or zsh into ~/.zshrc. fish: save the output as ~/.config/fish/completions/vislam.fish.
    """
    from toolkit.cli import parser

    commands = list(_commands(parser(), _known_names()))
    print({"bash": _bash, "zsh": _zsh, "fish": _fish}[options.shell](commands), end="")
    return 0


def _known_names() -> dict[str, tuple[str, ...]]:
    """Return the names that arguments take without having them as choices, by the argument's destination."""
    from toolkit import datasets, metrics
    from toolkit.audit import faults
    from toolkit.registry import discover
    from toolkit.settings.reading import describe

    return {
        "estimators": tuple(discover()),
        "sequence": datasets.built_in_names(),
        "sequences": datasets.built_in_names(),
        "columns": ("all", *metrics.describe()),
        "metric": tuple(metrics.describe()),
        "keep": tuple(faults()),
        "set": tuple(f"{one.key}=" for one in describe()),
    }


def _commands(root: argparse.ArgumentParser, known: Mapping[str, tuple[str, ...]]) -> Iterator[_Command]:
    (subcommands,) = (one for one in root._actions if isinstance(one, argparse._SubParsersAction))
    helps = {one.dest: one.help or "" for one in subcommands._choices_actions}
    for name, parser in subcommands.choices.items():
        options = (
            # Positional choices are offered where no option is under way.
            _Option(
                tuple(one.option_strings),
                one.help or "",
                tuple(map(str, one.choices or known.get(one.dest, ()))),
                one.nargs != 0,
            )
            for one in parser._actions
        )
        yield _Command(name, helps[name], tuple(options))


def _bash(commands: list[_Command]) -> str:
    cases = "".join(f"    {one.name}) {_case(one)} ;;\n" for one in commands)
    names = " ".join(one.name for one in commands)
    return f"""# Completion of vislam for bash. Load it with: eval "$(vislam completion bash)"
_vislam() {{
  local word="${{COMP_WORDS[COMP_CWORD]}}" before="${{COMP_WORDS[COMP_CWORD-1]}}" words="" chosen="" listed=""
  if [ "$COMP_CWORD" -eq 1 ]; then
    COMPREPLY=($(compgen -W "{names} --help --version" -- "$word"))
    return
  fi
  case "${{COMP_WORDS[1]}}" in
{cases}  esac
  if [ -n "$chosen" ]; then
    [[ "$word" == *,* ]] && listed="${{word%,*}},"
    COMPREPLY=($(compgen -P "$listed" -W "$chosen" -- "${{word##*,}}"))
    [[ "${{COMPREPLY[0]-}}" == *= ]] && compopt -o nospace 2>/dev/null
  else
    COMPREPLY=($(compgen -W "$words" -- "$word"))
  fi
}}
complete -o default -F _vislam vislam
"""


def _case(one: _Command) -> str:
    words = " ".join(word for option in one.options for word in (option.words or option.choices))
    chosen = " ".join(
        f'{"|".join(option.words)}) chosen="{" ".join(option.choices)}" ;;'
        for option in one.options
        if option.words and option.choices
    )
    return f'words="{words}"' + (f'; case "$before" in {chosen} esac' if chosen else "")


def _zsh(commands: list[_Command]) -> str:
    script = _bash(commands).split("\n", 1)[1]
    head = '# Completion of vislam for zsh. Load it with: eval "$(vislam completion zsh)"\n'
    return f"{head}autoload -U +X compinit && compinit -u\nautoload -U +X bashcompinit && bashcompinit\n{script}"


def _fish(commands: list[_Command]) -> str:
    lines = ["# Completion of vislam for fish: save as ~/.config/fish/completions/vislam.fish"]
    lines.append("complete -c vislam -n __fish_use_subcommand -l help -l version")
    for one in commands:
        lines.append(f"complete -c vislam -n __fish_use_subcommand -a {one.name} -d {_quoted(one.help)}")
        under = f"complete -c vislam -n '__fish_seen_subcommand_from {one.name}'"
        for option in one.options:
            if not option.words:
                lines += [f"{under} -a {_quoted(' '.join(option.choices))}"] if option.choices else []
                continue
            words = " ".join(f"-l {w[2:]}" if w.startswith("--") else f"-s {w[1:]}" for w in option.words)
            values = f" -x -a {_quoted(' '.join(option.choices))}" if option.choices else " -r" * option.takes_value
            lines.append(f"{under} {words}{values} -d {_quoted(option.help)}")
    return "\n".join(lines) + "\n"


def _quoted(text: str) -> str:
    escaped = text.replace("%%", "%").replace("\\", "\\\\").replace("'", "\\'")
    return f"'{escaped}'"
