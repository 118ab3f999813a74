"""``vislam report``, ``export``, ``diff`` and ``reproduce``: what is done with run directories."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from toolkit.cli.arguments import COV_CONVENTIONS, WORKERS, UsageError, arg, choice, command, flag, names, output
from toolkit.errors import printable

if TYPE_CHECKING:
    from toolkit.report.differences import DiffRecord
    from toolkit.report.export import BundleRecord

_PAGE = "report.html"
# Repeated from toolkit.datasets.trajectories.FORMATS (a test compares them), which would cost the help half a second.
FORMATS = ("tum", "kitti", "euroc", "openvins")
_MOST_PACKAGES = 12
_RUN = "as vislam compare writes it"


@command(
    "report",
    "show run directories as one interactive HTML page",
    arg("runs RUN_DIR", _RUN, Path, nargs="+"),
    arg("--out FILE", f"the page (default: {_PAGE} in the run directory; ./{_PAGE} for several)", Path),
    examples=(
        "vislam compare drive --estimators dead-reckoning,ekf --max-frames 40 --out runs/drive",
        "vislam report runs/drive",
    ),
)
def report(options: argparse.Namespace) -> int:
    """Write one HTML file that opens from disk, with all it needs inside: the table, the trajectories from above
    and in three dimensions, errors, consistency, time, and what to know in words. Several run directories are laid
    side by side; a folder of run directories stands for all of them.
    """
    from toolkit.report.html import write_html
    from toolkit.report.run_directory import runs_in

    target = options.out
    if target is None:
        target = options.runs[0] / _PAGE if len(options.runs) == 1 else Path(_PAGE)
    write_html([run for folder in options.runs for run in runs_in(folder)], target)
    print(printable(f"report: {target}"))
    return 0


@command(
    "export",
    "write a trajectory of a run directory in another program's format, or a bundle",
    arg("run RUN_DIR", _RUN, Path),
    arg("--estimator NAME", "an estimator, or truth (default: the only one there is)"),
    choice("--output", ("causal", "final"), "default: final, where there is one"),
    choice("--format", FORMATS, "of the file; KITTI has no stamps"),
    choice("--cov-convention NAME", COV_CONVENTIONS, f"write covariances, too ({', '.join(COV_CONVENTIONS)})"),
    arg("--out FILE", "the file to write", Path),
    arg("--bundle FILE.zip", "write all of the run but its figures as one file for vislam reproduce", Path),
    examples=(
        "vislam compare drive --estimators dead-reckoning --max-frames 40 --out runs/drive",
        "vislam export runs/drive --format kitti --out drive.kitti",
        "vislam export runs/drive --bundle drive.zip",
    ),
)
def export(options: argparse.Namespace) -> int:
    """Write a trajectory of a run directory as a TUM, KITTI, EuRoC or OpenVINS file. Poses are those of the IMU in
    the estimator's world; nothing is aligned. Or bundle what others need to repeat the run.
    """
    from toolkit.datasets.trajectories.covariances import convention_called
    from toolkit.report.export import export, write_bundle

    if options.bundle is not None:
        if any((options.format, options.out, options.estimator, options.output, options.cov_convention)):
            raise UsageError("--bundle goes without any other option: it has everything")
        print(printable(f"{options.bundle}: {write_bundle(options.run, options.bundle)}"))
        return 0
    if options.format is None or options.out is None:
        raise UsageError("give --format and --out for a trajectory, or --bundle (see vislam export --help)")
    convention = None if options.cov_convention is None else convention_called(options.cov_convention)
    written = export(options.run, options.out, options.format, options.estimator, options.output, convention)
    print(printable(f"{options.out}: {written}"))
    return 0


@command(
    "diff",
    "show what differs between two run directories",
    arg("before RUN_A", _RUN, Path),
    arg("after RUN_B", "the run directory to compare with it", Path),
    arg("--columns KEY,...", "metrics to show, or all (default: the tables')", names, default=()),
    flag("--json", "print every metric and difference as JSON"),
    examples=(
        "vislam compare drive --estimators ekf --max-frames 40 --out runs/before",
        "vislam compare drive --estimators ekf --max-frames 40 --set noise.motion_scale=1.2 --out runs/after",
        "vislam diff runs/before runs/after",
    ),
)
def diff(options: argparse.Namespace) -> int:
    """Tell what differs between two run directories: settings, versions, data, how runs ended, and the metrics that
    moved; over seeds also which of them moved by more than chance.
    """
    from toolkit.files.documents import to_text
    from toolkit.metrics import known_metrics, metrics_called
    from toolkit.report.differences import diff_text, differences
    from toolkit.report.run_directory import read_run
    from toolkit.report.text import width_of_output

    columns = known_metrics() if options.columns == ("all",) else metrics_called(options.columns)
    found = differences(read_run(options.before), read_run(options.after))
    if options.json:
        print(to_text(found), end="")
    else:
        print(diff_text(found, columns, width_of_output()))
    return 0


@command(
    "reproduce",
    "repeat the run of a bundle and show what differs",
    arg("bundle BUNDLE", "as vislam export --bundle writes it", Path),
    arg("--data SEQUENCE", "path of the recording here, if it is not the bundle's"),
    arg("--out DIR", "keep the new run directory (default: it is not kept)", Path),
    output("every difference as JSON, and nothing else"),
    WORKERS,
    examples=(
        "vislam compare drive --estimators dead-reckoning --max-frames 40 --out runs/drive",
        "vislam export runs/drive --bundle drive.zip",
        "vislam reproduce drive.zip",
    ),
)
def reproduce(options: argparse.Namespace) -> int:
    """Run again, with the settings in a bundle that vislam export --bundle made, and tell what differs: versions,
    data, how runs ended, metrics. Exits 1 where a result but time and memory is another one.
    """
    import tempfile

    from msgspec.structs import replace

    from toolkit.cli import parser
    from toolkit.files.documents import to_text
    from toolkit.report.differences import differences
    from toolkit.report.export import unpack_bundle
    from toolkit.report.run_directory import MANIFEST, read_run

    with tempfile.TemporaryDirectory(prefix="vislam-") as folder:
        there = Path(folder) / "there"
        record = unpack_bundle(options.bundle, there)
        before = read_run(there)
        out = Path(folder) / "here" if options.out is None else options.out
        sequence = [] if options.data is None else [options.data]
        workers = [] if options.workers is None else ["--workers", str(options.workers)]
        words = ["compare", *sequence, "--config", str(there / MANIFEST), "--out", str(out), *workers, "--quiet"]
        requested = parser().parse_args(words)
        requested.command_line = ["vislam", *words]
        requested.command(requested)
        found = replace(differences(before, read_run(out)), before=str(options.bundle), after=str(out))
    if options.json:
        print(to_text(found), end="")
    elif not options.quiet:
        _print(found, record, options.bundle)
    return 0 if found.same_results else 1


def _print(found: DiffRecord, record: BundleRecord, bundle: Path) -> None:
    from toolkit.report.differences import diff_text
    from toolkit.report.export import installed_packages
    from toolkit.report.text import width_of_output

    here = installed_packages()
    others = [f"{name} {release}" for name, release in record.packages.items() if here.get(name) != release]
    print(diff_text(found, width=width_of_output()))
    if others:
        more = f" and {len(others) - _MOST_PACKAGES} more" if len(others) > _MOST_PACKAGES else ""
        print(printable(f"not installed here in the bundle's release: {', '.join(others[:_MOST_PACKAGES])}{more}"))
    print(printable(f"{bundle}: {'reproduced' if found.same_results else 'not reproduced: what differs is above'}"))
