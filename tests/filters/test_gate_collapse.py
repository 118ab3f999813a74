"""Where the gate of the decoupled filter collapses its run is diverged.

A gate at 95 % refuses what a state is off by as soon as its covariance is a little too small, and without corrections
the state runs off: the policy by default, at 99 %, spares the same filter that on the same recording.
"""

from dataclasses import replace

import numpy as np
import pytest

from toolkit.audit import audit
from toolkit.initialization import start_from_measurements
from toolkit.metrics import score_run
from toolkit.settings import POLICIES, Settings
from toolkit.simulation import FLIGHT, simulate

# A hand-held rig as they are: biases unknown before the start and drifting fast, few tracks that end soon.
ROUGH = replace(
    FLIGHT,
    duration_s=12.0,
    rig=replace(FLIGHT.rig, baseline_m=0.11),
    camera=replace(FLIGHT.camera, rate_hz=10.0, max_tracks=30, loss_per_frame=0.1),
    motion=replace(FLIGHT.motion, bias_sigma=np.repeat([0.05, 0.003], 3)),
)


@pytest.fixture(scope="module")
def recording():
    """Return the flight started from its measurements, as a real recording is."""
    blind = audit(replace(simulate(ROUGH, 5), prior=None)).sequence
    return replace(blind, prior=start_from_measurements(blind))


def test_the_decoupled_filter_that_ran_off_is_reported_to_have_diverged(recording, run_estimator):
    run = run_estimator("ekf", recording, settings=Settings(outliers=POLICIES["classic"]))
    assert score_run(run, "causal", recording).values["ate_yaw_m"] > 1.0
    assert run.status == "diverged"
    assert "passed its own gate: its covariance does not cover its error" in run.log[-1]


def test_it_does_not_run_off_behind_a_gate_that_passes_what_chance_makes(recording, run_estimator):
    run = run_estimator("ekf", recording)
    assert run.status == "ok"
    assert score_run(run, "causal", recording).values["ate_yaw_m"] < 0.3
