"""The command ``vislam``: subcommands by what they are about; whatever is slow to import is imported to run.

Reading order: arguments (how a command is declared, and the arguments that several share), then the commands about one
thing in a file each: compare, trials (explain and sweep), evaluate, runs, recordings, gate, parts. Beside them
progress_display. Here: how a command is run, and what becomes of errors, signals and its output.
"""

import errno
import io
import logging
import os
import signal
import sys
import time
import traceback
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import cache
from importlib.machinery import EXTENSION_SUFFIXES
from types import FrameType

from toolkit.cli import compare, evaluate, gate, parts, recordings, runs, trials
from toolkit.cli.arguments import Parser, ShowVersion
from toolkit.errors import OutputError, SystemLimitError, VislamError, one_line
from toolkit.files.writing import ENDING

# A defect and a lack of the system's means, as sysexits.h numbers them.
_DEFECT, _SYSTEM = 70, 71
_INTERRUPTED = 130
# 128 + SIGPIPE, as the shell reports any program whose reader went away.
_READER_GONE = 141
# Within this after the first, further signals let it clean up; one that comes later interrupts again, for the first may
# have come where Python cannot raise it.
_PATIENCE_S = 10.0
# What writing fails with; of a file such an error is an OutputError already, so that here it is the output's.
_NOT_WRITTEN = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO, errno.EBADF)
# What the system refuses for lack of it, whatever a library makes of that: open files, memory, processes.
_TOO_FEW = (errno.EMFILE, errno.ENFILE, errno.ENOMEM, errno.EAGAIN)
# With one thread of OpenBLAS nothing but vislam evaluate runs within less (ulimit -v, gtsam 4.3.0, scipy 1.17, Linux).
_LEAST_MEMORY = 300_000 * 1024
_WITH_TRACEBACK = "VISLAM_TRACEBACK"
# In the order of the help: what one does every day, then once in a while.
_COMMANDS = (
    *(compare.compare, trials.explain, trials.sweep, evaluate.evaluate),
    *(runs.diff, runs.report, runs.export, runs.reproduce),
    *(gate.check, gate.baseline, recordings.check_data, recordings.card, parts.verify, parts.list_parts, parts.cite),
    *(recordings.simulate, recordings.tracks, recordings.import_tables, parts.completion),
)


@cache
def parser() -> Parser:
    """Return the parser of the whole command line; each subcommand puts its function in ``command``."""
    root = Parser(
        prog="vislam",
        description="Compare visual-inertial estimators on the same stereo and motion measurements.",
        examples=("vislam compare drive --max-frames 40 --out runs/first",),
    )
    root.add_argument("--version", action=ShowVersion, help="print the version and exit")
    subcommands = root.add_subparsers(title="commands", metavar="COMMAND", required=True)
    for command in _COMMANDS:
        command.add_to(subcommands)
    return root


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit status; any trouble is one line on stderr."""
    if "_ARGCOMPLETE" in os.environ:
        parts.complete(parser())
    given = list(sys.argv[1:] if arguments is None else arguments)
    _prepare_streams()
    with _ended_once(signal.SIG_DFL if arguments is not None else signal.SIG_IGN) as end_requests:
        try:
            return _run(given)
        except VislamError as error:
            return _ended_with(str(error), error.exit_status)
        except KeyboardInterrupt:
            return _interrupted()
        except BrokenPipeError:
            # Nobody reads on, as in `vislam list | head -1`; the interpreter must not try to flush the rest.
            _give_up_output()
            return _READER_GONE
        except Exception as error:  # the last resort: whatever it is, it is told in one line
            # Compiled code may make any error of an interrupt.
            return _interrupted() if end_requests else _unexpected(error)


def _run(given: list[str]) -> int:
    try:
        options = parser().parse_args(given)
        options.command_line = ["vislam", *given]
        try:  # relative paths and new processes need it
            os.getcwd()  # noqa: PTH109
        except FileNotFoundError as error:
            raise SystemLimitError("the current directory is no longer there; change to another one") from error
        _check_memory()
        status: int = options.command(options)
    except SystemExit:  # argparse leaves this way, after a help text too
        sys.stdout.flush()
        raise
    # Here and not at the interpreter's end, where a closed pipe or a full disk looks like a defect.
    sys.stdout.flush()
    return status


def _check_memory() -> None:
    """Raise SystemLimitError where the memory allowed does not even hold the libraries.

    OpenBLAS would end the process by itself, or wait forever and for no signal. Its threads take memory of their own:
    where there is a limit it has one.
    """
    try:
        from resource import RLIM_INFINITY, RLIMIT_AS, getrlimit
    except ImportError:
        return
    limit = getrlimit(RLIMIT_AS)[0]
    if limit == RLIM_INFINITY:
        return
    if limit < _LEAST_MEMORY:
        raise SystemLimitError(
            f"the memory is limited to {limit / 1e6:.0f} MB (ulimit -v), and NumPy, SciPy and GTSAM alone need "
            f"{_LEAST_MEMORY / 1e6:.0f} MB of address space; allow more"
        )
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")


def _prepare_streams() -> None:
    """Have characters that the terminal's encoding lacks written as escapes, and text without a reader be lost."""
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:  # closed by the caller: it leads nowhere, lest a file opened later take its number
            nowhere = os.open(os.devnull, os.O_RDWR)
            if nowhere != number:
                os.dup2(nowhere, number)
                os.close(nowhere)
            os.set_inheritable(number, True)  # a process started here has the three streams, too
    # Lest it tell in several lines, and in every process, that there is no place for its cache of fonts.
    logging.getLogger("matplotlib").setLevel(logging.ERROR)
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is None:  # closed by the caller
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))  # noqa: SIM115, PTH123
        elif isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


