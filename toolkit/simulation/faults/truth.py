"""Faults of the truth: another unit, another clock, missing orientations."""

from dataclasses import replace

import numpy as np

from toolkit.errors import DataError
from toolkit.geometry import se3
from toolkit.sequence import Sequence, Truth


def truth_unit(sequence: Sequence, dose: float = 1000.0, seed: int = 0) -> Sequence:
    """Multiply the true positions and velocities by the dose: 1000 for millimetres."""
    truth = _truth_of(sequence)
    T_world_imu = se3(truth.T_world_imu[:, :3, :3], dose * truth.T_world_imu[:, :3, 3])
    v_world = None if truth.v_world is None else dose * truth.v_world
    return replace(sequence, truth=replace(truth, T_world_imu=T_world_imu, v_world=v_world))


def truth_clock_rate(sequence: Sequence, dose: float = 1.03, seed: int = 0) -> Sequence:
    """Multiply the time of the truth, from its first pose on, by the dose: a quartz of another temperature."""
    truth = _truth_of(sequence)
    since_ns = np.rint(dose * (truth.t_ns - truth.t_ns[0])).astype(np.int64)
    return replace(sequence, truth=replace(truth, t_ns=truth.t_ns[0] + since_ns))


def unwritten_orientations(sequence: Sequence, dose: float = 1.0, seed: int = 0) -> Sequence:
    """Write every true orientation as the identity: a file of positions alone. A dose of 0 leaves them."""
    truth = _truth_of(sequence)
    T_world_imu = se3(np.broadcast_to(np.eye(3), (len(truth.t_ns), 3, 3)), truth.T_world_imu[:, :3, 3])
    return replace(sequence, truth=replace(truth, T_world_imu=T_world_imu)) if dose else sequence


def _truth_of(sequence: Sequence) -> Truth:
    if sequence.truth is None:
        raise DataError(f"{sequence.name}: it has no truth that could be changed")
    return sequence.truth
