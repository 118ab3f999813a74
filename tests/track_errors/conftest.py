from dataclasses import replace

import pytest

from toolkit.sequence import Sequence
from toolkit.simulation import SCENARIOS, noise_free, simulate
from toolkit.simulation.track_faults import match_offset, track_walk
from toolkit.track_errors import Fit, fit_track_noise

WALK_PX, OFFSET_PX = 0.13, 0.7


@pytest.fixture(scope="package")
def exact() -> Sequence:
    return simulate(replace(noise_free(SCENARIOS["drive"]), duration_s=12.0), 0)


@pytest.fixture(scope="package")
def walking(exact: Sequence) -> Sequence:
    return match_offset(track_walk(exact, WALK_PX, 1), OFFSET_PX, 2)


@pytest.fixture(scope="package")
def walking_fit(walking: Sequence) -> Fit:
    return fit_track_noise(walking)


@pytest.fixture(scope="package")
def white() -> Sequence:
    return simulate(replace(SCENARIOS["drive"], duration_s=10.0), 0)


@pytest.fixture(scope="package")
def white_fit(white: Sequence) -> Fit:
    return fit_track_noise(white)