def _unexpected(error: Exception) -> int:
    """Tell in one line what the commands do not foresee, and return its exit status."""
    if os.environ.get(_WITH_TRACEBACK, "0") not in ("", "0"):
        traceback.print_exc()
    if isinstance(error, OSError) and error.filename is None and error.errno in _NOT_WRITTEN:
        _give_up_output()
        what = f"the standard output cannot be written ({error.strerror or error})"
        return _ended_with(what, OutputError.exit_status)
    behind = _means_behind(error)
    if isinstance(behind, MemoryError):
        lacking = "out of memory; use a part of the recording, a shorter one, or fewer --workers"
    elif isinstance(behind, ImportError):
        lacking = f"a library cannot be loaded ({behind}); allow more memory, or install it again"
    elif behind is not None:
        lacking = f"an operating-system call failed: {behind}"
    elif isinstance(error, UnicodeError):
        lacking = f"a name or a text is in no known encoding ({error}); rename it, or use UTF-8"
    else:
        told, how = f"{type(error).__name__}: {error}", f"set {_WITH_TRACEBACK}=1 to see where, and report it there"
        what = "a defect of vislam, or of a package or a file that it was given, not of your data"
        return _ended_with(f"{what} ({told}); {how}", _DEFECT)
    return _ended_with(lacking, _SYSTEM)


def _means_behind(error: BaseException | None) -> BaseException | None:
    """Return the lack of the system's means that an error is or comes from, if any: a library may hide one.

    It is no memory, a call that the system refused, or a library of compiled code that it did not load.
    """
    if isinstance(error, OSError):
        return error
    while error is not None:
        compiled = isinstance(error, ImportError) and str(error.path).endswith(tuple(EXTENSION_SUFFIXES))
        if compiled or isinstance(error, MemoryError) or (isinstance(error, OSError) and error.errno in _TOO_FEW):
            return error
        error = error.__cause__ or (None if error.__suppress_context__ else error.__context__)
    return None


def _interrupted() -> int:
    # CPython notes an interrupt that was raised in source text it had been handed, as the making of a dataclass is, and
    # `python -m toolkit.cli` would then end by SIGINT though we caught it. It forgets the note at the next such text.
    exec("")
    return _ended_with("interrupted; what was not finished is not written", _INTERRUPTED)


def _give_up_output() -> None:
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _ended_with(message: str, status: int) -> int:
    with suppress(OSError):
        print(f"vislam: error: {one_line(message)}", file=sys.stderr)
    return status


@contextmanager
def _ended_once(afterwards: signal.Handlers) -> Iterator[Collection[float]]:
    """Treat SIGTERM and SIGHUP like Ctrl-C, and whichever comes first so once: what is half-written is cleaned up.

    Gives the times at which one was raised.

    In the end they meet ``afterwards`` or, where that is the default, what they met before: the interpreter of a
    command has to clean up at its end, and its status is certain; that of a notebook goes on. A signal that the
    caller has us ignore, as nohup does, stays ignored.
    """
    first: list[float] = []

    def interrupt(_signal: int, _frame: FrameType | None) -> None:
        if not first or time.monotonic() - first[-1] > _PATIENCE_S:
            first.append(time.monotonic())
            raise KeyboardInterrupt

    handlers = {number: before for number in ENDING if (before := signal.getsignal(number)) != signal.SIG_IGN}
    try:
        for number in handlers:
            signal.signal(number, interrupt)
    except ValueError:  # only the main thread may do this; embedded elsewhere, signals are not ours
        yield first
        return
    try:
        yield first
    finally:
        ignored = afterwards == signal.SIG_IGN
        for number, before in handlers.items():
            signal.signal(number, signal.SIG_IGN if ignored else before or signal.SIG_DFL)
