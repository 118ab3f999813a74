"""Which outlier policy is best over clean and struck recordings, for filters and smoothers together.

    python tests/benchmarks/outlier_policies.py [--seeds 5] [--first-seed 400] [--policies robust,gate,classic]
    python tests/benchmarks/outlier_policies.py --recordings 03.npz kitti00 0027.npz=gt/0027.tum

Simulated: every policy on the same recordings, so differences are paired over the seeds. A figure is the mean of
log RMSE of the position, aligned in heading and position, less that under the policy ``classic``, with its standard
error over seeds: -0.10 is a tenth better. The last lines are the mean over estimators, the standard error that of the
seeds' means. A run that ends badly counts with its RMSE as it is, or as ten times that of ``classic`` where it has
none, and is counted beside it.

Recorded: the RMSE where there is truth, and the reprojection of withheld tracks.
"""

import argparse
import json
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import msgspec
import numpy as np

from toolkit import compare, runner
from toolkit.geometry import Array
from toolkit.metrics.parts.against_truth import fit_yaw
from toolkit.registry import find
from toolkit.sequence import Sequence as Recording
from toolkit.settings import POLICIES, Outliers, Settings
from toolkit.simulation import DRIVE, DRIVE_IMU, FLIGHT, Scenario, simulate

FILTERS = ("ekf", "ekf-slam", "riekf", "msckf-fej", "msckf-slam")
SMOOTHERS = ("fixed-lag", "smart", "isam2", "batch")
SCENARIOS = {"flight": (FLIGHT, 5.0), "drive": (DRIVE, 8.0), "drive-imu": (DRIVE_IMU, 8.0)}
RATES = (0.0, 0.02, 0.3)
REFERENCE = "classic"
RECORDED_METRICS = ("ate_se3_m", "heldout_reproj_median_px", "heldout_reproj_rmse_px")
# What a run without an answer counts for: log RMSE above that of the reference.
NO_ANSWER = float(np.log(10.0))

# Candidates that are no policy of the settings: the gate and the loss of "robust", one of them changed.
_CHANGED = partial(msgspec.structs.replace, POLICIES["robust"])
_HUBER = ("joint_huber", "filter_huber", "smoother_huber")
CANDIDATES: dict[str, Outliers] = {
    **POLICIES,
    "robust-gate-95": _CHANGED(gate_probability=0.95),
    "robust-huber-2.8": _CHANGED(**dict.fromkeys(_HUBER, 2.8)),
    "robust-gate-99.9": _CHANGED(gate_probability=0.999),
    "robust-smoothers-4-x": _CHANGED(smoother_gate_factor=4.0),
}


class Result(NamedTuple):
    """How one run ended, and the log of its RMSE in metres, NaN without an answer."""

    estimator: str
    policy: str
    status: str
    log_rmse: float


def results(recording: Recording, estimators: Sequence[str], policies: Sequence[str]) -> Iterator[Result]:
    """Run every estimator under every policy."""
    assert recording.prior is not None and recording.truth is not None
    truth = recording.truth.T_world_imu
    for policy in policies:
        settings = Settings(outliers=CANDIDATES[policy])
        for name in estimators:
            run = runner.run(name, find(name).load(), recording, recording.prior, settings=settings)
            answer = run.causal or run.final
            off = np.nan
            if answer is not None and len(answer.t_ns) == len(truth):
                error_m = fit_yaw(truth[:, :3, 3], answer.positions).apply(answer.T_world_imu) - truth
                off = float(0.5 * np.log(np.square(error_m[:, :3, 3]).sum(axis=1).mean()))
            yield Result(name, policy, run.status, off)


def struck(scenario: Scenario, rate: float) -> Scenario:
    """Return the scenario with a share of its sightings displaced."""
    return replace(scenario, camera=replace(scenario.camera, outlier_rate=rate))


