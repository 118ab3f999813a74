"""``vislam explain``: what makes one estimator more accurate than another."""

from __future__ import annotations

import argparse
import shlex
from pathlib import Path

from toolkit.cli.arguments import PART, WORKERS, arg, command, names, output, seconds_from_start
from toolkit.cli.compare import HOW, SCHEDULER, kept_where, new_run, requested_configuration
from toolkit.errors import printable


@command(
    "explain",
    "say what makes one estimator more accurate than another, ingredient by ingredient",
    arg("sequence SEQUENCE", "a recording's path, or a built-in name"),
    arg("--from NAME", "the first estimator (default: the lowest rung of those compared by default)", dest="start_at"),
    arg("--to NAME", "the second estimator (default: the highest rung of those)", dest="goal"),
    arg(
        "--estimators NAME,...",
        "those whose variants may lie between the two; my_filter.py is a file of your own (default: all installed)",
        names,
    ),
    arg("--truth FILE.tum", "ground truth"),
    arg(
        "--out DIR",
        "run directory (default: runs/<date and time>); every run is kept there as it ends, and the same command "
        "continues where it stopped",
        Path,
    ),
    arg(
        "--since TIME",
        "leave out frames before it, after the first frame, as in 10s",
        seconds_from_start,
        dest="from_s",
    ),
    arg("--until TIME", "leave out frames after it, after the first frame, as in 10s", seconds_from_start, dest="to_s"),
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
    added to the first alone, and lost where the second lacks it; with 95 % intervals over seeds, or over stretches of
    a recording. docs/explain.md tells how.
    """
    from toolkit.cli.progress_display import of_this_process, print_above
    from toolkit.experiment.configuration import plan_of
    from toolkit.experiment.explanation import default_ends, run_explanation
    from toolkit.files.documents import to_line
    from toolkit.registry import discover
    from toolkit.report.explanation import check_explanation_directory, explanation_text, write_explanation
    from toolkit.report.text import width_of_output

    options.sequences = [options.sequence]
    options.estimators = options.estimators or tuple(discover())
    plan = plan_of(requested_configuration(options), (), workers=options.workers, scheduler=options.scheduler)
    usual = default_ends()
    ends = options.start_at or usual[0], options.goal or usual[1]
    target, progress_for = options.out or new_run(), of_this_process()
    check_explanation_directory(target)
    with kept_where(target):
        found = run_explanation(plan, *ends, target, progress_for)
    with progress_for(f"{found.grid.case.name}: figure"):
        document = write_explanation(found, target, shlex.join(options.command_line))
    if options.json:
        print_above(to_line(document).rstrip())
    elif not options.quiet:
        where = printable(str(target))
        shown = explanation_text(document, width_of_output())
        print_above(f"{shown}\n\nresults: {where}; as a page: vislam report {shlex.quote(where)}")
    return 0
