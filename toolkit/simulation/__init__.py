"""Simulated recordings with exact truth: a smooth trajectory, landmarks to look at, and sensors with known noise.

Read ``scenarios`` (what is simulated, and ``simulate``), then ``scenes`` (trajectory and landmarks of each),
``trajectory`` (B-splines) and ``sensors`` (visibility, tracks and noise). ``faults`` plants faults in a recording.
``filming`` renders images instead of tracks, with ``renderer`` (which has the visible world), and measures the
errors of tracks made of them.
"""

from toolkit.simulation import faults
from toolkit.simulation.scenarios import (
    DRIVE,
    DRIVE_IMU,
    DRIVE_REALISTIC,
    FLIGHT,
    FLIGHT_REALISTIC,
    SCENARIOS,
    Scenario,
    noise_free,
    simulate,
)

__all__ = [
    "DRIVE",
    "DRIVE_IMU",
    "DRIVE_REALISTIC",
    "FLIGHT",
    "FLIGHT_REALISTIC",
    "SCENARIOS",
    "Scenario",
    "faults",
    "noise_free",
    "simulate",
]
