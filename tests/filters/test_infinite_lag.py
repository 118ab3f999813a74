"""Smoothers whose lag is longer than the recording, or without end, are the batch."""

from dataclasses import replace

import numpy as np
import pytest

from filters import batch, ekf
from filters.fixed_lag import FixedLag
from filters.isam2 import Isam2
from filters.smart import Smart
from tests.filters.conftest import recorded
from toolkit.geometry import se3_inverse, se3_log
from toolkit.simulation import DRIVE, DRIVE_IMU, FLIGHT

SCENARIOS = [replace(DRIVE, duration_s=2.0), replace(DRIVE_IMU, duration_s=2.0), replace(FLIGHT, duration_s=1.5)]


def largest_difference(one, other) -> float:
    """Return the largest component of the pose differences, in m and rad alike."""
    return float(np.abs(se3_log(se3_inverse(one.trajectory.T_world_imu) @ other.trajectory.T_world_imu)).max())


@pytest.mark.parametrize("scenario", SCENARIOS, ids=lambda s: s.name)
@pytest.mark.parametrize("kind", [FixedLag, Smart, lambda setup, _: Isam2(setup)], ids=["fixed-lag", "smart", "isam2"])
def test_an_infinite_lag_is_the_batch(kind, scenario):
    """Held equal: packets, prior, stated noise, the motion's and the stereo factors, the gate that lets all pass.

    Not equal: the robust losses, Huber from the gate on against Cauchy. The errors are drawn at a tenth of the
    stated noise, where Huber weighs nothing down and Cauchy at c = 2 by 1 / (1 + 0.03 / 4), less than a hundredth:
    a hundredth of corrections of millimetres. The solvers differ, too; iSAM2 leaves a variable where it was
    linearised until it has moved by 0.01, which in metres or radians, squared, is the tolerance. Smart factors stop
    a fraction of a sigma short.
    """
    recording = recorded(replace(scenario, camera=replace(scenario.camera, max_tracks=30)), 0.1, seed=3)
    setup, duration_s = recording.setup, recording.sequence.duration_s
    endless, solver, filtered = kind(setup, 10.0 * duration_s), batch.build(setup), ekf.build(setup)
    for packet in recording.sequence.packets():
        for estimator in (endless, solver, filtered):
            estimator.step(packet)
    answer, filters_answer = solver.finish(), filtered.finish()
    assert answer.converged
    assert largest_difference(endless.finish(), answer) < 1e-4
    assert largest_difference(filters_answer, answer) > 1e-3, "there was something to agree on"
