"""What runs within each revision for same_answers.py: the estimators on one sequence, all they answer in one npz file.

It is started with the revision's tree first on the path, which must have all that is imported here.

    python same_answers_child.py SEQUENCE FRAMES OUT.npz ESTIMATOR ...
"""

# ruff: noqa: E402 - the number of threads must be set before NumPy is imported
import os

for _threads in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_threads, "1")

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

from toolkit import runner
from toolkit.answers import Run
from toolkit.audit import audit
from toolkit.datasets import load_sequence
from toolkit.geometry import Array
from toolkit.initialization import start_from_measurements
from toolkit.measurements import Prior
from toolkit.metrics import cost, score_run
from toolkit.noise import measured_noise
from toolkit.registry import find
from toolkit.sequence import Sequence
from toolkit.simulation import SCENARIOS, faults, simulate

SEED = 0
# Scenario, seconds, and what is planted: an injector of toolkit.simulation.faults and its dose.
SIMULATED: dict[str, tuple[str, float, tuple[str, float] | None]] = {
    "drive": ("drive", 10.0, None),
    "drive-imu": ("drive-imu", 6.0, None),
    "flight": ("flight", 6.0, None),
    "flight-left-only": ("flight", 4.0, ("missing_right", 0.33)),
    "drive-returning": ("drive", 6.0, ("dropped_sightings", 0.2)),
    "drive-outliers": ("drive", 6.0, ("outlier_tracks", 0.3)),
    "drive-realistic": ("drive-realistic", 6.0, None),
}
# Recordings under VISLAM_DATA, and their first frames: those of 0027 are cut behind gaps of its frames.
RECORDED = {"0027": ("ucsd/0027.npz", 120)}


def sequence_of(name: str, frames: int) -> Sequence:
    """Return a sequence as the estimators read it: simulated or loaded, audited, cut, with its noise as measured."""
    if name in SIMULATED:
        scenario, duration_s, planted = SIMULATED[name]
        simulated = simulate(replace(SCENARIOS[scenario], duration_s=duration_s), SEED)
        if planted:
            fault, dose = planted
            simulated = getattr(faults, fault)(simulated, dose, SEED)
        sequence = audit(simulated).sequence
    else:
        path, frames = RECORDED.get(name, (name, frames))
        source = str(Path(os.environ["VISLAM_DATA"], path)) if name in RECORDED else path
        sequence = audit(load_sequence(source)).sequence
        sequence = sequence.truncated(frames) if frames else sequence
    measured = measured_noise(sequence)
    rig = replace(sequence.rig, track_weight=measured.tracks.value)
    return replace(sequence, rig=rig, noise=sequence.noise.scaled(measured.motion.value))


def read_of(sequence: Sequence, prior: Prior) -> dict[str, Array]:
    """Return what the estimators read: where this differs already, no estimator is to blame."""
    return {
        "sightings": sequence.observations.uv_px,
        "ids": sequence.observations.track_id,
        "motion": sequence.motion.values,
        "stamps": sequence.frames_t_ns,
        "track weight": np.array(sequence.rig.track_weight),
        "prior": np.concatenate([prior.T_world_imu.ravel(), prior.v_world, prior.bias]),
        "prior covariances": prior.cov[None],
    }


def answers_of(run: Run, sequence: Sequence) -> dict[str, object]:
    """Return all that a run answered except what it cost, by output and kind."""
    costs = {metric.key for metric in cost.METRICS}
    found: dict[str, object] = {
        "status": np.array(run.status),
        "landmarks/ids": run.landmarks.track_ids,
        "landmarks/points": run.landmarks.points_world,
        "landmarks/covariances": run.landmarks.cov,
    }
    for output in ("causal", "final"):
        trajectory = getattr(run, output)
        if trajectory is None:
            continue
        found |= {
            f"{output}/stamps": trajectory.t_ns,
            f"{output}/poses": trajectory.T_world_imu,
            f"{output}/covariances": trajectory.cov,
            f"{output}/velocities": trajectory.v_world,
            f"{output}/biases": trajectory.bias,
        }
        kept = {key: value for key, value in score_run(run, output, sequence).values.items() if key not in costs}
        found |= {f"{output}/metrics/{key}": np.nan if value is None else value for key, value in kept.items()}
    return {kind: value for kind, value in found.items() if value is not None}


def main(words: list[str]) -> None:
    """Run the estimators on the sequence and write their answers."""
    name, frames, out, *estimators = words
    sequence = sequence_of(name, int(frames))
    prior = start_from_measurements(sequence)
    found: dict[str, object] = {f"{name}/(input)/{kind}": value for kind, value in read_of(sequence, prior).items()}
    for estimator in estimators:
        run = runner.run(estimator, find(estimator).load(), sequence, prior)
        found |= {f"{name}/{estimator}/{kind}": value for kind, value in answers_of(run, sequence).items()}
    np.savez_compressed(out, **found)


if __name__ == "__main__":
    main(sys.argv[1:])
