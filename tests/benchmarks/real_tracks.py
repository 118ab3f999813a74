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

    python tests/benchmarks/real_tracks.py pairs results.jsonl auto full

compares two models run by run: per drive the ratio of the final ATE, its standard error over seeds, and on average.

    python tests/benchmarks/real_tracks.py truth

says how far the drives' truth can be trusted: the ATE SE(3) of their clean twists, which are the truth's instrument's
own; and the median px by which withheld tracks, seen in stereo, are missed in (c, v) a second later, by the poses of
the truth, of the clean twists and of ``batch``; and how many intervals no track leads across.
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
from toolkit.geometry import Array
from toolkit.metrics import score_run
from toolkit.models import stereo
from toolkit.models.camera_motion import neighbours
from toolkit.models.noise import twist_noise
from toolkit.models.stereo import CHANNELS
from toolkit.motion_samples import TwistSamples
from toolkit.registry import find
from toolkit.runner import run
from toolkit.sequence import Sequence
from toolkit.settings import POLICIES, Noise, Outliers, Settings

SIGMA_V_MPS, SIGMA_W_RADPS = 0.5, 0.05
ESTIMATORS = ("dead-reckoning", "ekf", "msckf-fej", "msckf-slam", "fixed-lag", "smart", "isam2", "batch")
METRICS = ("ate_se3_m", "ate_yaw_m", "ate_none_m", "kitti_t_percent", "nees_pose_mean", "nees_ori_mean")
LONG_DRIVE = "0027"


class Case(NamedTuple):
    """One run: a drive and its seed, an estimator, and the noise of tracks it is told."""

    drive: str
    seed: int
    estimator: str
    model: str


def data() -> Path:
    """Return the folder of the recordings."""
    return Path(os.environ.get("VISLAM_DATA", "../shared/data"))


def drives() -> dict[str, Path]:
    """Return the recordings by their short names."""
    short = {path.stem.split("_")[4] + path.stem[8:10]: path for path in sorted(data().glob("utias/*_sync_KLT.mat"))}
    return {**short, LONG_DRIVE: data() / "ucsd/0027.npz"}


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


def outliers_of(model: str) -> Outliers:
    """Return the outlier policy that a model names, the default where it names none."""
    return next((POLICIES[switch] for switch in model.split("+") if switch in POLICIES), Outliers())


def prepared(drive: str, seed: int, model: str) -> Prepared:
    """Return a drive as estimators read it under a noise model."""
    source, noise = drives()[drive], noise_of(model)
    if drive == LONG_DRIVE:
        return prepare(Recording(str(source), truth=data() / "ucsd/gt/0027.tum", noise=noise))
    clean = prepare(Recording(str(source), noise=Noise(track_weight=1.0, motion_scale=1.0))).whole
    return prepare(Recording(with_noisy_twists(clean, seed), noise=noise))


def measured(case: Case, ready: Prepared) -> dict[str, Any]:
    """Run one case and return its line."""
    settings = Settings(noise=noise_of(case.model), outliers=outliers_of(case.model))
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


def pairs(options: argparse.Namespace) -> None:
    """Print what a second model makes of the ATE of a first, drive by drive."""
    of_model: dict[str, dict[tuple[str, int], dict[str, Any]]] = defaultdict(dict)
    for line in lines(options.results):
        if line["estimator"] == options.estimator and "final" in line:
            of_model[line["model"]][line["drive"], line["seed"]] = line
    one, other = of_model[options.one], of_model[options.other]
    logs: dict[str, list[list[float]]] = defaultdict(list)
    for case in one.keys() & other.keys():
        before, after = one[case]["final"], other[case]["final"]
        logs[case[0]].append([np.log(after[key] / before[key]) for key in METRICS[:3]])
    print(f"{options.other} over {options.one}: SE(3), yaw, none; standard errors over seeds")
    for drive, of_seeds in sorted(logs.items()):
        _print_ratios(drive, np.array(of_seeds), len(of_seeds))
    short = np.array([np.mean(of_seeds, axis=0) for drive, of_seeds in logs.items() if drive != LONG_DRIVE])
    _print_ratios("mean", short, len(short))


def truths(options: argparse.Namespace) -> None:
    """Print how well the truth of each drive agrees with its instrument's twists, and with tracks nobody was given."""
    print("drive     gaps  ATE SE(3) m: clean twists  batch    px a second on: truth  clean twists  batch")
    for drive in options.drives:
        clean, noisy = prepare(Recording(str(drives()[drive]))), prepared(drive, 0, "auto")
        assert clean.sequence.truth is not None
        turned = run("dead-reckoning", find("dead-reckoning").load(), clean.sequence, clean.prior)
        smoothed = run("batch", find("batch").load(), noisy.sequence, noisy.prior)
        errors_m = [score_run(one, "final", clean.sequence).values["ate_se3_m"] for one in (turned, smoothed)]
        assert turned.final is not None and smoothed.final is not None
        np.testing.assert_array_equal(clean.sequence.truth.t_ns, turned.final.t_ns)
        ways = (clean.sequence.truth, turned.final, smoothed.final)
        missed_px = [missed_a_second_on(clean.sequence, way.T_world_imu) for way in ways]
        common = np.bincount(neighbours(clean.sequence.visible).interval, minlength=clean.sequence.frame_count - 1)
        gap_count = int((common == 0).sum())
        figures = "".join(f"{px:14.2f}" for px in missed_px)
        print(f"{drive}  {gap_count:4d}{errors_m[0]:28.3f}{errors_m[1]:7.3f}{figures}", flush=True)


def missed_a_second_on(sequence: Sequence, T_world_imu: Array) -> float:
    """Return the median px by which poses (K, 4, 4) miss withheld tracks ten frames on, seen in stereo before."""
    held = sequence.held_out
    place = {key: row for row, key in enumerate(zip(held.track_id.tolist(), held.frame.tolist(), strict=True))}
    pairs = [(row, place[track, frame + 10]) for (track, frame), row in place.items() if (track, frame + 10) in place]
    now, later = np.array(pairs).T
    points = stereo.triangulate_world(held.uv_px[now], T_world_imu[held.frame[now]], sequence.rig)
    predicted = stereo.predict(points, T_world_imu[held.frame[later]], sequence.rig)
    missed = (held.uv_px[later] - predicted.uv_px) @ CHANNELS.T
    return float(np.nanmedian(np.hypot(missed[:, 0], missed[:, 2])))


def _print_ratios(name: str, logs: Array, count: int) -> None:
    ratios = np.exp(logs.mean(axis=0))
    errors = ratios * logs.std(axis=0, ddof=1) / np.sqrt(count) if count > 1 else np.full(3, np.nan)
    print(f"{name:8s}" + "  ".join(f"{one:5.3f} +- {error:5.3f}" for one, error in zip(ratios, errors, strict=True)))


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
    pairing = commands.add_parser("pairs")
    pairing.set_defaults(command=pairs)
    pairing.add_argument("--estimator", default="batch")
    trusting = commands.add_parser("truth")
    trusting.set_defaults(command=truths)
    short = [drive for drive in drives() if drive != LONG_DRIVE]
    trusting.add_argument("--drives", type=lambda text: text.split(","), default=short)
    for command in (running, showing, pairing):
        command.add_argument("results", type=Path)
    pairing.add_argument("one")
    pairing.add_argument("other")
    options = parser.parse_args()
    options.command(options)


if __name__ == "__main__":
    main()
