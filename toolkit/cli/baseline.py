"""``vislam baseline``: measure what ``vislam check`` compares with."""

from __future__ import annotations

import argparse
import shlex
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING

from toolkit.cli.arguments import (
    UsageError,
    add_estimators_argument,
    add_settings_arguments,
    add_workers_argument,
    at_least,
    epilog,
    positive_seconds,
    runs_given,
    settings_asked,
)
from toolkit.errors import printable

if TYPE_CHECKING:
    from collections.abc import Iterator

    from toolkit.cli.arguments import Subcommands
    from toolkit.gate.baseline import Baseline, Case

SEEDS, FEWEST_SEEDS = 24, 5


def add_to(subcommands: Subcommands) -> None:
    """Add the subcommand."""
    parser = subcommands.add_parser(
        "baseline",
        help="measure the baseline that vislam check compares with",
        description="Measure estimators on sequences and write what vislam check compares with: simulated sequences "
        "over many seeds, recorded ones once. See docs/gate.md.",
        epilog=epilog(
            "vislam baseline drive --estimators dead-reckoning,ekf --seeds 5 --duration 2 --out baseline.json"
        ),
    )
    parser.add_argument(
        "sequences",
        metavar="SEQUENCE",
        nargs="*",
        help="a built-in name, or a recording's path from here or from the folder VISLAM_DATA; drive:5 is 5 s of it",
    )
    add_estimators_argument(parser, "what to measure, see 'vislam list'")
    parser.add_argument("--out", metavar="FILE", type=Path, help="the baseline (default: named by the releases)")
    parser.add_argument(
        "--seeds",
        metavar="N",
        type=at_least(FEWEST_SEEDS),
        default=SEEDS,
        help=f"seeds of each simulated sequence, from 0 (default: {SEEDS})",
    )
    parser.add_argument(
        "--repeats", metavar="N", type=at_least(1), default=1, help="runs of each recorded sequence (default: 1)"
    )
    parser.add_argument(
        "--duration",
        metavar="S",
        type=positive_seconds,
        help="seconds of every sequence without its own (default: all of it)",
    )
    parser.add_argument(
        "--truth",
        metavar="SEQUENCE=FILE.tum",
        action="append",
        default=[],
        help="ground truth of a recorded sequence, from the same places; may be given several times; with "
        "--trajectories also a folder that has SEQUENCE.tum",
    )
    _add_trajectories_arguments(parser)
    add_settings_arguments(parser)
    add_workers_argument(parser)
    parser.set_defaults(command=command)