def against_reference(found: Sequence[Sequence[Result]], name: str, policy: str) -> Array:
    """Return the differences (seeds,) of log RMSE."""
    by = [{(r.estimator, r.policy): r.log_rmse for r in seed} for seed in found]
    differences = np.array([seed[name, policy] - seed[name, REFERENCE] for seed in by])
    return np.where(np.isfinite(differences), differences, NO_ANSWER)


def with_error(values: Array) -> str:
    """Return mean and standard error."""
    return f"{values.mean():+6.3f} +- {values.std(ddof=1) / np.sqrt(len(values)):5.3f}"


def simulated(options: argparse.Namespace) -> None:
    """Print differences for every scenario and rate, then over all of them."""
    policies = [REFERENCE, *(policy for policy in options.policies if policy != REFERENCE)]
    estimators, seeds = options.estimators, range(options.first_seed, options.first_seed + options.seeds)
    everything: dict[str, list[Array]] = {}
    reported: dict[str, dict[str, list[float]]] = {}
    for scene in options.scenarios:
        scenario, duration_s = SCENARIOS[scene]
        duration_s = options.duration or duration_s
        for rate in options.rates:
            which = struck(replace(scenario, duration_s=duration_s), rate)
            found = [list(results(simulate(which, seed), estimators, policies)) for seed in seeds]
            print(f"\n{scene} {duration_s:g} s, {100.0 * rate:g} % outliers, {len(seeds)} seeds", flush=True)
            for policy in policies[1:]:
                per = {name: against_reference(found, name, policy) for name in estimators}
                bad = sum(r.status != "ok" for seed in found for r in seed if r.policy == policy)
                for name, differences in per.items():
                    print(f"  {policy:28s} {name:12s} {with_error(differences)}")
                over = np.mean(list(per.values()), axis=0)
                print(f"  {policy:28s} {'all':12s} {with_error(over)}   {bad} ended badly", flush=True)
                everything.setdefault(policy, []).append(over)
                reported[f"{scene} {rate:g} {policy}"] = {name: d.tolist() for name, d in per.items()}
            bad = sum(r.status != "ok" for seed in found for r in seed if r.policy == REFERENCE)
            print(f"  {REFERENCE:28s} {'all':12s} {bad} ended badly", flush=True)
    print("\nmean over scenarios, rates and estimators")
    for policy, parts in everything.items():
        print(f"  {policy:28s} {with_error(np.mean(parts, axis=0))}")
    if options.out is not None:
        options.out.write_text(json.dumps(reported, indent=1) + "\n")


def recorded(options: argparse.Namespace) -> None:
    """Print the metrics of recordings, each under every policy."""
    for given in options.recordings:
        path, _, truth = given.partition("=")
        for policy in options.policies:
            settings = {"outliers": msgspec.to_builtins(CANDIDATES[policy])}
            comparison = compare(
                path, options.estimators, truth=truth or None, settings=settings, max_frames=options.max_frames
            ).comparison
            print(f"\n{path}, {policy}")
            for row in comparison.lines:
                figures = {key: row.value(key) for key in RECORDED_METRICS}
                shown = ", ".join(f"{key} {value:.4g}" for key, value in figures.items() if value is not None)
                print(f"  {row.estimator:12s} {row.label:8s} {row.status:9s} {shown}", flush=True)


def main() -> None:
    """Measure."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=4)
    parser.add_argument("--first-seed", type=int, default=400)
    parser.add_argument("--policies", type=lambda text: text.split(","), default=list(CANDIDATES))
    parser.add_argument("--estimators", type=lambda text: text.split(","), default=[*FILTERS, *SMOOTHERS])
    parser.add_argument("--scenarios", type=lambda text: text.split(","), default=list(SCENARIOS))
    parser.add_argument("--rates", type=lambda text: [float(rate) for rate in text.split(",")], default=RATES)
    parser.add_argument("--duration", type=float, help="seconds of every scenario")
    parser.add_argument("--recordings", nargs="+", default=[], metavar="PATH[=TRUTH]")
    parser.add_argument("--max-frames", type=int, default=None)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    recorded(options) if options.recordings else simulated(options)


if __name__ == "__main__":
    main()
