"""How much the outlier gate lets through: its probability where the model holds, far less where it does not."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from tests.metrics.conftest import drive_poses, make_run, make_sequence
from toolkit.answers import Run
from toolkit.metrics import Evaluation, Scores
from toolkit.metrics.innovations import ACCEPTED, refuses_much, score
from toolkit.simulation import SCENARIOS, simulate

Scored = Callable[..., Scores]
RunEstimator = Callable[..., Run]


@pytest.fixture
def scored() -> Scored:
    sequence = make_sequence(drive_poses(150), track_count=60)
    return lambda output, info: score(
        Evaluation(make_run(sequence.frames_t_ns, sequence.truth.T_world_imu, info=info), output, sequence)
    )


def test_it_is_the_share_over_all_steps_that_tested_something(scored: Scored) -> None:
    info = {"gate_tested": np.array([np.nan, 30.0, 0.0, 10.0]), "gate_accepted": np.array([np.nan, 27.0, 0.0, 3.0])}
    assert scored("causal", info).values[ACCEPTED] == pytest.approx(75.0)


@pytest.mark.parametrize(
    ("output", "info", "reason"),
    [
        ("final", {"gate_tested": np.ones(3), "gate_accepted": np.ones(3)}, "causal"),
        ("causal", {}, "reports no gate"),
        ("causal", {"gate_tested": np.zeros(3), "gate_accepted": np.zeros(3)}, "tested nothing"),
    ],
)
def test_without_a_gate_there_is_a_reason(scored: Scored, output: str, info: dict[str, object], reason: str) -> None:
    scores = scored(output, info)
    assert scores.values[ACCEPTED] is None
    assert reason in scores.notes[ACCEPTED]


@pytest.mark.parametrize("name", ["ekf", "msckf-slam"])
def test_a_sound_recording_passes_and_a_focal_length_a_tenth_too_long_does_not(
    run_estimator: RunEstimator, name: str
) -> None:
    """The innovations that remain look consistent in both: behind its gate msckf-slam reads a NIS near 1."""
    sound = simulate(replace(SCENARIOS["flight"], duration_s=4.0), seed=5)
    wrong = replace(sound, rig=replace(sound.rig, fx_px=1.1 * sound.rig.fx_px))
    runs = [(run_estimator(name, one), one) for one in (sound, wrong)]
    shares = [score(Evaluation(run, "causal", one)).values[ACCEPTED] for run, one in runs]
    assert not refuses_much(shares[0])
    assert refuses_much(shares[1])
