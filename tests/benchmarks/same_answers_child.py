"""What runs within each revision for same_answers.py: the estimators on one sequence, all they answer in one npz file.

It is started with the revision's tree first on the path, and so imports by whichever name that revision has.

    python same_answers_child.py SEQUENCE FRAMES OUT.npz ESTIMATOR ...
"""

# ruff: noqa: E402 - the number of threads must be set before NumPy is imported
import os

for _threads in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_threads, "1")

import importlib
import inspect
import sys
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

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


class _Unwatched:
    """Progress nobody sees, as a callback and as a context."""

    def __enter__(self) -> "_Unwatched":
        return self

    def __exit__(self, *_error: object) -> None:
        return None

    def advance(self, *_done_of_total: object, **_stage: object) -> None:
        """Take no note."""


def first_of(names: tuple[str, ...], attribute: str) -> Any:
    """Return an attribute of the first module of these names that exists; ImportError where none does."""
    for name in names:
        try:
            return getattr(importlib.import_module(name), attribute)
        except ModuleNotFoundError as error:
            if error.name is None or not name.startswith(error.name):
                raise
    raise ImportError(f"none of {', '.join(names)} exists in this revision")


def call(function: Callable[..., Any], values: Mapping[str, object]) -> Any:
    """Call a function with those of the values it has parameters for; settings it insists on are the defaults."""
    given = {}
    for parameter in inspect.signature(function).parameters.values():
        if parameter.name in values:
            given[parameter.name] = values[parameter.name]
        elif parameter.name == "settings" and parameter.default is parameter.empty:
            given["settings"] = first_of(("toolkit.settings",), "Settings")()
    return function(**given)


def sequence_of(name: str, frames: int) -> Any:
    """Return a sequence as the estimators read it: simulated or loaded, audited, cut, with its noise as measured."""
    audit = first_of(("toolkit.audit",), "audit")
    load = first_of(("toolkit.datasets",), "load_sequence")
    if name in SIMULATED:
        scenario, duration_s, planted = SIMULATED[name]
        scenarios = first_of(("toolkit.simulation",), "SCENARIOS")
        simulate = first_of(("toolkit.simulation",), "simulate")
        sequence = simulate(replace(scenarios[scenario], duration_s=duration_s), SEED)
        if planted:
            fault, dose = planted
            sequence = first_of(("toolkit.simulation.faults",), fault)(sequence, dose, SEED)
        sequence = audit(sequence).sequence
    elif name in RECORDED:
        path, frames = RECORDED[name]
        sequence = audit(load(str(Path(os.environ["VISLAM_DATA"], path)))).sequence.truncated(frames)
    else:
        sequence = audit(load(name)).sequence
        sequence = sequence.truncated(frames) if frames else sequence
    return with_measured_noise(sequence)


def with_measured_noise(sequence: Any) -> Any:
    """Return the sequence with the weight of its tracks and the noise of its motion as they are measured on it."""
    try:
        measured = first_of(("toolkit.noise",), "measured_noise")(sequence)
    except ImportError:  # revisions whose estimators adapt their noise themselves
        return sequence
    rig = replace(sequence.rig, track_weight=measured.tracks.value)
    return replace(sequence, rig=rig, noise=sequence.noise.scaled(measured.motion.value))


def read_of(sequence: Any, prior: Any) -> dict[str, Any]:
    """Return what the estimators read: where this differs already, no estimator is to blame."""
    return {
        "sightings": sequence.observations.uv_px,
        "ids": sequence.observations.track_id,
        "motion": sequence.motion.values,
        "stamps": sequence.frames_t_ns,
        "track weight": np.array(getattr(sequence.rig, "track_weight", 1.0)),
        "prior": np.concatenate([prior.T_world_imu.ravel(), prior.v_world, prior.bias]),
        "prior covariances": prior.cov[None],
    }


def answers_of(run: Any, sequence: Any) -> dict[str, Any]:
    """Return all that a run answered except what it cost, by output and kind."""
    score_run = first_of(("toolkit.metrics",), "score_run")
    # Keys in some revisions, records with a key in others.
    cost = {getattr(metric, "key", metric) for metric in first_of(("toolkit.metrics.cost",), "METRICS")}
    found: dict[str, Any] = {
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
        values = call(score_run, {"run": run, "output": output, "sequence": sequence}).values
        kept = {key: value for key, value in values.items() if key not in cost}
        found |= {f"{output}/metrics/{key}": np.nan if value is None else value for key, value in kept.items()}
    return {kind: value for kind, value in found.items() if value is not None}


def main(words: list[str]) -> None:
    """Run the estimators on the sequence and write their answers."""
    name, frames, out, *estimators = words
    starts = ("toolkit.initialization", "toolkit.start")
    run = first_of(("toolkit.runner",), "run")
    find = first_of(("toolkit.registry", "toolkit.estimator"), "find")
    sequence = sequence_of(name, int(frames))
    prior = first_of(starts, "start_from_measurements")(sequence)
    found = {f"{name}/(input)/{kind}": value for kind, value in read_of(sequence, prior).items()}
    for estimator in estimators:
        given = {
            "name": estimator,
            "build": find(estimator).load(),
            "sequence": sequence,
            "prior": prior,
            "progress": _Unwatched(),
        }
        answers = answers_of(call(run, given), sequence)
        found |= {f"{name}/{estimator}/{kind}": value for kind, value in answers.items()}
    np.savez_compressed(out, **found)


if __name__ == "__main__":
    main(sys.argv[1:])
