"""A trajectory of a run directory in another program's format."""

from pathlib import Path

from toolkit.datasets.trajectories import FORMATS, tum
from toolkit.errors import DataError, did_you_mean
from toolkit.estimate import Output, Trajectory
from toolkit.files import write_text
from toolkit.report.records import Report
from toolkit.report.run_files import SeedsFiles, read_run

TRUTH = "truth"


def export(directory: Path, estimator: str | None, output: Output | None, format_name: str, target: Path) -> str:
    """Write a trajectory of a run directory as a file and return in words which it is.

    Without an estimator there must be only one; ``truth`` is the ground truth. Without an output it is the final
    one, where there is one. Raises DataError where there is no such trajectory or the format cannot hold it,
    OutputError where the file cannot be written.
    """
    run = read_run(directory)
    if isinstance(run, SeedsFiles):
        raise DataError(
            f"{directory} is a comparison over seeds and holds no trajectories; run one seed without --seeds"
        )
    what, name = _chosen(directory, run.report, estimator, output)
    trajectory = tum.read(directory / name, "a run that diverged may leave no finite pose")
    if format_name == "kitti":
        _check_every_frame(what, trajectory, run.scores.sequence.frames)
    text = FORMATS[format_name].text(trajectory)
    write_text(target, text)
    return f"{what}, {len(trajectory)} poses"


def _chosen(directory: Path, report: Report, estimator: str | None, output: Output | None) -> tuple[str, str]:
    """Return in words which trajectory is meant, and its file in the run directory."""
    if estimator == TRUTH:
        if report.truth is None:
            raise DataError(f"{directory} has no ground truth")
        return TRUTH, report.truth
    files = {(run.estimator, run.output): run.trajectory for run in report.runs if run.trajectory}
    names = list(dict.fromkeys(name for name, _ in files))
    there = ", ".join([*names, *([TRUTH] if report.truth is not None else [])])
    if estimator is None and len(names) != 1:
        raise DataError(f"{directory} holds several trajectories; choose one with --estimator: {there}")
    name = names[0] if estimator is None else estimator
    if name not in names:
        raise DataError(f"{directory} has no trajectory of {name}{did_you_mean(name, names)}; there are {there}")
    outputs = [given for known, given in files if known == name]
    wanted = outputs[-1] if output is None else output
    if wanted not in outputs:
        raise DataError(f"{directory} has no {wanted} trajectory of {name}, only a {outputs[0]} one")
    return f"{name} {wanted}", files[name, wanted]


def _check_every_frame(what: str, trajectory: Trajectory, frames: int) -> None:
    if len(trajectory) != frames:
        raise DataError(
            f"{what} has {len(trajectory)} poses for {frames} frames, and KITTI's rows are the frames; "
            "choose a format with stamps"
        )
