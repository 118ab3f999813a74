"""What leaving out what moves is worth among vehicles: errors with and without ``tracks.leave_out_moving``.

    python tests/benchmarks/moving_objects.py results.jsonl [--seeds 3] [--shares 0,0.3,0.6] [--estimators ekf,batch]

A share of the points of simulated scenes drives along the camera's course (``faults.moving_vehicles``). Each run
is one line of the results, RMSE of the final position in m, none where the estimator failed; one that is there is not
made again. The table printed at the end has, for each scene, share and estimator, the means over seeds and the mean
ratio with its standard error.
"""

import argparse
import json
from collections import defaultdict
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from toolkit.measurements import Prior
from toolkit.models.moving_tracks import without_moving_tracks
from toolkit.registry import find
from toolkit.runner import run
from toolkit.sequence import Sequence
from toolkit.simulation import DRIVE, DRIVE_IMU, FLIGHT, simulate
from toolkit.simulation.faults import moving_vehicles

SCENES = {
    "drive": replace(DRIVE, duration_s=12.0),
    "drive-imu": replace(DRIVE_IMU, duration_s=12.0),
    "flight": replace(FLIGHT, duration_s=8.0),
}


def error_m(estimator: str, sequence: Sequence, prior: Prior) -> float | None:
    """Return the RMSE of an estimator's final position, m, without any alignment; None where it has none."""
    final, truth = run(estimator, find(estimator).load(), sequence, prior).final, sequence.truth
    if final is None or truth is None:
        return None
    off_m = final.T_world_imu[:, :3, 3] - truth.T_world_imu[np.searchsorted(truth.t_ns, final.t_ns), :3, 3]
    return float(np.sqrt((off_m**2).sum(axis=1).mean()))


def make(options: argparse.Namespace) -> None:
    """Make the runs whose lines are missing."""
    done = {(one["scene"], one["share"], one["seed"], one["estimator"]) for one in lines(options.results)}
    for seed in range(options.first_seed, options.first_seed + options.seeds):
        for name, scene in SCENES.items():
            for share in options.shares:
                among = moving_vehicles(simulate(scene, seed), share, seed)
                assert among.prior is not None
                left, counts = without_moving_tracks(among, among.prior)
                for estimator in options.estimators:
                    if (name, share, seed, estimator) in done:
                        continue
                    line = {"scene": name, "share": share, "seed": seed, "estimator": estimator}
                    line["left_out"] = counts.sightings / counts.of_sightings
                    line |= {"all": error_m(estimator, among, among.prior)}
                    line |= {"rest": error_m(estimator, left, among.prior)}
                    with options.results.open("a") as stream:
                        stream.write(json.dumps(line) + "\n")


def lines(path: Path) -> list[dict[str, Any]]:
    """Return the lines of the results so far."""
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


def show(path: Path) -> None:
    """Print means over seeds, and the mean ratio with its standard error."""
    found: dict[tuple[str, float, str], list[dict[str, Any]]] = defaultdict(list)
    for line in lines(path):
        found[line["scene"], line["share"], line["estimator"]].append(line)
    for (scene, share, estimator), of_seeds in found.items():
        whole = [line for line in of_seeds if line["all"] is not None and line["rest"] is not None]
        logs = np.log([line["rest"] / line["all"] for line in whole])
        spread = logs.std(ddof=1) / np.sqrt(len(logs)) if len(logs) > 1 else np.nan
        before, after = (np.mean([line[key] for line in whole]) for key in ("all", "rest"))
        left_out = np.mean([line["left_out"] for line in of_seeds])
        print(
            f"{scene:10s} {share:4.2f} {estimator:12s} {left_out:6.1%} left out  {before:.3f} -> {after:.3f} m  "
            f"x{np.exp(logs.mean()):.2f} +- {np.exp(logs.mean()) * spread:.2f}  {len(whole)} of {len(of_seeds)} seeds"
        )


def main() -> None:
    """Run and show."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("results", type=Path)
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--shares", type=lambda text: [float(one) for one in text.split(",")], default=[0.0, 0.3, 0.6])
    parser.add_argument(
        "--estimators", type=lambda text: text.split(","), default=["ekf", "msckf-slam", "fixed-lag", "batch"]
    )
    options = parser.parse_args()
    make(options)
    show(options.results)


if __name__ == "__main__":
    main()
