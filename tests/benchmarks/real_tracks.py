"""How well estimators do on real tracks under the measured noise, or under noises that are set.

    python tests/benchmarks/real_tracks.py run results.jsonl [--estimators batch,smart] [--models auto/full] [--seeds 3]
    python tests/benchmarks/real_tracks.py table results.jsonl

Seven KITTI drives tracked by KLT (folder ``utias`` of the data), whose twists are those of the instrument that gives
the truth: white noise is added to them, so that there is something to estimate. And drive 0027 of the folder ``ucsd``,
whose twists are noisy as they are. Each run is one line of the results, and one that is there is not made again.

The table has, for each estimator and model, the geometric mean over drives of the ATE over that of dead reckoning (the
mean over seeds of either), and the figures of 0027. ``<model>`` is ``auto`` (the measured noise), ``full`` (every
sighting counts in full) or a weight of tracks as ``0.04``; ``+open`` behind it improves no twist where no track leads
on, ``+robust`` and the other outlier policies' names are the policy.
"""

import argparse
import json
import os
import time
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from toolkit.experiment.recording import Prepared, Recording, prepare
from toolkit.metrics import score_run
from toolkit.models.noise import twist_noise
from toolkit.motion_samples import TwistSamples
from toolkit.registry import find
from toolkit.runner import run
from toolkit.sequence import Sequence
from toolkit.settings import POLICIES, Noise, Outliers, Settings

SIGMA_V_MPS, SIGMA_W_RADPS = 0.5, 0.05
ESTIMATORS = ("dead-reckoning", "ekf", "msckf-fej", "msckf-slam", "fixed-lag", "smart", "isam2", "batch")
METRICS = ("ate_se3_m", "ate_yaw_m", "ate_none_m", "kitti_t_percent", "nees_pose_mean", "nees_ori_mean")
LONG_DRIVE = "0027"
DATA = Path(os.environ.get("VISLAM_DATA", "../shared/data"))


class Case(NamedTuple):
    """One run: a drive and its seed, an estimator, and the noise of tracks it is told."""

    drive: str
    seed: int
    estimator: str
    model: str


def drives() -> dict[str, Path]:
    """Return the recordings by their short names."""
    short = {path.stem.split("_")[4] + path.stem[8:10]: path for path in sorted(DATA.glob("utias/*_sync_KLT.mat"))}
    return {**short, LONG_DRIVE: DATA / "ucsd/0027.npz"}


def with_noisy_twists(sequence: Sequence, seed: int) -> Sequence:
    """Return a recording with white noise on its twists, which makes its truth independent of them."""
    assert isinstance(sequence.motion, TwistSamples) and sequence.truth is not None
    rng, motion = np.random.default_rng(seed), sequence.motion
    v_mps = motion.v_mps + rng.normal(0.0, SIGMA_V_MPS, motion.v_mps.shape)
    w_radps = motion.w_radps + rng.normal(0.0, SIGMA_W_RADPS, motion.w_radps.shape)
    return replace(
        sequence,
        motion=replace(motion, v_mps=v_mps, w_radps=w_radps),
        noise=twist_noise(motion.t_ns, v_mps, w_radps),
        truth=replace(sequence.truth, independent=True),
    )


def noise_of(model: str) -> Noise:
    """Return the settings of a noise model."""
    weight, *switches = model.split("+")
    named: dict[str, Any] = {"auto": "auto", "full": 1.0}
    return Noise(track_weight=named.get(weight) or float(weight), bridge_gaps="open" not in switches)


def prepared(drive: str, seed: int, model: str) -> Prepared:
    """Return a drive as estimators read it under a noise model."""
    source, noise = drives()[drive], noise_of(model)
    if drive == LONG_DRIVE:
        return prepare(Recording(str(source), truth=DATA / "ucsd/gt/0027.tum", noise=noise))
    clean = prepare(Recording(str(source), noise=Noise(track_weight=1.0, motion_scale=1.0))).whole
    return prepare(Recording(with_noisy_twists(clean, seed), noise=noise))


def measured(case: Case, ready: Prepared) -> dict[str, Any]:
    """Run one case and return its line."""
    policy = next((POLICIES[switch] for switch in case.model.split("+") if switch in POLICIES), Outliers())
    settings = Settings(noise=noise_of(case.model), outliers=policy)
    began = time.process_time()
    result = run(case.estimator, find(case.estimator).load(), ready.sequence, ready.prior, settings=settings)
    line: dict[str, Any] = {**case._asdict(), "status": result.status, "cpu_s": time.process_time() - began}
    line["log"] = result.log
    for output in ("causal", "final"):
        if result.trajectory(output) is not None:
            values = score_run(result, output, ready.sequence).values
            line[output] = {key: values[key] for key in METRICS}
    return line


