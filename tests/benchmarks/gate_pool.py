"""Neutral pairs and planted regressions for the benchmark of the gate's power.

A *neutral pair* is one estimator run twice on one simulated recording, each time with an independent dither on
everything it reads: Gaussian, 5 % of the standard deviation that the recording states for its pixels and its motion.
The two sides are exchangeable, so that neither is better than the other in expectation; what differs between them
is what any harmless change of an implementation does: other roundings, other tracks at the gates' edges, other stops.

A *planted regression* of p percent multiplies the error of every pose of a side, as a twist in the body frame, by
1 + p u / 100 with u uniform in 0 ... 2, drawn anew for each run: p percent in expectation, with a spread of its own of
0.58 p percent, and seen by ATE and NEES only.

*Planted changes* are such as a commit makes by mistake; they read what side 0 reads, and are compared with side 0:
noise stated 5 % too large, first estimates dropped, a sign of the camera's lever arm, an ATE that is a mean.
"""

import json
import os
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import fields, replace
from pathlib import Path
from unittest.mock import patch

import numpy as np

from toolkit import runner
from toolkit.answers import Run
from toolkit.audit import audit
from toolkit.estimate import Trajectory
from toolkit.gate.measuring import reference_s
from toolkit.geometry import se3_exp, se3_inverse, se3_log
from toolkit.initialization import start_from_measurements
from toolkit.measurements import MotionNoise, Prior, TwistNoise
from toolkit.metrics import Evaluation, ate, innovations, nees, reprojection
from toolkit.metrics.parts.scores import Unavailable
from toolkit.progress import SILENT
from toolkit.registry import find
from toolkit.sequence import Observations, Sequence
from toolkit.simulation import SCENARIOS, simulate

DITHER = 0.05
LEVELS_PERCENT = (0.0, 2.0, 5.0, 10.0)
SIDES = (0, 1)
# What is planted in which estimators, and the estimator that is run for it where it is another.
NOISE_PLANTS = {"pixel noise + 5 %": (1.05, 1.0), "motion noise + 5 %": (1.0, 1.05)}
OTHERS = {"first estimates dropped": {"msckf-fej": "msckf"}}
SLIP, MEAN_ATE = "sign of the lever arm", "ATE is a mean"


def dithered(sequence: Sequence, rng: np.random.Generator) -> Sequence:
    """Return the sequence with the neutral dither on its sightings and motion samples."""
    seen, motion, noise = sequence.observations, sequence.motion, sequence.noise
    sigma_px = np.sqrt(np.diag(sequence.rig.cov_uv_px2))
    uv_px = seen.uv_px + DITHER * sigma_px * rng.standard_normal(seen.uv_px.shape)
    root_dt = np.sqrt(float(np.median(np.diff(motion.t_ns))) * 1e-9)
    first, second = (DITHER / root_dt * rng.standard_normal((motion.t_ns.size, 3)) for _ in range(2))
    linear = noise.velocity_noise_density if isinstance(noise, TwistNoise) else noise.accel_noise_density
    off = np.hstack([linear * first, noise.gyro_noise_density * second])
    samples = motion.of(motion.t_ns, motion.values + off)
    return replace(sequence, observations=Observations(seen.frame, seen.track_id, uv_px), motion=samples)


def worsened(trajectory: Trajectory | None, sequence: Sequence, factor: float) -> Trajectory | None:
    """Return the trajectory with every pose's error multiplied; simulated truth has the frames' own stamps."""
    assert sequence.truth is not None
    if trajectory is None or factor == 1.0:
        return trajectory
    true = sequence.truth.T_world_imu[np.searchsorted(sequence.truth.t_ns, trajectory.t_ns)]
    return replace(trajectory, T_world_imu=true @ se3_exp(factor * se3_log(se3_inverse(true) @ trajectory.T_world_imu)))


def scores(run: Run, sequence: Sequence, percent: float) -> dict[str, dict[str, float | None]]:
    """Return the metrics the gate checks on a simulated sequence, by kind of output; held-out only without a plant."""
    files = (ate, nees, reprojection, innovations) if percent == 0.0 else (ate, nees)
    found: dict[str, dict[str, float | None]] = {}
    for output in ("causal",) if run.final_is_causal else ("causal", "final"):
        if run.trajectory(output) is not None:
            found[output] = {}
            for file in files:
                with suppress(Unavailable):
                    found[output] |= file.score(Evaluation(run, output, sequence)).values
    return found


