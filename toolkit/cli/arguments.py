"""How a subcommand and its arguments are declared, the kinds of arguments, and those that several commands share."""

import argparse
import math
import sys
import textwrap
from collections.abc import Callable, Collection, Iterable, Sequence
from contextlib import suppress
from functools import partial
from itertools import takewhile
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, NoReturn, TypeVar, get_args

from toolkit.errors import VislamError, did_you_mean, no_such, one_line
from toolkit.report import FigureChoice, FigureFormat
from toolkit.threads import MOST_WORKERS

Number = TypeVar("Number", int, float)
if TYPE_CHECKING:
    from _typeshed import SupportsWrite

    from toolkit.experiment.recording import Recording
    from toolkit.settings import Settings

# "s" last, which the others end with.
_TIMES = {"min": 60.0, "ms": 1e-3, "s": 1.0}


class UsageError(VislamError):
    """A command line that asks for something that does not exist."""

    exit_status: ClassVar[int] = 2


class Parser(argparse.ArgumentParser):
    """A parser that keeps the layout of its epilog, takes no abbreviations and reports an error in one line."""

    def __init__(self, *, description: str, examples: Iterable[str], **options: Any) -> None:
        super().__init__(
            description=textwrap.fill(description, 80),
            epilog="\n".join(["example:", *(f"  $ {example}" for example in examples)]),
            formatter_class=argparse.RawDescriptionHelpFormatter,
            allow_abbrev=False,
            **options,
        )

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> tuple[Any, list[str]]:
        """Parse; what is left over is an error of the command it was given to, which knows its options."""
        given = list(sys.argv[1:] if args is None else args)
        options, left = super().parse_known_args(given, namespace)
        if left:
            self.error(self._why_left(left[0], given))
        return options, left

    def _why_left(self, word: str, given: list[str]) -> str:
        if word.startswith("-"):
            option = word.partition("=")[0]
            known = list(self._option_string_actions)
            begun = next((name for name in known if name.startswith(option)), "")
            return f"there is no option {option}{f'; did you mean {begun}?' if begun else did_you_mean(option, known)}"
        options = [i for i in range(given.index(word)) if given[i] in self._option_string_actions]
        if not options or self._option_string_actions[given[options[-1]]].type is not names:
            return f"unexpected argument {word}"
        option, *values = given[options[-1] :]
        listed = ",".join(takewhile(lambda value: not value.startswith("-"), values))
        return f"unexpected argument {word}; give names with commas: {option} {listed}"

    def error(self, message: str) -> NoReturn:
        """Leave with status 2 and one line on stderr."""
        self.exit(2, f"vislam: error: {one_line(message)} (see {self.prog} --help)\n")

    def _print_message(self, message: str, file: "SupportsWrite[str] | None" = None) -> None:
        """Print a help text, and not as argparse does, which keeps a full disk to itself."""
        if message:
            (file or sys.stderr).write(message)

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        """Refuse what is no choice, with the nearest that is."""
        if action.choices is not None and value not in action.choices:
            raise argparse.ArgumentError(action, no_such("choice", str(value), map(str, action.choices)))


class ShowVersion(argparse.Action):
    """Prints the version; looks it up only then, for that takes longer than all the parsing."""

    def __init__(self, option_strings: Sequence[str], dest: str, help: str | None = None) -> None:
        super().__init__(option_strings, dest, nargs=0, default=argparse.SUPPRESS, help=help)

    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> NoReturn:
        from importlib.metadata import version

        print(f"vislam {version('vislam-toolkit')}")
        parser.exit()


class Argument(NamedTuple):
    """An argument of a subcommand: its name, and what else argparse's ``add_argument`` takes."""

    name: str
    how: dict[str, Any]

    def add_to(self, parser: argparse._ActionsContainer) -> None:
        parser.add_argument(self.name, **self.how)


class Group(NamedTuple):
    """Arguments under a title of their own in the help, or without one such that at most one can be given."""

    arguments: tuple[Argument, ...]
    title: str = ""

    def add_to(self, parser: argparse._ActionsContainer) -> None:
        group = parser.add_argument_group(self.title) if self.title else parser.add_mutually_exclusive_group()
        for one in self.arguments:
            one.add_to(group)


