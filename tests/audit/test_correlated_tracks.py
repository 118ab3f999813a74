"""Tracks whose errors are not each by itself: the correlation of neighbouring steps is the one that theory gives."""

from dataclasses import replace

import numpy as np
import pytest

from toolkit.audit import audit
from toolkit.audit.fault import Evidence
from toolkit.models.stereo import CHANNELS
from toolkit.sequence import Sequence
from toolkit.simulation import SCENARIOS, faults, simulate
from toolkit.simulation.sensors import TrackNoise, with_track_noise


@pytest.fixture(scope="module")
def flight() -> Sequence:
    return simulate(replace(SCENARIOS["flight"], duration_s=4.0), 3)


def reported(sequence: Sequence) -> list[str]:
    return [finding.detail for finding in audit(sequence).findings if finding.fault == "correlated-tracks"]


@pytest.mark.parametrize("walk_px", [0.0, 1.0, 4.0])
def test_the_correlation_of_neighbouring_steps_is_that_of_white_noise_and_a_walk(
    flight: Sequence, walk_px: float
) -> None:
    # No walk of the disparity: what that does to the depth, and so to later steps, theory leaves out.
    walk = TrackNoise(np.zeros(3), walk_px * np.array([1.0, 0.0, 1.0]), np.zeros(3))
    observations = with_track_noise(flight.observations, walk, np.random.default_rng(3))
    sequence = replace(flight, observations=observations)
    to_pixels = np.linalg.inv(CHANNELS)
    walk_px2 = to_pixels @ np.diag(walk.walk_px**2) @ to_pixels.T  # of (uL, uR, v)
    expected = -1.0 / (2.0 + np.trace(np.linalg.solve(sequence.rig.cov_uv_px2, walk_px2)) / 3.0)
    # The camera's motion is fitted to the tracks and takes some of it: 0.04 at most under three seeds.
    found = Evidence(sequence).step_correlation
    assert found is not None
    assert found.value == pytest.approx(expected, abs=0.06)


def test_tracks_with_a_walk_or_an_offset_of_their_own_are_reported_and_white_ones_are_not(flight: Sequence) -> None:
    drive = simulate(replace(SCENARIOS["drive"], duration_s=6.0), 3)
    assert reported(flight) == reported(drive) == []
    assert "where independent errors have -0.5" in reported(faults.track_walk(flight, 4.0, 3))[0]
    assert reported(faults.match_offset(drive, 3.0, 3))


def test_tracks_without_errors_are_left_alone() -> None:
    assert reported(simulate(replace(SCENARIOS["flight"], duration_s=4.0, noise_scale=0.0), 3)) == []