def one_seed(requested: tuple[str, float, int, tuple[str, ...]]) -> dict[str, object]:
    """Run every estimator on both sides and with its plants; return metrics by estimator and side, and its time."""
    source, duration_s, seed, estimators = requested
    sequence = audit(simulate(replace(SCENARIOS[source], duration_s=duration_s), seed)).sequence
    prior = start_from_measurements(sequence)
    found: dict[str, object] = {"source": source, "duration_s": duration_s, "seed": seed}
    reference_s()
    for side in SIDES:
        read = dithered(sequence, np.random.default_rng([seed, side]))
        planted = np.random.default_rng([seed, side, 1])
        for name in estimators:
            before_s = reference_s()
            run = runner.run(name, find(name).load(), read, prior, SILENT)
            assert run.timings is not None
            speed = 2.0 * run.timings.cpu_s / (before_s + reference_s())
            u = planted.uniform(0.0, 2.0, len(LEVELS_PERCENT))
            levels = {}
            for percent, factor in zip(LEVELS_PERCENT, 1.0 + np.array(LEVELS_PERCENT) * u / 100.0, strict=True):
                moved = [worsened(t, sequence, float(factor)) for t in (run.causal, run.final)]
                levels[f"{percent:g}"] = scores(replace(run, causal=moved[0], final=moved[1]), sequence, percent)
            one = {"status": run.status, "speed": speed, "levels": levels}
            found[f"{name}/{side}"] = one if side else one | {"plants": dict(_plants(run, read, prior, sequence))}
    return found


def _plants(run: Run, read: Sequence, prior: Prior, sequence: Sequence) -> Iterator[tuple[str, dict[str, object]]]:
    """Yield what comes of an estimator with each of the planted changes: how it ended, and its metrics."""
    with patch.object(ate, "rmse", lambda lengths_m: float(np.mean(lengths_m))):
        yield MEAN_ATE, {"status": run.status, "scores": scores(run, sequence, 0.0)}
    rig, name = read.rig, run.estimator
    reads = {
        plant: replace(read, rig=replace(rig, cov_uv_px2=rig.cov_uv_px2 * pixels**2), noise=_louder(read.noise, motion))
        for plant, (pixels, motion) in NOISE_PLANTS.items()
    }
    slipped = rig.T_imu_cam.copy()
    slipped[1, 3] *= -1.0
    reads[SLIP] = replace(read, rig=replace(rig, T_imu_cam=slipped))
    for plant, by_estimator in OTHERS.items():
        if name in by_estimator:
            reads[plant] = read
    for plant, given in reads.items():
        other = OTHERS.get(plant, {}).get(name, name)
        changed = runner.run(name, find(other).load(), given, prior, SILENT)
        yield plant, {"status": changed.status, "scores": scores(changed, sequence, 0.0)}


def _louder(noise: MotionNoise, factor: float) -> MotionNoise:
    """Return the noise with its white densities scaled."""
    white = [f.name for f in fields(noise) if f.name.endswith("_noise_density")]
    return replace(noise, **{name: factor * getattr(noise, name) for name in white})


def fill(pool: Path, cases: dict[str, float], seeds: range, estimators: tuple[str, ...], processes: int) -> None:
    """Append a line of JSON for each seed of each case to the pool; may be interrupted."""
    from multiprocessing import get_context

    work = [(source, duration_s, seed, estimators) for seed in seeds for source, duration_s in cases.items()]
    with get_context("spawn").Pool(processes) as side_by_side, pool.open("a", encoding="utf-8") as lines:
        for found in side_by_side.imap_unordered(one_seed, work):
            lines.write(json.dumps(found) + os.linesep)
            lines.flush()


def read(pool: Path) -> Iterator[dict[str, object]]:
    """Yield what a pool holds."""
    for line in pool.read_text(encoding="utf-8").splitlines():
        yield json.loads(line)
