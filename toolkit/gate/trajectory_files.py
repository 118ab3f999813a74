"""Trajectory files of any system against the truth: found by sequence, matched in time, scored. Nothing is run.

A folder has, for each sequence, one file (``V1_01.tum``) or a folder of repeated runs (``V1_01/run-1.tum`` ...). A
trajectory may have a pose for every frame or for keyframes alone: each pose is compared with the truth at its own
stamp, and the *time coverage* says how much of the truth's time the poses span without a longer gap than is allowed.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from toolkit.datasets.trajectories import read_poses
from toolkit.datasets.trajectories.belonging import check_axes, check_mirrored, range_s
from toolkit.datasets.trajectories.formats import check_order
from toolkit.errors import DataError, printable
from toolkit.files.reading import unreadable
from toolkit.geometry import Array, IntArray
from toolkit.measurements import NS_PER_S
from toolkit.metrics import Unavailable
from toolkit.metrics.ate import position_rmse, rotation_rmse_deg
from toolkit.metrics.parts.against_truth import (
    Alignment,
    Matched,
    distance_along,
    fit_se3,
    fit_sim3,
    fit_yaw,
    median_period_ns,
    poses_at,
)
from toolkit.metrics.rpe import hundred_metres_percent
from toolkit.sequence import content_digest

Align = Literal["se3", "yaw", "sim3"]
TIME_COVERAGE = "time_coverage_percent"
SUFFIXES = (".tum", ".txt", ".csv")
_FITS: Mapping[Align, Callable[[Array, Array], Alignment]] = {"se3": fit_se3, "yaw": fit_yaw, "sim3": fit_sim3}
# Of the hash of a truth file's content: significant digits that are hashed, hexadecimal digits that are kept.
_DIGITS, _LENGTH = 9, 16


@dataclass(frozen=True, eq=False)
class Poses:
    """Poses (N, 4, 4) of a file on their stamps (N,) ns."""

    path: Path
    t_ns: IntArray
    poses: Array

    @property
    def digest(self) -> str:
        """Return a hash of the content, which another way to print it does not change."""
        return content_digest((self.t_ns, self.poses), _DIGITS)[:_LENGTH]


@dataclass(frozen=True)
class Scoring:
    """How to score: the alignment of the positions, and the longest gap (s) between poses that counts as covered."""

    align: Align = "se3"
    gap_s: float = 5.0

    @property
    def metrics(self) -> tuple[str, ...]:
        """Return what is scored; a scale that is fitted leaves no drift in metres to speak of."""
        drift = () if self.align == "sim3" else ("rpe_100m_percent",)
        return (f"ate_{self.align}_m", "ate_se3_deg", *drift, TIME_COVERAGE)


def files_by_sequence(folder: Path) -> dict[str, tuple[Path, ...]]:
    """Return the trajectory files of each sequence in a folder; raises DataError where there are none."""
    if not folder.is_dir():
        raise DataError(f"{folder}: it is no folder; give one that has SEQUENCE.tum or SEQUENCE/RUN.tum")
    found: dict[str, tuple[Path, ...]] = {}
    for path in _entries(folder):
        files = trajectory_files(path) if path.is_dir() else (path,) if _is_file(path) else ()
        name = printable(path.name if path.is_dir() else path.stem)
        if files and name in found:
            raise DataError(f"{folder}: {name} is given twice, as {found[name][0].name} and {path.name}; keep one")
        if files:
            found[name] = files
    if not found:
        raise DataError(f"{folder}: no SEQUENCE.tum and no SEQUENCE/RUN.tum in it ({', '.join(SUFFIXES)} are read)")
    return found


def trajectory_files(folder: Path) -> tuple[Path, ...]:
    """Return the trajectory files that are directly in a folder, by name; raises DataError where it cannot be read."""
    return tuple(filter(_is_file, _entries(folder)))


def _entries(folder: Path) -> list[Path]:
    try:
        return sorted(folder.iterdir())
    except OSError as error:
        raise DataError(unreadable(folder, error)) from error


def _is_file(path: Path) -> bool:
    return path.is_file() and path.suffix in SUFFIXES and not path.name.startswith(".")


def read_stamped(path: Path, truth: Poses | None = None) -> Poses:
    """Read a trajectory file with stamps; raises DataError, in one line with the remedy, where it is none.

    Beside the truth one that is mirrored is named as that, and not for what this does to its quaternions.
    """
    file = read_poses(path)
    if file.t_ns is None:
        raise DataError(
            f"{path}: a {file.format} file has no stamps, so its poses cannot be matched with the truth; write TUM"
        )
    poses = Poses(path, file.t_ns, file.T_world_imu)
    if truth is not None and len(file):
        matched = matched_poses(poses, truth)
        check_mirrored(str(path), matched.truth, matched.estimate)
    if file.other_order is not None:
        check_order(path, file.T_world_imu, file.other_order)
    return poses


def scores(estimate: Poses, truth: Poses, scoring: Scoring) -> dict[str, float | None]:
    """Return the metrics of a trajectory, None where one cannot be computed.

    Raises DataError where no two of its poses meet the truth in time, or they do in exchanged axes alone.
    """
    matched = matched_poses(estimate, truth)
    alone = next((poses.path for poses in (estimate, truth) if poses.t_ns.size < 2), None)
    if alone is not None:
        raise DataError(f"{alone}: it has one pose, and errors are of two and more; write the whole trajectory")
    if len(matched) < 2:
        raise DataError(
            f"{estimate.path}: {len(matched)} of its poses match the truth in time; it covers "
            f"{range_s(estimate.t_ns)}, the truth {range_s(truth.t_ns)}: write the stamps of the truth's clock, in "
            "seconds"
        )
    check_axes(str(estimate.path), matched.truth, matched.estimate)
    fit = _FITS[scoring.align]
    computed: dict[str, Callable[[], float]] = {
        f"ate_{scoring.align}_m": lambda: position_rmse(matched, fit(*matched.positions)),
        "ate_se3_deg": lambda: rotation_rmse_deg(matched, fit_se3(*matched.positions)),
        "rpe_100m_percent": lambda: hundred_metres_percent(matched),
        TIME_COVERAGE: lambda: time_coverage_percent(estimate.t_ns, truth.t_ns, scoring.gap_s),
    }
    return {key: _unless_unavailable(computed[key]) for key in scoring.metrics}


def time_coverage_percent(t_ns: IntArray, truth_t_ns: IntArray, gap_s: float) -> float:
    """Return the percentage of the truth's time (N,) ns that lies between stamps (n,) ns at most ``gap_s`` apart.

    Keyframes that are seconds apart cover the time between them; a lost track does not. What precedes the first pose
    and follows the last one is not covered.
    """
    begin, end = int(truth_t_ns[0]), int(truth_t_ns[-1])
    within = np.clip(t_ns, begin, end)
    gaps = np.diff(within)
    covered = float(gaps[np.diff(t_ns) <= gap_s * NS_PER_S].sum())
    return 100.0 * covered / max(end - begin, 1)


def matched_poses(estimate: Poses, truth: Poses) -> Matched:
    """Return the pairs on the stamps of the sparser of the two, between whose neighbours the other is interpolated."""
    path_m = distance_along(truth.poses[:, :3, 3])
    truth_period_ns, period_ns = median_period_ns(truth.t_ns), median_period_ns(estimate.t_ns)
    if truth_period_ns > period_ns:
        met, poses = poses_at(estimate.t_ns, estimate.poses, truth.t_ns, period_ns)
        return Matched(truth.t_ns[met], truth.poses[met], poses, path_m[met])
    met, true = poses_at(truth.t_ns, truth.poses, estimate.t_ns, truth_period_ns)
    t_ns = estimate.t_ns[met]
    return Matched(t_ns, true, estimate.poses[met], np.interp(t_ns, truth.t_ns, path_m))


def _unless_unavailable(compute: Callable[[], float]) -> float | None:
    try:
        with np.errstate(all="ignore"):  # a value that is not finite becomes None
            value = compute()
    except Unavailable:
        return None
    return value if np.isfinite(value) else None
