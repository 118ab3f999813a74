"""The command ``vislam``: one module a subcommand, arguments only; whatever is slow to import is imported to run."""

import os
import signal
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from types import FrameType

from toolkit.cli import baseline, check, check_data, compare, export, list_parts, report, simulate
from toolkit.cli.arguments import Parser, ShowVersion, epilog
from toolkit.errors import VislamError

_INTERRUPTED = 130
# 128 + SIGPIPE, as the shell reports any program whose reader went away.
_READER_GONE = 141


def parser() -> Parser:
    """Return the parser of the whole command line; each subcommand puts its function in ``command``."""
    root = Parser(
        prog="vislam",
        description="Compare visual-inertial estimators on the same stereo and motion measurements.",
        epilog=epilog("vislam compare drive --max-frames 40 --out runs/first"),
    )
    root.add_argument("--version", action=ShowVersion, help="print the version and exit")
    subcommands = root.add_subparsers(title="commands", metavar="COMMAND", required=True)
    for module in (compare, report, export, check, baseline, check_data, list_parts, simulate):
        module.add_to(subcommands)
    return root


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit status; any expected trouble is one line on stderr."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    try:
        with _termination_as_interrupt():
            options = parser().parse_args(given)
            options.command_line = ["vislam", *given]
            status: int = options.command(options)
            # Here and not at the interpreter's end, where a closed pipe looks like a defect.
            sys.stdout.flush()
            return status
    except VislamError as error:
        return _told(str(error), error.exit_status)
    except KeyboardInterrupt:
        return _told("interrupted; what was not finished is not written", _INTERRUPTED)
    except BrokenPipeError:
        # Nobody reads on, as in `vislam list | head -1`; the interpreter must not try to flush the rest.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return _READER_GONE


def _told(message: str, status: int) -> int:
    print(f"vislam: error: {' '.join(message.split())}", file=sys.stderr)
    return status


@contextmanager
def _termination_as_interrupt() -> Iterator[None]:
    """Treat SIGTERM like Ctrl-C, so that what is half-written is cleaned up then, too."""

    def interrupt(_signal: int, _frame: FrameType | None) -> None:
        raise KeyboardInterrupt

    try:
        before = signal.signal(signal.SIGTERM, interrupt)
    except ValueError:  # only the main thread may do this; embedded elsewhere, signals are not ours
        yield
        return
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)
