"""What the subcommands share: the parser and the kinds of arguments."""

import argparse
import math
import sys
import textwrap
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from functools import partial
from itertools import takewhile
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, NoReturn

from toolkit.errors import VislamError, did_you_mean, no_such, one_line
from toolkit.threads import MOST_WORKERS

if TYPE_CHECKING:
    from _typeshed import SupportsWrite

    # What argparse gives a module to add its own parser to; it has no public name and cannot be indexed at run time.
    Subcommands = argparse._SubParsersAction["Parser"]

    from toolkit.experiment.recording import Recording

# "s" last, which the others end with.
_TIMES = {"min": 60.0, "ms": 1e-3, "s": 1.0}


class UsageError(VislamError):
    """A command line that asks for something that does not exist."""

    exit_status: ClassVar[int] = 2


class Parser(argparse.ArgumentParser):
    """A parser that keeps the layout of its epilog, takes no abbreviations and reports an error in one line."""

    def __init__(self, *, description: str, **options: Any) -> None:
        super().__init__(
            description=textwrap.fill(description, 80),
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
        """Print and leave."""
        from importlib.metadata import version

        print(f"vislam {version('vislam-toolkit')}")
        parser.exit()


def epilog(*examples: str) -> str:
    """Return the end of a help text: examples that a test executes."""
    return "\n".join(["example:", *(f"  $ {example}" for example in examples)])


class Command(NamedTuple):
    """A subcommand: its words in the help, what adds its arguments, and what runs it and returns the exit status."""

    name: str
    summary: str
    examples: tuple[str, ...]
    add_arguments: Callable[[Parser], None]
    run: Callable[[argparse.Namespace], int]

    def add_to(self, subcommands: "Subcommands") -> None:
        """Add the parser of the subcommand; it puts what runs into ``command``."""
        description = " ".join((self.run.__doc__ or "").split())
        parser = subcommands.add_parser(
            self.name, help=self.summary, description=description, epilog=epilog(*self.examples)
        )
        self.add_arguments(parser)
        parser.set_defaults(command=self.run)


def command(
    name: str, summary: str, *examples: str, arguments: Callable[[Parser], None] = lambda _: None
) -> Callable[[Callable[[argparse.Namespace], int]], Command]:
    """Make a subcommand of the function that runs it; the function's docstring is the description in its help."""
    return partial(Command, name, summary, examples, arguments)


def names(text: str) -> tuple[str, ...]:
    """Parse names separated by commas; each counts once."""
    found = tuple(dict.fromkeys(part.strip() for part in text.split(",") if part.strip()))
    if not found:
        raise argparse.ArgumentTypeError("expected names separated by commas")
    return found


def named_file(text: str) -> tuple[str, Path]:
    """Parse NAME=FILE."""
    name, equals, file = text.partition("=")
    if not (equals and name.strip() and file):
        raise argparse.ArgumentTypeError(f"expected NAME=FILE, not {text!r}")
    return name.strip(), Path(file)


def at_least(least: int, most: float = math.inf) -> Callable[[str], int]:
    """Return a parser of whole numbers that are no smaller than ``least`` and no larger than ``most``."""

    def whole_number(text: str) -> int:
        try:
            value = int(text)
        except ValueError:
            raise argparse.ArgumentTypeError(f"expected a whole number, not {text!r}") from None
        if value < least:
            raise argparse.ArgumentTypeError(f"expected at least {least}, not {value}")
        if value > most:
            raise argparse.ArgumentTypeError(f"expected at most {most}, not {value}")
        return value

    return whole_number


def positive_seconds(text: str) -> float:
    """Parse a finite duration greater than zero, as in 10s, 500ms, 2min or 10."""
    value = _seconds(text)
    if not 0.0 < value < float("inf"):
        raise argparse.ArgumentTypeError(f"expected seconds greater than zero, not {text}")
    return value


def seconds_from_start(text: str) -> float:
    """Parse a time since a recording's start, written like a duration."""
    value = _seconds(text)
    if not 0.0 <= value < float("inf"):
        raise argparse.ArgumentTypeError(f"expected a time since the start, not {text}")
    return value


def _seconds(text: str) -> float:
    number = text.strip()
    unit, factor = next(((unit, factor) for unit, factor in _TIMES.items() if number.endswith(unit)), ("", 1.0))
    try:
        return factor * float(number.removesuffix(unit))
    except ValueError:
        raise argparse.ArgumentTypeError(f"expected seconds, as in 10s, not {text!r}") from None


def add_option(
    parser: argparse.ArgumentParser | argparse._ArgumentGroup, option: str, default: object, what: str, **kind: Any
) -> None:
    """Add an option that has a value where none is given, which ends its help; ``kind`` is as argparse has it."""
    shown = f"{default:g}" if isinstance(default, float) else default
    parser.add_argument(option, default=default, help=f"{what} (default: {shown})", **kind)


def add_part_arguments(parser: argparse.ArgumentParser) -> None:
    """Add what says which frames of a recording are used."""
    after = "after the first frame, as in 10s"
    parser.add_argument(
        "--from", dest="from_s", metavar="TIME", type=seconds_from_start, help=f"leave out frames before it, {after}"
    )
    parser.add_argument(
        "--to", dest="to_s", metavar="TIME", type=seconds_from_start, help=f"leave out frames after it, {after}"
    )
    parser.add_argument("--every", metavar="N", type=at_least(1), help="use one frame in N")
    parser.add_argument("--max-frames", metavar="N", type=at_least(2), help="use the first N of these frames only")


def add_estimators_argument(parser: argparse.ArgumentParser, what: str) -> None:
    """Add the names of estimators, with what they are named for."""
    parser.add_argument(
        "--estimators",
        metavar="NAME,...",
        type=names,
        help=f"{what}; my_filter.py is a file of your own (default: those that 'vislam list estimators' marks)",
    )


def add_output_arguments(parser: argparse.ArgumentParser, as_json: str, quiet: str = "see the exit status") -> None:
    """Add --json, with what it prints, and --quiet, with where the answer is then; at most one can be given."""
    group = parser.add_mutually_exclusive_group()
    group.add_argument("--json", action="store_true", help=f"print {as_json}")
    group.add_argument("--quiet", action="store_true", help=f"print nothing; {quiet}")


def add_workers_argument(parser: argparse.ArgumentParser) -> None:
    """Add the number of processes; None stands for one a CPU."""
    parser.add_argument(
        "--workers", metavar="N", type=at_least(1, MOST_WORKERS), help="processes side by side (default: one a CPU)"
    )


# Repeated from toolkit.datasets.io.bag_topics (a test compares them), which would cost the help a third of a second.
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


def add_topics_argument(parser: argparse.ArgumentParser) -> None:
    """Add which topics of a bag are what; read it with :func:`with_tracks`."""
    parser.add_argument(
        "--topics",
        metavar="ROLE=TOPIC,...",
        type=topics,
        help=f"of a bag, as in left=/cam0/image_raw,imu=/imu0 ({', '.join(TOPIC_ROLES)}); others are guessed",
    )


def add_tracks_argument(parser: argparse.ArgumentParser) -> None:
    """Add where tracks come from; read it with :func:`with_tracks`."""
    parser.add_argument(
        "--tracks",
        choices=("auto", "images", "simulated"),
        help="of a recording with images and truth: made of the images, or simulated along the truth (default: auto, "
        "of the images if nearly all of them exist)",
    )
    add_topics_argument(parser)


def with_tracks(values: Mapping[str, Any], options: argparse.Namespace) -> dict[str, Any]:
    """Return the nested values of settings with --tracks and --topics put in where they were given."""
    given = {"tracks": getattr(options, "tracks", None), "topics": options.topics}
    frontend = {key: value for key, value in given.items() if value is not None}
    return {**values, "frontend": {**values.get("frontend", {}), **frontend}} if frontend else dict(values)


def add_repair_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments that keep the audit from repairing; read them with :func:`kept_faults`."""
    group = parser.add_mutually_exclusive_group()
    group.add_argument("--no-repair", action="store_true", help="report the faults of a recording, repair none")
    group.add_argument(
        "--keep", metavar="FAULT,...", type=names, default=(), help="do not repair these, see 'vislam list faults'"
    )


def add_recording_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the recording, its seed, and what the audit may repair; read it with :func:`recording_asked`."""
    parser.add_argument("sequence", metavar="SEQUENCE", help="a recording's path, or a built-in name")
    add_repair_arguments(parser)
    add_tracks_argument(parser)
    add_option(parser, "--seed", 0, "of a simulated sequence", metavar="N", type=at_least(0))


def requested_recording(options: argparse.Namespace) -> "Recording":
    """Return the recording that SEQUENCE and --seed name, with what --no-repair, --keep, --tracks and --topics say."""
    from toolkit.audit import faults
    from toolkit.experiment.recording import Recording
    from toolkit.settings import settings_of

    frontend = settings_of(with_tracks({}, options), "the command line").frontend
    return Recording(options.sequence, options.seed, keep=kept_faults(options, faults()), frontend=frontend)


def kept_faults(options: argparse.Namespace, known: Collection[str]) -> frozenset[str]:
    """Return the faults that are not to be repaired, or raise UsageError for one that does not exist."""
    if options.no_repair:
        return frozenset(known)
    return frozenset(known_names("fault", options.keep, known))


def known_names(kind: str, given: Iterable[str], known: Collection[str]) -> list[str]:
    """Return the names given, or raise UsageError for the first that is not among the known."""
    checked = list(given)
    for name in checked:
        if name not in known:
            raise UsageError(no_such(kind, name, known))
    return checked