def arg(usage: str, help: str, kind: Callable[[str], Any] | None = str, sets: str = "", **how: Any) -> Argument:
    """Return an argument with a value, named as ``--out DIR`` or ``sequences SEQUENCE``; a default ends its help.

    One that ``sets`` a setting is short for it; a command line has its value as OPTION=KEY.
    """
    name, _, metavar = usage.partition(" ")
    how |= {"dest": f"{name}={sets}"} if sets else {}
    default = how.get("default")
    shown = f"{default:g}" if isinstance(default, float) else default
    end = "" if default in (None, (), []) else f" (default: {shown})"
    return Argument(name, {"metavar": metavar or None, "type": kind, "help": help + end, **how})


def choice(usage: str, choices: Sequence[str], help: str, **how: Any) -> Argument:
    """Return an argument that is one of some words, which the help names."""
    return arg(usage, help, None, choices=choices, **how)


def flag(name: str, help: str, **how: Any) -> Argument:
    return Argument(name, {"action": "store_true", "help": help, **how})


class Command(NamedTuple):
    """A subcommand: its words in the help, its arguments, and what runs it and returns the exit status."""

    name: str
    summary: str
    arguments: tuple[Argument | Group, ...]
    examples: tuple[str, ...]
    run: Callable[[argparse.Namespace], int]

    def add_to(self, subcommands: "argparse._SubParsersAction[Parser]") -> None:
        """Add the parser of the subcommand; it puts what runs into ``command``."""
        description = " ".join((self.run.__doc__ or "").split())
        parser = subcommands.add_parser(self.name, help=self.summary, description=description, examples=self.examples)
        for argument in self.arguments:
            argument.add_to(parser)
        parser.set_defaults(command=self.run)


def command(
    name: str, summary: str, *arguments: Argument | Group, examples: tuple[str, ...]
) -> Callable[[Callable[[argparse.Namespace], int]], Command]:
    """Make a subcommand of the function that runs it; its docstring is the description in the help.

    A test executes the examples, one after the other.
    """
    return partial(Command, name, summary, arguments, examples)


def names(text: str) -> tuple[str, ...]:
    found = tuple(dict.fromkeys(part.strip() for part in text.split(",") if part.strip()))
    if not found:
        raise argparse.ArgumentTypeError("expected names separated by commas")
    return found


def named_file(text: str) -> tuple[str, str]:
    name, equals, file = text.partition("=")
    if not (equals and name.strip() and file):
        raise argparse.ArgumentTypeError(f"expected NAME=FILE, not {text!r}")
    return name.strip(), file


def at_least(least: int, most: float = math.inf) -> Callable[[str], int]:
    """Return a parser of whole numbers from ``least`` to ``most``."""
    bounds = f"at least {least}" + (f" and at most {most:g}" if most < math.inf else "")
    return _read(int, lambda value: least <= value <= most, f"a whole number, {bounds}")


def number_within(what: str, least: float, most: float) -> Callable[[str], float]:
    return _read(float, lambda value: least <= value <= most, f"{what} from {least:g} to {most:g}")


def _read(parse: Callable[[str], Number], fits: Callable[[Number], bool], expected: str) -> Callable[[str], Number]:
    """Return a parser of numbers that says what is expected of one that does not fit."""

    def read(text: str) -> Number:
        with suppress(ValueError):
            if fits(value := parse(text)):
                return value
        raise argparse.ArgumentTypeError(f"expected {expected}, not {text!r}")

    return read


def _seconds(text: str) -> float:
    number = text.strip()
    unit, factor = next(((unit, factor) for unit, factor in _TIMES.items() if number.endswith(unit)), ("", 1.0))
    return factor * float(number.removesuffix(unit))


# Parsers of a duration, and of a time since a recording's start: 10s, 500ms, 2min or 10.
positive_seconds = _read(_seconds, lambda value: 0.0 < value < math.inf, "seconds greater than zero, as in 10s")
seconds_from_start = _read(_seconds, lambda value: 0.0 <= value < math.inf, "seconds since the start, as in 10s")