def cases(options: argparse.Namespace) -> Iterator[Case]:
    """Yield every run there is to be."""
    for seed in range(options.first_seed, options.first_seed + options.seeds):
        for drive in options.drives:
            if drive == LONG_DRIVE and seed != options.first_seed:
                continue
            for model in options.models:
                yield from (Case(drive, seed, name, model) for name in options.estimators)


def make(options: argparse.Namespace) -> None:
    """Make the runs whose lines are missing."""
    done = {Case(**{key: line[key] for key in Case._fields}) for line in lines(options.results)}
    ready: Prepared | None = None
    at = None
    for case in cases(options):
        if case in done:
            continue
        if (case.drive, case.seed, case.model) != at:
            at, ready = (case.drive, case.seed, case.model), prepared(case.drive, case.seed, case.model)
        assert ready is not None
        with options.results.open("a") as stream:
            stream.write(json.dumps(measured(case, ready)) + "\n")


def lines(path: Path) -> list[dict[str, Any]]:
    """Return the lines of the results so far."""
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


def table(options: argparse.Namespace) -> None:
    """Print the ratios to dead reckoning and the figures of the long drive."""
    found: dict[tuple[str, str, str], dict[str, list[dict[str, Any]]]] = defaultdict(lambda: defaultdict(list))
    for line in lines(options.results):
        for output in ("causal", "final"):
            if output in line:
                found[line["estimator"], line["model"], output][line["drive"]].append(line)
    reference = next(of for (name, _, output), of in found.items() if (name, output) == ("dead-reckoning", "causal"))
    print(f"{'':44s}over dead reckoning's ATE      {LONG_DRIVE}")
    print(f"{'':44s}SE(3)  yaw    none   NEES ori  SE(3) m KITTI %  bad  CPU s  drives runs")
    for (name, model, output), by_drive in sorted(found.items()):
        short = [drive for drive in by_drive if drive != LONG_DRIVE and drive in reference]
        ratios = [_geometric([_ratio(by_drive[d], reference[d], output, key) for d in short]) for key in METRICS[:3]]
        nees = [_mean(by_drive[d], output, "nees_ori_mean") for d in short]
        of_long = [_mean(by_drive.get(LONG_DRIVE, []), output, key) for key in ("ate_se3_m", "kitti_t_percent")]
        bad = sum(line["status"] != "ok" for drive in by_drive.values() for line in drive)
        cpu_s = sum(line["cpu_s"] for drive in by_drive.values() for line in drive)
        figures = "  ".join(f"{ratio:5.3f}" for ratio in ratios)
        print(
            f"{name:14s} {model:22s} {output:6s} {figures} {_geometric(nees):7.2f}   {of_long[0]:7.2f} "
            f"{of_long[1]:7.2f}  {bad:3d}  {cpu_s:5.0f}  {len(short):6d} {sum(len(by_drive[d]) for d in short):4d}"
        )


def _ratio(one: list[dict[str, Any]], reference: list[dict[str, Any]], output: str, key: str) -> float:
    seeds = {line["seed"] for line in one}
    return _mean(one, output, key) / _mean([line for line in reference if line["seed"] in seeds], "causal", key)


def _mean(runs: list[dict[str, Any]], output: str, key: str) -> float:
    values = [line[output][key] for line in runs if line[output][key] is not None]
    return float(np.mean(values)) if values else float("nan")


def _geometric(values: list[float]) -> float:
    return float(np.exp(np.nanmean(np.log(values)))) if values else float("nan")


def main() -> None:
    """Run or show."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(required=True)
    running = commands.add_parser("run")
    running.set_defaults(command=make)
    running.add_argument("--seeds", type=int, default=3)
    running.add_argument("--first-seed", type=int, default=0)
    running.add_argument("--drives", type=lambda text: text.split(","), default=list(drives()))
    running.add_argument("--estimators", type=lambda text: text.split(","), default=list(ESTIMATORS))
    running.add_argument("--models", type=lambda text: text.split("/"), default=["auto"])
    showing = commands.add_parser("table")
    showing.set_defaults(command=table)
    for command in (running, showing):
        command.add_argument("results", type=Path)
    options = parser.parse_args()
    options.command(options)


if __name__ == "__main__":
    main()
