"""``vislam sweep``: how estimators change along settings and planted faults, and where they break."""

from __future__ import annotations

import argparse
import shlex
from pathlib import Path

from toolkit.cli.arguments import WORKERS, UsageError, arg, command, estimators, flag, output
from toolkit.cli.compare import HOW, SCHEDULER, kept_where, new_run, requested_configuration
from toolkit.errors import printable


def over(text: str) -> tuple[str, tuple[str, ...]]:
    """Parse NAME=V1,V2,..., a setting or a fault and its values."""
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
    arg("--truth FILE.tum", "ground truth"),
    arg(
        "--out DIR",
        "run directory (default: runs/<date and time>); every run is kept there as it ends, and the same command "
        "continues where it stopped",
        Path,
    ),
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
    from toolkit.cli.progress_display import of_this_process, print_above
    from toolkit.experiment.configuration import SweepRequest, plan_of, read_sweep_request
    from toolkit.experiment.sweep import run_sweep
    from toolkit.files.documents import to_line
    from toolkit.report.figures.sweeps import draw_sweep
    from toolkit.report.sweep import check_sweep_directory, sweep_text, write_sweep
    from toolkit.settings.reading import assigned

    requested = SweepRequest() if options.config is None else read_sweep_request(options.config)
    axes = {name: [assigned(f"{name}={value}")[1] for value in values] for name, values in options.over}
    if len(axes) < len(options.over):
        raise UsageError("--over names the same twice; give all its values at once")
    options.sequences = None if options.sequence is None else [options.sequence]
    plan = plan_of(requested_configuration(options), (), workers=options.workers, scheduler=options.scheduler)
    if not plan.sources:
        raise UsageError("name the sequence to sweep, a path or a built-in name as drive")
    target, progress_for = options.out or new_run(), of_this_process()
    check_sweep_directory(target)
    with kept_where(target):
        found = run_sweep(
            plan,
            axes or requested.over,
            crossed=not (options.each or requested.each),
            directory=target,
            progress_for=progress_for,
        )
    with progress_for(f"{found.grid.case.name}: figures"):
        document = write_sweep(found, target, shlex.join(options.command_line), list(draw_sweep(found)))
    if options.json:
        print_above(to_line(document).rstrip())
    elif not options.quiet:
        where = printable(str(target))
        print_above(f"{sweep_text(document)}\n\nresults: {where}; as a page: vislam report {shlex.quote(where)}")
    return 0
