"""What the decoupled filter keeps of a filter's promises, though it drops the cross-covariances: its gate."""

from dataclasses import replace

import numpy as np
import pytest

from filters.ekf import DecoupledEkf, as_uncertain_as_stated
from toolkit import runner
from toolkit.sequence import Sequence
from toolkit.simulation import DRIVE, DRIVE_IMU, FLIGHT, simulate


def filter_of(sequence: Sequence) -> DecoupledEkf:
    prior = sequence.prior
    return DecoupledEkf(runner.setup_of(sequence, prior), as_uncertain_as_stated)


def accepted_share(sequence: Sequence) -> float:
    """Return the share of sightings of known landmarks that pass the gate, over a whole run."""
    ekf = filter_of(sequence)
    info = [ekf.step(packet).info for packet in sequence.packets()]
    return sum(i["gate_accepted"] for i in info) / sum(i["gate_tested"] for i in info)


@pytest.mark.parametrize(
    ("scenario", "least"),
    # A consistent filter passes 99 %. Without cross-covariances ours is too sure of its pose: measured over seeds, it
    # passes 98.7 % on the drive, 98.8 % in flight, and on the IMU drive, where velocity and biases are too sure as
    # well, 97.4 %. Less would mean that it starves itself of measurements.
    [(DRIVE, 0.98), (FLIGHT, 0.98), (DRIVE_IMU, 0.95)],
    ids=["drive", "flight", "drive-imu"],
)
def test_the_gate_lets_the_inliers_of_a_simulated_run_pass(scenario, least):
    share = np.mean([accepted_share(simulate(replace(scenario, duration_s=30.0), seed)) for seed in range(2)])
    assert least < share < 0.994
