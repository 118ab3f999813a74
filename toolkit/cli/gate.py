"""``vislam baseline`` and ``check``: what is measured once, and whether anything got worse than it, or moved."""

from __future__ import annotations

import argparse
import shlex
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING

from toolkit.cli.arguments import (
    SETTINGS,
    WORKERS,
    Group,
    UsageError,
    arg,
    at_least,
    choice,
    command,
    estimators,
    flag,
    number_within,
    positive_seconds,
    requested_changes,
    requested_settings,
)
from toolkit.errors import printable

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from toolkit.evaluation.against_baseline import GivenRuns
    from toolkit.gate.baseline import Case
    from toolkit.gate.verdict import Check

SEEDS, FEWEST_SEEDS = 24, 5
_FILES = {"junit": "JUnit XML", "markdown": "Markdown for a pull request", "json": "JSON"}


@command(
    "baseline",
    "measure the baseline that vislam check compares with",
    arg(
        "sequences SEQUENCE",
        "a built-in name, or a recording's path from here or from the folder VISLAM_DATA; drive:5 is 5 s of it",
        nargs="*",
    ),
    estimators("estimators to measure, see 'vislam list estimators'"),
    arg("--out FILE", "the baseline (default: named by the releases)", Path),
    arg("--seeds N", "seeds of each simulated sequence, from 0", at_least(FEWEST_SEEDS), default=SEEDS),
    arg("--repeats N", "runs of each recorded sequence", at_least(1), default=1),
    arg("--duration S", "seconds of every sequence without its own (default: all of it)", positive_seconds),
    arg(
        "--truth SEQUENCE=FILE.tum",
        "ground truth of a recorded sequence; may be repeated; with --trajectories also a folder with SEQUENCE.tum",
        action="append",
        default=[],
    ),
    Group(
        (
            arg(
                "--trajectories DIR|FILE",
                "run nothing; score SEQUENCE.tum or SEQUENCE/RUN.tum against --truth, or take an evaluation.json",
                Path,
            ),
            choice("--align", ("se3", "yaw", "sim3"), "what is fitted before positions are compared (default: se3)"),
            arg("--gap S", "the longest time between two keyframes that is covered (default: 5)", positive_seconds),
            arg("--bound PERCENT", "allowed growth of an error (default: 5)", number_within("percent", 0.0, 1000.0)),
            flag("--plan", "write nothing; say how large a growth would be found, and how many runs find it"),
        ),
        "baselines of another system's trajectories",
    ),
    *SETTINGS,
    WORKERS,
    examples=("vislam baseline drive --estimators dead-reckoning,ekf --seeds 5 --duration 2 --out baseline.json",),
)
def baseline(options: argparse.Namespace) -> int:
    """Measure estimators on sequences and write what vislam check compares with: simulated sequences over many
    seeds, recorded ones once. See docs/gate.md.
    """
    if options.trajectories is not None:
        return _baseline_of_trajectories(options)
    if options.align or options.gap or options.bound is not None or options.plan:
        raise UsageError("--align, --gap, --bound and --plan go with --trajectories (see vislam baseline --help)")
    from toolkit.cli.progress_display import of_this_process
    from toolkit.experiment.workers import usable_cpus
    from toolkit.files.writing import check_writable, write_text
    from toolkit.gate.baseline import releases_in_a_name, to_text
    from toolkit.gate.checking import new_baseline
    from toolkit.report.manifest import made_here

    cases = _cases(options)
    for text in options.set:
        if text.partition("=")[0].strip() in ("first_seed", "seeds", "vary"):
            raise UsageError(f"--set {text} is for compare; a baseline's --seeds are from 0, and draw the noise")
    settings = requested_settings(options)
    out = options.out or Path(f"baseline_{releases_in_a_name()}.json")
    check_writable(out, "{")
    made_by = made_here(_command_to_keep(options.command_line))
    made = new_baseline(cases, options.workers or usable_cpus(), made_by, of_this_process(), settings)
    write_text(out, to_text(made))
    ends = [
        f"{case.source}: {name} did not end well in {bad} of {len(series.status)} runs: {measured.why.get(name, '')}"
        for case, measured in made.cases
        for name, series in measured.runs.items()
        if (bad := sum(status != "ok" for status in series.status))
    ]
    print("\n".join(map(printable, [*ends, f"baseline: {out}"])))
    return 1 if ends else 0


def _baseline_of_trajectories(options: argparse.Namespace) -> int:
    from toolkit.evaluation.against_baseline import BOUND_PERCENT, new_trajectory_baseline, planned, to_text
    from toolkit.evaluation.scoring import Terms
    from toolkit.files.writing import check_writable, write_text
    from toolkit.report.gate import plan_text
    from toolkit.report.manifest import made_here
    from toolkit.report.text import width_of_output

    asked = (options.sequences, options.estimators, options.duration, options.config, requested_changes(options))
    if any(asked):
        raise UsageError("--trajectories takes no SEQUENCE, estimators or settings: it runs nothing")
    out = options.out or Path("trajectory-baseline.json")
    if not options.plan:
        check_writable(out, "{")
    made_by = made_here(_command_to_keep(options.command_line))
    given = _runs_given(options.trajectories, options.truth)
    bound = BOUND_PERCENT if options.bound is None else options.bound
    made = new_trajectory_baseline(given, options.align or "se3", options.gap or Terms.gap_s, made_by, bound)
    if options.plan:
        print(plan_text(planned(made), width_of_output()))
        return 0
    write_text(out, to_text(made))
    runs = sum(len(one.files) for one in made.sequences)
    print(printable(f"baseline: {out} ({len(made.sequences)} sequences, {runs} runs)"))
    return 0


