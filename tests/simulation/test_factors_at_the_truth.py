"""What sensors draw is what factors tell: at the simulated truth their chi-square is its degrees of freedom.

A filter predicts with the covariance its motion factor has, so this holds for both.
"""

from dataclasses import replace

import gtsam
import numpy as np
import pytest

from toolkit.estimate import Estimate
from toolkit.geometry import Array
from toolkit.models.gating import mahalanobis_squared
from toolkit.models.motion import motion_model
from toolkit.motion_samples import cut_at
from toolkit.sequence import Sequence
from toolkit.simulation import DRIVE, DRIVE_IMU, FLIGHT, Scenario, noise_free, simulate

SEEDS = range(8)
# The standard error of the mean of n squared unit normals is sqrt(2 / n): below 0.0055 with each n of this file.
TOLERANCE = 0.01


def without_tracks(scenario: Scenario) -> Scenario:
    return replace(scenario, camera=replace(scenario.camera, max_tracks=1))


def motion_chi2(sequence: Sequence) -> Array:
    """Return the chi-square (K - 1,) of each interval's factors at the true states, per degree of freedom."""
    model, truth = motion_model(sequence.noise, sequence.gravity_world), sequence.truth
    states = [
        Estimate(int(t_ns), truth.T_world_imu[k], v_world=truth.v_world[k], bias=truth.bias[k])
        for k, t_ns in enumerate(truth.t_ns)
    ]
    chi2 = []
    for packet in sequence.packets():
        if packet.motion is not None:
            values, k = gtsam.Values(), packet.index
            model.insert(values, states[k - 1], k - 1)
            model.insert(values, states[k], k)
            chi2.append(2.0 * model.integrate(packet.motion, truth.bias[k - 1]).factors(k).error(values))
    return np.array(chi2) / model.layout.size


@pytest.mark.parametrize(
    ("scenario", "duration_s"), [(DRIVE, 100.0), (DRIVE_IMU, 60.0), (FLIGHT, 40.0)], ids=["twist", "car-imu", "imu"]
)
def test_chi_square_of_the_motion_factors_is_one(scenario: Scenario, duration_s: float) -> None:
    scenario = without_tracks(replace(scenario, duration_s=duration_s))
    chi2 = np.concatenate([motion_chi2(simulate(scenario, seed)) for seed in SEEDS])
    assert chi2.mean() == pytest.approx(1.0, abs=TOLERANCE)


@pytest.mark.parametrize("scenario", [DRIVE, FLIGHT], ids=lambda s: s.name)
def test_chi_square_of_the_stereo_factors_is_one(scenario: Scenario) -> None:
    scenario = replace(scenario, duration_s=5.0)
    chi2 = []
    for seed in SEEDS:
        exact = simulate(noise_free(scenario), seed).observations.uv_px
        residuals_px = simulate(scenario, seed).observations.uv_px - exact
        chi2.append(mahalanobis_squared(residuals_px, np.broadcast_to(scenario.rig.cov_uv_px2, (len(exact), 3, 3))) / 3)
    assert np.concatenate(chi2).mean() == pytest.approx(1.0, abs=TOLERANCE)


def test_intervals_between_frames_share_no_sample_of_the_imu() -> None:
    """So that what they measure errs independently."""
    sequence = simulate(replace(DRIVE_IMU, duration_s=1.0), 0)
    motion = sequence.motion
    which = np.arange(motion.t_ns.size, dtype=float)[:, None]
    used = [rows[:, 0] for _, rows in cut_at(sequence.frames_t_ns, motion.t_ns, which, motion.pairing)]
    np.testing.assert_array_equal(np.concatenate(used), which[1:-1, 0])
    assert all(len(rows) == 10 for rows in used)