def _add_trajectories_arguments(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group("baselines of another system's trajectories")
    group.add_argument(
        "--trajectories",
        metavar="DIR|FILE",
        type=Path,
        help="run nothing; score the files SEQUENCE.tum or SEQUENCE/RUN.tum, of frames or keyframes, against --truth; "
        "or take the scores of an evaluation.json",
    )
    group.add_argument(
        "--align",
        choices=("se3", "yaw", "sim3"),
        help="what is fitted before positions are compared (default: se3; sim3 where scale is not observed)",
    )
    group.add_argument(
        "--gap",
        metavar="S",
        type=positive_seconds,
        help="the longest time between two keyframes that counts as covered (default: 5)",
    )


def command(options: argparse.Namespace) -> int:
    """Measure, write and return 1 where an estimator diverged or failed; the baseline is written then, too."""
    if options.trajectories is not None:
        return _of_trajectories(options)
    if options.align or options.gap:
        raise UsageError("--align and --gap go with --trajectories (see vislam baseline --help)")
    from toolkit.experiment.workers import usable_cpus
    from toolkit.files import check_writable, write_text
    from toolkit.gate.baseline import releases_in_a_name
    from toolkit.gate.baseline_file import to_text
    from toolkit.gate.checking import new_baseline
    from toolkit.progress import of_this_process
    from toolkit.report.manifest import made_here

    cases = _cases(options)
    out = options.out or Path(f"baseline_{releases_in_a_name()}.json")
    check_writable(out)
    workers = options.workers or usable_cpus()
    made_by = made_here(command_to_keep(options.command_line))
    made = new_baseline(cases, workers, made_by, of_this_process(), settings_asked(options))
    write_text(out, to_text(made))
    ends = list(_bad_ends(made))
    print("\n".join(map(printable, [*ends, f"baseline: {out}"])))
    return 1 if ends else 0


def _of_trajectories(options: argparse.Namespace) -> int:
    from toolkit.files import check_writable, write_text
    from toolkit.gate.trajectory_baseline import to_text
    from toolkit.gate.trajectory_check import new_trajectory_baseline
    from toolkit.gate.trajectory_files import Scoring
    from toolkit.report.manifest import made_here

    if options.sequences or options.estimators or options.duration or options.set or options.config:
        raise UsageError("--trajectories takes no SEQUENCE, estimators or settings: it runs nothing")
    out = options.out or Path("trajectory-baseline.json")
    check_writable(out)
    scoring = Scoring(options.align or Scoring.align, options.gap or Scoring.gap_s)
    made_by = made_here(command_to_keep(options.command_line))
    made = new_trajectory_baseline(runs_given(options.trajectories, options.truth), scoring, made_by)
    write_text(out, to_text(made))
    runs = sum(len(one.files) for one in made.sequences.values())
    print(printable(f"baseline: {out} ({len(made.sequences)} sequences, {runs} runs)"))
    return 0


def command_to_keep(words: list[str]) -> str:
    """Return the command line with the output's name alone: a baseline is shared, and its folder is of one machine."""
    kept = []
    for before, word in pairwise(["", *words]):
        option, _, file = word.partition("=")
        if before == "--out":
            kept.append(Path(word).name)
        elif option == "--out" and file:
            kept.append(f"--out={Path(file).name}")
        else:
            kept.append(word)
    return shlex.join(kept)


def _cases(options: argparse.Namespace) -> list[Case]:
    """Return the cases the command line asks for."""
    from toolkit.datasets import is_drawn_from_a_seed
    from toolkit.estimator import defaults, find_all
    from toolkit.gate.baseline import Case
    from toolkit.gate.measuring import located

    if not options.sequences:
        raise UsageError("name a SEQUENCE, or --trajectories DIR (see vislam baseline --help)")
    estimators = tuple(find_all(options.estimators or defaults()))
    truths = dict(_split(text, "=", "--truth takes SEQUENCE=FILE.tum") for text in options.truth)
    cases = []
    for given in options.sequences:
        source, seconds = _with_duration(given)
        simulated = is_drawn_from_a_seed(located(source))
        seeds = tuple(range(options.seeds if simulated else options.repeats))
        cases.append(Case(source, simulated, seeds, estimators, seconds or options.duration, truths.pop(source, None)))
    if len({case.source for case in cases}) != len(cases):
        raise UsageError("a sequence is named twice (see vislam baseline --help)")
    if truths:
        raise UsageError(f"--truth is for {next(iter(truths))}, which is none of the sequences")
    if any(case.simulated and case.truth for case in cases):
        raise UsageError("--truth is for recorded sequences; a simulated one has its own")
    return cases


def _split(text: str, separator: str, otherwise: str) -> tuple[str, str]:
    name, found, value = text.partition(separator)
    if not found or not name or not value:
        raise UsageError(f"{otherwise}, not {text}")
    return name, value


def _with_duration(given: str) -> tuple[str, float | None]:
    """Split ``drive:5`` into the sequence and its seconds; a colon before anything but a number is the path's own."""
    source, _, seconds = given.rpartition(":")
    try:
        return (source, positive_seconds(seconds)) if source else (given, None)
    except argparse.ArgumentTypeError:
        return given, None


def _bad_ends(baseline: Baseline) -> Iterator[str]:
    """Yield every estimator that did not end well somewhere."""
    for case, measured in baseline.cases:
        for name, series in measured.runs.items():
            bad = sum(status != "ok" for status in series.status)
            if bad:
                yield f"{case.source}: {name} did not end well in {bad} of {len(series.status)} runs: {series.why}"
