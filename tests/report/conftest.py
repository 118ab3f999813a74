"""A made-up comparison: a simulated recording, and runs that are its truth with a known error."""

import json
import shutil
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from toolkit.answers import Run, Timings
from toolkit.audit import Finding
from toolkit.estimate import Landmarks, Trajectory
from toolkit.experiment.comparison import Comparison, Row
from toolkit.experiment.units import outcome_of
from toolkit.geometry import Array, about_z, interpolate_poses, se3
from toolkit.metrics import Scores
from toolkit.models.stereo import triangulate_world
from toolkit.report.run_directory import MadeBy, write_run
from toolkit.sequence import Sequence
from toolkit.simulation import DRIVE, simulate

SEED = 3
FINDING = Finding("stale-frames", 91, True, "91 of 1106 frames repeat the one before; their tracks end there", False)
UNDECIDED = {"time-offset": "too little change of rotation", "twist-lag": "too little change of rotation"}


@pytest.fixture(scope="session")
def sequence() -> Sequence:
    return simulate(replace(DRIVE, duration_s=12.0), seed=SEED)


@pytest.fixture(scope="session")
def comparison(sequence: Sequence) -> Comparison:
    """Four runs: both outputs, diverged, an answer at the end only, and a failure without any answer."""
    runs = (
        _run("steady", sequence, turn_rad=0.02),
        replace(_run("astray", sequence, turn_rad=0.4, growth=1.06), status="diverged", log=("left the road",)),
        replace(_run("late", sequence, turn_rad=0.01), causal=None),
        Run("broken", "failed", None, None, Landmarks.none(), _timings(0), log=("the solve did not converge",)),
    )
    return compared(sequence, runs)


@pytest.fixture(scope="session")
def without_truth(sequence: Sequence) -> Comparison:
    """The same kind of comparison on a recording nobody knows the truth of."""
    blind = replace(sequence, truth=None)
    return compared(blind, (_run("steady", sequence, turn_rad=0.02), _run("late", sequence, turn_rad=0.01)))


@pytest.fixture(scope="session")
def run_directory(
    comparison: Comparison,
    tmp_path_factory: pytest.TempPathFactory,
    without_pixels: Callable[[], AbstractContextManager[None]],
) -> Path:
    """The run directory of the comparison; it is shared and must not be changed. Nobody looks at its figures."""
    target = tmp_path_factory.mktemp("runs") / "made-up"
    with without_pixels():
        write_run(comparison, target, MadeBy("vislam compare made-up --seed 3"))
    return target


@pytest.fixture
def run_called(run_directory: Path, tmp_path: Path) -> Callable[[str], Path]:
    """Return a function that copies the run directory with a name put for its recording's and for one run's."""

    def copied(name: str) -> Path:
        target = tmp_path / "run"
        shutil.copytree(run_directory, target)
        for document in ("metrics.json", "report.json", "manifest.json"):
            text = (target / document).read_text()
            renamed = text.replace('"steady"', json.dumps(name)).replace('"drive"', json.dumps(name))
            (target / document).write_text(renamed)
        return target

    return copied


def rescored(comparison: Comparison, score: Callable[[Row], Scores]) -> Comparison:
    """Give every output of a comparison other scores, made from its row."""
    scores = {(row.estimator, row.output): score(row) for row in comparison.rows}
    outcomes = []
    for outcome in comparison.outcomes:
        outputs = {
            output: replace(scored, scores=scores[outcome.estimator, output])
            for output, scored in outcome.outputs.items()
        }
        outcomes.append(replace(outcome, outputs=outputs))
    return replace(comparison, outcomes=tuple(outcomes))


def compared(sequence: Sequence, runs: tuple[Run, ...]) -> Comparison:
    """Score runs over a sequence and lay them side by side."""
    assert sequence.prior is not None
    outcomes = tuple(outcome_of(run, sequence, SEED) for run in runs)
    return Comparison("made-up", sequence, (FINDING,), sequence.prior, (SEED,), outcomes, undecided=UNDECIDED)


def _run(name: str, sequence: Sequence, turn_rad: float, growth: float = 1.0) -> Run:
    """Return the truth, turned more and more up to ``turn_rad`` and stretched by ``growth`` with each frame."""
    t_ns = sequence.frames_t_ns
    poses = interpolate_poses(sequence.truth.t_ns, sequence.truth.T_world_imu, t_ns)
    frames = np.arange(t_ns.size)
    turned = se3(about_z(turn_rad * frames / t_ns.size), np.zeros(3)) @ poses
    stretched = se3(turned[:, :3, :3], turned[:, :3, 3] * (growth**frames)[:, None])
    trajectory = Trajectory(t_ns, stretched)
    return Run(name, "ok", trajectory, trajectory, _landmarks(sequence, poses), _timings(t_ns.size))


def _landmarks(sequence: Sequence, poses: Array) -> Landmarks:
    seen = sequence.visible
    ids, first = np.unique(seen.track_id, return_index=True)
    return Landmarks(ids, triangulate_world(seen.uv_px[first], poses[seen.frame[first]], sequence.rig))


def _timings(frames: int) -> Timings:
    step_s = 1e-3 * (1.0 + 0.3 * np.sin(np.arange(frames)))
    return Timings(step_s, finish_s=0.4, total_s=0.4 + float(step_s.sum()), cpu_s=0.5, peak_rss_mb=123.0)