# Repeated from toolkit.datasets.bags (a test compares them), which would cost the help a third of a second.
TOPIC_ROLES = ("left", "right", "left_info", "right_info", "imu", "accel", "twist", "truth")


def topics(text: str) -> str:
    """Parse ROLE=TOPIC,..., the topics of a bag."""
    given = set()
    for part in text.split(","):
        role, equals, name = (word.strip() for word in part.partition("="))
        if not (equals and name):
            raise argparse.ArgumentTypeError(f"expected ROLE=TOPIC,..., as in imu=/imu0, not {part.strip()!r}")
        if role in given:
            raise argparse.ArgumentTypeError(f"{role} is named twice; leave one out")
        given.add(role)
        if role not in TOPIC_ROLES:
            raise argparse.ArgumentTypeError(no_such("role", role, TOPIC_ROLES))
    return text


def estimators(what: str) -> Argument:
    """Return the argument that names estimators; ``what`` says what they are named for."""
    default = "my_filter.py is a file of your own (default: those that 'vislam list estimators' marks)"
    return arg("--estimators NAME,...", f"{what}; {default}", names)


def output(as_json: str, quiet: str = "see the exit status") -> Group:
    """Return --json, with what it prints, and --quiet, with where the answer is then."""
    return Group((flag("--json", f"print {as_json}"), flag("--quiet", f"print nothing; {quiet}")))


_AFTER = "after the first frame, as in 10s"
PART = (
    arg("--from TIME", f"leave out frames before it, {_AFTER}", seconds_from_start, dest="from_s"),
    arg("--to TIME", f"leave out frames after it, {_AFTER}", seconds_from_start, dest="to_s"),
    arg("--every N", "use one frame in N", at_least(1)),
    arg("--max-frames N", "use the first N of these frames only", at_least(2)),
)
WORKERS = arg("--workers N", "processes side by side (default: one a CPU)", at_least(1, MOST_WORKERS))
# Repeated from toolkit.datasets.trajectories.covariances (a test compares them), as the help is to come at once.
COV_CONVENTIONS = tuple(
    f"{order}/{kind}" for order in ("rot-pos", "pos-rot") for kind in ("right", "left", "fixed", "mixed")
)
COV_CONVENTION = arg(
    "--cov-convention NAME",
    "of covariances where a file of trajectories does not say it: which block is first, and which error they are of "
    f"({', '.join(COV_CONVENTIONS)}; see docs/conventions.md)",
    choices=COV_CONVENTIONS,
)
FORMAT = choice("--format", ("text", "markdown", "csv", "latex"), "of what is printed", default="text")
FIGURES = (
    choice("--figures", get_args(FigureChoice), "figures to draw (see docs/figures.md)", default="few"),
    choice("--figure-format", get_args(FigureFormat), "format of the figures", default="png"),
)
REPAIR = Group(
    (
        flag("--no-repair", "report the faults of a recording, repair none"),
        arg("--keep FAULT,...", "do not repair these, see 'vislam list faults'", names),
    )
)


TOPICS = arg(
    "--topics ROLE=TOPIC,...",
    f"of a bag, as in left=/cam0/image_raw,imu=/imu0 ({', '.join(TOPIC_ROLES)}); others are guessed",
    topics,
    sets="frontend.topics",
)
_TRACKS = ("auto", "images", "simulated")
TRACKS = choice("--tracks", _TRACKS, "of images, or along the truth (default: auto)", sets="frontend.tracks")
RECORDING = (
    arg("sequence SEQUENCE", "a recording's path, or a built-in name"),
    REPAIR,
    TRACKS,
    TOPICS,
    arg("--seed N", "of a simulated sequence", at_least(0), default=0),
)


class _Once(argparse.Action):
    """Stores the value of an option that is given once: a second one would pass over the first."""

    def __call__(
        self, parser: argparse.ArgumentParser, options: argparse.Namespace, values: Any, option: str | None = None
    ) -> None:
        if getattr(options, self.dest) is not None:
            parser.error(f"{option} is given twice; it takes one file, and --set changes single settings")
        setattr(options, self.dest, values)


