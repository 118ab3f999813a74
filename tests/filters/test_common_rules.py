"""What an estimator's RULES say of the parts of the noise model holds: a part it obeys decides, another does not."""

from dataclasses import replace

import numpy as np
import pytest

from toolkit import runner
from toolkit.estimator import find, ladder
from toolkit.geometry import Array
from toolkit.sequence import Sequence
from toolkit.settings import Noise, Settings
from toolkit.simulation import SCENARIOS, simulate

USING_TRACKS = [entry.name for entry in ladder() if entry.name != "dead-reckoning"]


@pytest.fixture(scope="module")
def realistic() -> Sequence:
    return simulate(replace(SCENARIOS["drive-realistic"], duration_s=2.0), 3)


def poses(name: str, sequence: Sequence, noise: Noise) -> Array:
    assert sequence.prior is not None
    settings = Settings(noise=noise, arithmetic="numpy")
    run = runner.run(name, find(name).load(), sequence, sequence.prior, settings=settings)
    assert run.final is not None, run.log
    return run.final.T_world_imu


@pytest.mark.parametrize("name", USING_TRACKS)
def test_correlated_tracks_count_for_less_in_those_estimators_that_say_so(name: str, realistic: Sequence) -> None:
    apart = poses(name, realistic, Noise()) - poses(name, realistic, Noise(match_tracks=False))
    assert (np.abs(apart).max() > 1e-6) == find(name).obeys("match_tracks")


@pytest.mark.parametrize("name", ["riekf", "iekf"])
def test_beside_an_imu_they_count_for_less_in_those_that_obey_there_alone(name: str) -> None:
    flown = simulate(replace(SCENARIOS["flight-realistic"], duration_s=1.0), 3)
    assert np.abs(poses(name, flown, Noise()) - poses(name, flown, Noise(match_tracks=False))).max() > 1e-6
    assert find(name).obeys("match_tracks", "imu")
