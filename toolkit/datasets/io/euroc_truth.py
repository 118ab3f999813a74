"""The ground truth of a EuRoC recording: found beside the sensors, read in its dialects, and chosen by the gyro.

Of V1_01_easy two truths are in use: the original, whose orientation is off by degrees, and one computed again from
the motion capture and the IMU (Geneva & Huang, "vicon2gt", 2020). Names do not tell them apart; the gyro does.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from toolkit.datasets.io.asl_table import columns_of, read_table
from toolkit.datasets.io.euroc_calibration import extrinsic
from toolkit.datasets.io.opencv_yaml import read_fields
from toolkit.datasets.io.truth_choice import rate_scatter_radps
from toolkit.datasets.io.truth_file import load_truth
from toolkit.datasets.trajectories.poses import checked_poses
from toolkit.errors import DataError
from toolkit.geometry import se3_inverse
from toolkit.sequence import ImuSamples, Truth

_AXES = "xyz"
# Position, quaternion, velocity, gyro bias and accelerometer bias, in the data set's words and in vicon2gt's.
_HEADINGS = (
    (
        tuple(f"p_RS_R_{a}" for a in _AXES) + tuple(f"q_RS_{a}" for a in "xyzw"),
        tuple(f"{name}_{a}" for name in ("v_RS_R", "b_a_RS_S", "b_w_RS_S") for a in _AXES),
    ),
    (
        tuple(f"p{a}" for a in _AXES) + tuple(f"q{a}" for a in "xyzw"),
        tuple(f"{name}{a}" for name in ("v", "ba", "bw") for a in _AXES),
    ),
)


@dataclass(frozen=True, eq=False)
class Choice:
    """The truth to use, and in words which it is and why."""

    truth: Truth
    reason: str


def choose_truth(root: Path, mav0: Path | None, imu: ImuSamples) -> Choice:
    """Return the truth of a recording; of several, the one that turns most nearly as the gyro says.

    Raises DataError where there is none, for without it no stereo tracks can be simulated, or one is damaged.
    """
    found = {path: _read(path, mav0) for path in _tables(root, mav0)}
    if not found:
        raise DataError(
            f"{root}: no ground truth in mav0/state_groundtruth_estimate0/data.csv or a .csv or .tum table beside it, "
            "and the stereo tracks are simulated along it; add the truth"
        )
    scatter = {path: rate_scatter_radps(truth, imu) for path, truth in found.items()}
    ranked = sorted(scatter.items(), key=lambda item: item[1])
    best, least = ranked[0]
    if not np.isfinite(least):
        raise DataError(f"{best}: the truth and the IMU share no 0.2 s; check that both are of one recording and clock")
    told = "; ".join(f"{path.relative_to(root)} by {radps:.4f} rad/s" for path, radps in ranked)
    among = "" if len(ranked) == 1 else ", the better of what the folder holds"
    return Choice(found[best], f"the truth is {best.relative_to(root)}{among} (rates RMS off the gyro's: {told})")


def _tables(root: Path, mav0: Path | None) -> list[Path]:
    inside = [] if mav0 is None else [mav0 / "state_groundtruth_estimate0" / "data.csv"]
    beside = [path for path in sorted(root.glob("*.csv")) if _heading(path) is not None]
    return [*(path for path in inside if path.is_file()), *beside, *sorted(root.glob("*.tum"))]


def _heading(path: Path) -> tuple[tuple[str, ...], tuple[str, ...]] | None:
    columns = columns_of(path)
    return next((heading for heading in _HEADINGS if columns.keys() >= set(heading[0])), None)


def _read(path: Path, mav0: Path | None) -> Truth:
    truth = load_truth(path) if path.suffix == ".tum" else _read_csv(path)
    sensor_yaml = path.parent / "sensor.yaml"
    if mav0 is None or path.parent.parent != mav0 or not sensor_yaml.is_file():
        return truth
    T_sensor_imu = se3_inverse(extrinsic(read_fields(sensor_yaml))) @ extrinsic(read_fields(mav0 / "imu0/sensor.yaml"))
    if np.array_equal(T_sensor_imu, np.eye(4)):
        return truth
    # Velocity and biases are the tracked sensor's own, not the IMU's.
    return Truth(truth.t_ns, truth.T_world_imu @ T_sensor_imu)


def _read_csv(path: Path) -> Truth:
    """Read poses and, where all are there, velocities and biases; stamps stay whole numbers."""
    pose, rest = _heading(path) or _HEADINGS[0]
    complete = columns_of(path).keys() >= set(rest)
    table = read_table(path, pose + rest if complete else pose)
    T_world_imu = checked_poses(path, list(range(2, len(table.t_ns) + 2)), table.t_ns, table.values[:, :7])
    if not complete:
        return Truth(table.t_ns, T_world_imu)
    return Truth(table.t_ns, T_world_imu, table.values[:, 7:10], table.values[:, 10:16])