SETTINGS = (
    arg("--config FILE", "settings in TOML, or the manifest.json of a run to repeat", Path, action=_Once),
    arg("--outliers POLICY", "how outliers are treated (see docs/settings.md)", sets="outliers.policy"),
    arg("--window SECONDS", "length of the windows of estimators", positive_seconds, sets="window.lag_s"),
    arg("--set KEY=VALUE", "one setting (see 'vislam list settings'); may be repeated", action="append", default=[]),
)
# How recordings are prepared and estimators run, of every command that does so.
HOW = (
    *PART,
    REPAIR,
    choice("--start", ("measurements", "truth"), "source of the first state (default: measurements)", sets="start"),
    TRACKS,
    TOPICS,
    arg("--seed N", "of simulated sequences (default: 0)", at_least(0), sets="first_seed"),
    arg("--seeds N", "repeat simulated sequences over N seeds, from --seed", at_least(1), sets="seeds"),
    choice("--vary", ("noise", "world"), "what a seed draws: noise, or the whole world (default: noise)", sets="vary"),
    *SETTINGS,
)
SCHEDULER = arg("--scheduler ADDRESS", "run on a Dask cluster, as in tcp://host:8786 (see docs/scaling.md)")
TRUTH = arg("--truth FILE.tum", "ground truth of the one SEQUENCE")
OUT = arg(
    "--out DIR",
    "run directory (default: runs/<date and time>); runs of several seeds or variants are kept there as they end, and "
    "the same command continues where it stopped",
    Path,
)


def requested_changes(options: argparse.Namespace, *further: tuple[str, str, Any]) -> dict[str, Any]:
    """Return the settings that options and --set give, by key; ``further`` has words, key and value of others.

    Raises UsageError where one is given two values.
    """
    from toolkit.settings.reading import assigned

    short = []
    for dest, value in vars(options).items():
        option, _, key = dest.partition("=")
        if key and value is not None:
            short.append((f"{option} {value:g}" if isinstance(value, float) else f"{option} {value}", key, value))
    by_set = [(f"--set {text}", *assigned(text)) for text in getattr(options, "set", ())]
    changes: dict[str, Any] = {}
    told: dict[str, str] = {}
    for words, key, value in (*short, *further, *by_set):
        if changes.setdefault(key, value) != value:
            raise UsageError(f"{told[key]} and {words} give {key} two values; leave one out")
        told.setdefault(key, words)
    return changes


def requested_settings(options: argparse.Namespace) -> "Settings":
    """Return the settings of --config, --set and the options short for one; SettingsError where there is no such."""
    from toolkit.experiment.configuration import read_configuration
    from toolkit.settings.reading import settings_of, with_changes

    file = getattr(options, "config", None)
    values = {} if file is None else read_configuration(file)[1]
    return settings_of(with_changes(values, requested_changes(options)), str(file or "the command line"))


def requested_recording(options: argparse.Namespace) -> "Recording":
    """Return the recording that SEQUENCE and --seed name, with what --no-repair, --keep, --tracks and --topics say."""
    from toolkit.experiment.recording import Recording

    keep, frontend = frozenset(kept_faults(options) or ()), requested_settings(options).frontend
    return Recording(options.sequence, options.seed, keep=keep, frontend=frontend)


def kept_faults(options: argparse.Namespace) -> tuple[str, ...] | None:
    """Return the faults that are not to be repaired, None where nothing is said; UsageError for one there is not."""
    if not options.no_repair and not options.keep:
        return None
    from toolkit.audit import faults

    return tuple(sorted(faults() if options.no_repair else known_names("fault", options.keep, faults())))


def known_names(kind: str, given: Iterable[str], known: Collection[str]) -> list[str]:
    """Return the names given, or raise UsageError for the first that is not among the known."""
    checked = list(given)
    for name in checked:
        if name not in known:
            raise UsageError(no_such(kind, name, known))
    return checked
