"""``vislam explain`` and ``sweep``: estimators on one recording under many settings or faults, in a grid of trials."""

from __future__ import annotations

import argparse
import shlex
from functools import partial
from typing import TYPE_CHECKING

from toolkit.cli.arguments import (
    HOW,
    OUT,
    PART,
    SCHEDULER,
    TRUTH,
    WORKERS,
    UsageError,
    arg,
    command,
    estimators,
    flag,
    names,
    output,
    seconds_from_start,
)
from toolkit.cli.compare import kept_where, new_run, requested, tell_unusable
from toolkit.errors import printable

if TYPE_CHECKING:
    from collections.abc import Callable
    from typing import Any

    from toolkit.experiment.explanation import Explanation
    from toolkit.experiment.sweep import Sweep
    from toolkit.report.run_directory import Results


@command(
    "explain",
    "say what makes one estimator more accurate than another, ingredient by ingredient",
    arg("sequence SEQUENCE", "a recording's path, or a built-in name"),
    arg(
        "--from NAME",
        "the first estimator (default: the lowest with INGREDIENTS of those compared by default)",
        dest="start_at",
    ),
    arg("--to NAME", "the second estimator (default: the highest of those)", dest="goal"),
    arg(
        "--estimators NAME,...",
        "those that may be run between the two, with and without ingredients, or files (default: all)",
        names,
    ),
    TRUTH,
    OUT,
    arg("--since TIME", "leave out frames before it, as in 10s", seconds_from_start, dest="from_s"),
    arg("--until TIME", "leave out frames after it, as in 10s", seconds_from_start, dest="to_s"),
    *(one for one in HOW if one not in PART[:2]),
    WORKERS,
    SCHEDULER,
    output("what explain.json holds, no table", "the run directory has everything"),
    examples=(
        "vislam explain drive --from ekf --to ekf-slam --until 3s --estimators ekf,ekf-slam --out runs/why",
        "vislam report runs/why",
    ),
)
def explain(options: argparse.Namespace) -> int:
    """Run what lies between two estimators on one recording, and say what each ingredient in which they differ brings:
    added as near to the first as can be, and taken away as near to the second; with 95 % intervals over 3 seeds or
    more, or over stretches of a recording. docs/explain.md tells how.
    """
    from toolkit.experiment.configuration import plan_of
    from toolkit.experiment.explanation import default_ends, run_explanation
    from toolkit.registry import discover
    from toolkit.report.explanation import EXPLANATIONS

    options.sequences = [options.sequence]
    options.estimators = options.estimators or tuple(discover())
    plan = plan_of(*requested(options), (), workers=options.workers, scheduler=options.scheduler)
    usual = default_ends()
    ends = options.start_at or usual[0], options.goal or usual[1]
    return _carried_out(EXPLANATIONS, partial(run_explanation, plan, *ends), options)


def over(text: str) -> tuple[str, tuple[str, ...]]:
    name, equals, values = text.partition("=")
    given = tuple(value.strip() for value in values.split(",") if value.strip())
    if not (equals and name.strip() and given):
        raise argparse.ArgumentTypeError(f"expected KEY=V1,V2,... or fault:NAME=D1,D2,..., not {text!r}")
    return name.strip(), given


@command(
    "sweep",
    "vary settings or plant faults in doses, and see where estimators break",
    arg("sequence SEQUENCE", "a recording's path, or a built-in name", nargs="?"),
    arg(
        "--over KEY=V1,V2,...",
        "vary a setting (see 'vislam list settings'), or plant fault:NAME in doses (see 'vislam list injectors'); two "
        "are crossed, every value with every other",
        over,
        action="append",
        default=[],
    ),
    flag("--each", "vary each of several by itself, and cross none", default=None),
    estimators("estimators to run, see 'vislam list estimators'"),
    TRUTH,
    OUT,
    *HOW,
    WORKERS,
    SCHEDULER,
    output("what sweep.json holds, no table", "the run directory has everything"),
    examples=(
        "vislam sweep drive --over fault:dropped_frames=0.3,0.8 --estimators dead-reckoning,ekf --seeds 2 --to 3s "
        "--out runs/sweep",
    ),
)
def sweep(options: argparse.Namespace) -> int:
    """Run estimators on one recording at every value of a setting, or with a fault planted in every dose of it, over
    seeds, and tell how their errors compare with those without: a table with 95 % intervals, the dose at which each
    breaks, what the audit would have said, and figures.
    """
    from toolkit.experiment.configuration import SweepRequest, plan_of, read_sweep_request
    from toolkit.experiment.sweep import run_sweep
    from toolkit.report.sweep import SWEEPS
    from toolkit.settings.reading import assigned

    asked = SweepRequest() if options.config is None else read_sweep_request(options.config)
    axes = {name: [assigned(f"{name}={value}")[1] for value in values] for name, values in options.over}
    if len(axes) < len(options.over):
        raise UsageError("--over names the same twice; give all its values at once")
    options.sequences = None if options.sequence is None else [options.sequence]
    plan = plan_of(*requested(options), (), workers=options.workers, scheduler=options.scheduler)
    if not plan.sources:
        raise UsageError("name the sequence to sweep, a path or a built-in name as drive")
    crossed = not (options.each or asked.each)
    return _carried_out(SWEEPS, partial(run_sweep, plan, axes or asked.over, crossed=crossed), options)


def _carried_out(kind: Results[Any, Any], run: Callable[..., Sweep | Explanation], options: argparse.Namespace) -> int:
    """Run what keeps its outcomes in a directory, and write and tell what was found."""
    from toolkit.cli.progress_display import of_this_process, print_above
    from toolkit.files.documents import to_line
    from toolkit.report.text import width_of_output

    target, progress_for = options.out or new_run(), of_this_process()
    kind.check(target)
    with kept_where([target]):
        found = run(directory=target, progress_for=progress_for)
    with progress_for(f"{found.grid.case.name}: figures"):
        document = kind.write(found, target, shlex.join(options.command_line))
    tell_unusable(found.grid.unusable, target)
    where = printable(str(target))
    if options.json:
        print_above(to_line(document).rstrip())
    elif not options.quiet:
        text = kind.text(document, width_of_output())
        print_above(f"{text}\n\nresults: {where}; as a page: vislam report {shlex.quote(where)}")
    return 0
