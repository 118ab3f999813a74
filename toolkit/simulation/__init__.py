"""Recordings with exact truth: a smooth trajectory, a world to look at, and sensors with known noise."""

from toolkit.simulation.scenarios import DRIVE, DRIVE_IMU, FLIGHT, SCENARIOS, Scenario, noise_free, simulate

__all__ = ["DRIVE", "DRIVE_IMU", "FLIGHT", "SCENARIOS", "Scenario", "noise_free", "simulate"]