def _command_to_keep(words: list[str]) -> str:
    """Return the command line with the output's name alone: a baseline is shared, and its folder is of one machine."""
    kept = [Path(word).name if before == "--out" else word for before, word in pairwise(["", *words])]
    return shlex.join(f"--out={Path(word).name}" if word.startswith("--out=") else word for word in kept)


def _cases(options: argparse.Namespace) -> list[Case]:
    from toolkit.datasets import is_drawn_from_a_seed
    from toolkit.gate.baseline import Case
    from toolkit.gate.measuring import located
    from toolkit.registry import defaults, find_all

    if not options.sequences:
        raise UsageError("name a SEQUENCE, or --trajectories DIR (see vislam baseline --help)")
    estimators = tuple(entry.word for entry in find_all(options.estimators or defaults()).values())
    truths = {}
    for text in options.truth:
        name, _, file = text.partition("=")
        if not name or not file:
            raise UsageError(f"--truth takes SEQUENCE=FILE.tum, not {text}")
        truths[name] = file
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


def _with_duration(given: str) -> tuple[str, float | None]:
    """Split ``drive:5`` into the sequence and its seconds; a colon before anything but a number is the path's own."""
    source, _, seconds = given.rpartition(":")
    try:
        return (source, positive_seconds(seconds)) if source else (given, None)
    except argparse.ArgumentTypeError:
        return given, None


@command(
    "check",
    "fail if accuracy, consistency or speed are not a baseline's",
    arg("--baseline FILE", "as vislam baseline wrote it, or a folder of such files", Path, required=True),
    WORKERS,
    *(arg(f"--{name} FILE", f"write the verdicts as {what}", Path) for name, what in _FILES.items()),
    arg(
        "--trajectories DIR|FILE",
        "run nothing; check another system's SEQUENCE.tum or SEQUENCE/RUN.tum, or an evaluation.json, against a "
        "baseline that vislam baseline --trajectories wrote",
        Path,
    ),
    arg("--truth DIR|SEQUENCE=FILE", "of --trajectories, if it is not the baseline's", action="append", default=[]),
    flag("--accept-better", "let results that moved pass unless they are worse"),
    flag("--skip-speed", "do not check time, for example on a machine of another make"),
    arg("--speed-against REVISION|WHEEL", "check time by runs in turn with another version of the code"),
    flag("--allow-other-releases", "compare although GTSAM or NumPy is another release than the baseline's"),
    flag("--verbose", "print every comparison, not only those that fail; files have them all"),
    examples=(
        "vislam baseline drive --estimators dead-reckoning --seeds 5 --duration 2 --out baseline.json",
        "vislam check --baseline baseline.json --skip-speed",
    ),
)
def check(options: argparse.Namespace) -> int:
    """Run again what a baseline lists, on the same measurements, and fail where accuracy, consistency, held-out
    reprojection or speed got worse, an answer moved, or anything is missing. With --trajectories, check files of
    another system in the same way. See docs/gate.md.
    """
    from toolkit.files.writing import check_writable
    from toolkit.report.gate import BEGINNINGS, gate_text, write_check
    from toolkit.report.text import width_of_output

    files = {name: path for name in _FILES if (path := getattr(options, name)) is not None}
    if len({path.resolve() for path in files.values()}) < len(files):
        raise UsageError(f"{' and '.join(f'--{name}' for name in files)} are files of their own; give each its name")
    for name, path in files.items():
        check_writable(path, BEGINNINGS[name])
    checked = _check_of_estimators(options) if options.trajectories is None else _check_of_trajectories(options)
    write_check(checked, files)
    print(gate_text(checked, width_of_output(), verbose=options.verbose))
    return 0 if checked.passed else 1


def _check_of_estimators(options: argparse.Namespace) -> Check:
    from toolkit.cli.progress_display import of_this_process
    from toolkit.experiment.workers import usable_cpus
    from toolkit.gate.baseline import check_releases, load_baseline
    from toolkit.gate.checking import CheckTerms, check

    if options.speed_against and options.skip_speed:
        raise UsageError("--speed-against and --skip-speed exclude each other")
    if options.truth:
        raise UsageError("--truth goes with --trajectories; a baseline of estimators states its own truth")
    baseline = load_baseline(options.baseline)
    if not options.allow_other_releases:
        check_releases(baseline, str(options.baseline))
    terms = CheckTerms(not options.skip_speed, options.accept_better)
    workers = options.workers or usable_cpus()
    return check(baseline, str(options.baseline), workers, of_this_process(), terms, options.speed_against)


def _check_of_trajectories(options: argparse.Namespace) -> Check:
    from toolkit.evaluation.against_baseline import check_trajectories, load_trajectory_baseline

    if options.speed_against:
        raise UsageError("--speed-against measures the time of estimators; with --trajectories nothing runs")
    baseline = load_trajectory_baseline(options.baseline)
    given = _runs_given(options.trajectories, options.truth, [one.sequence for one in baseline.sequences])
    return check_trajectories(baseline, str(options.baseline), given, accept_better=options.accept_better)


def _runs_given(place: Path, truths: Sequence[str], known: Iterable[str] = ()) -> GivenRuns:
    """Return the runs in a folder, with the truths of --truth, or those of an evaluation.json, which has its own."""
    from toolkit.evaluation.against_baseline import EvaluatedRuns, FolderOfRuns, truths_given
    from toolkit.evaluation.gathering import files_by_sequence

    if place.is_dir() or place.suffix != ".json":
        return FolderOfRuns(place, truths_given(truths, {*files_by_sequence(place), *known}))
    if truths:
        raise UsageError(f"--truth goes with a folder of trajectories; {place} was scored against its own")
    return EvaluatedRuns(place)
