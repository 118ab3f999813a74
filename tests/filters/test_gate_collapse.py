"""Where the gate of the decoupled filter collapses its run is diverged.

A gate at 95 % refuses what a state is off by as soon as its covariance is a little too small, and without corrections
the state runs off: the policy by default, at 99 %, spares the same filter that on the same recording.
"""

from dataclasses import replace

import numpy as np

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


def test_the_decoupled_filter_that_runs_off_behind_a_narrow_gate_is_reported_to_have_diverged(run_estimator):
    # Started from its measurements, as a real recording is.
    blind = audit(replace(simulate(ROUGH, 5), prior=None)).sequence
    recording = replace(blind, prior=start_from_measurements(blind))
    narrow, usual = (
        run_estimator("ekf", recording, settings=chosen)
        for chosen in (Settings(outliers=POLICIES["classic"]), Settings())
    )
    off_m, kept_m = (score_run(run, "causal", recording).values["ate_yaw_m"] for run in (narrow, usual))
    assert off_m > 1.0
    assert narrow.status == "diverged"
    assert "passed its own gate: its covariance does not cover its error" in narrow.log[-1]
    assert kept_m < 0.3
    assert usual.status == "ok"
