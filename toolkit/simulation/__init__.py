"""Simulated recordings with exact truth: a smooth trajectory, landmarks to look at, and sensors with known noise.

Read ``scenarios`` (what is simulated, and ``simulate``), then ``scenes`` (trajectory and landmarks of each),
``trajectory`` (B-splines), ``world`` (visibility and tracks) and ``sensors`` (noise). ``faults`` and ``track_faults``
plant what goes wrong; ``symmetries`` tell a recording otherwise. ``filming`` takes images instead of tracks, with
``surfaces`` (what there is to see) and ``renderer``, and tells how far tracks made of them are off.
"""

from toolkit.simulation import faults, symmetries, track_faults
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
    "symmetries",
    "track_faults",
]
