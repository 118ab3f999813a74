"""Filters and smoothers read the same sightings with the same noise: the stated one over the weight of tracks.

Gate and loss are at the stated noise: a mismatch is one whatever sightings count.
"""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from toolkit import runner
from toolkit.answers import Run
from toolkit.estimate import Trajectory
from toolkit.geometry import se3_inverse, se3_log
from toolkit.registry import find, ladder
from toolkit.sequence import Sequence
from toolkit.settings import POLICIES, PolicyName, Settings
from toolkit.simulation import DRIVE, FLIGHT, simulate
from toolkit.verify import short

RECORDINGS = {"drive": short(DRIVE, 2.0), "flight": short(FLIGHT, 1.0)}
WEIGHT = 0.25
USING_TRACKS = [entry.name for entry in ladder() if entry.name != "dead-reckoning"]
# Where they linearise is chosen by the stated noise: fixed-lag and sliding-window place a state by its first sightings
# beside odometry, and isam2 chooses by it what it relinearises. Up to linearisation their answers are the same.
LINEARISED_ELSEWHERE = {("fixed-lag", "drive"), ("sliding-window", "drive"), ("isam2", "drive"), ("isam2", "flight")}


@cache
def recording(scenario: str) -> Sequence:
    return simulate(RECORDINGS[scenario], 3)


def with_noise(sequence: Sequence, weight: float, factor: float) -> Sequence:
    """Return a recording whose tracks have a weight and whose stated covariance is multiplied by a factor."""
    rig = replace(sequence.rig, track_weight=weight, cov_uv_px2=factor * sequence.rig.cov_uv_px2)
    return replace(sequence, rig=rig)


def run_on(name: str, sequence: Sequence, policy: PolicyName) -> Run:
    settings = Settings(outliers=POLICIES[policy])
    run = runner.run(name, find(name).load(), sequence, sequence.prior, settings=settings)
    assert run.status == "ok", run.log
    return run


def apart_in_sigmas(one: Trajectory, other: Trajectory) -> tuple[float, float]:
    """Return by how many standard deviations poses differ at most, and by which share of them covariances."""
    sigmas = np.sqrt(np.diagonal(other.cov, axis1=1, axis2=2))
    off = se3_log(se3_inverse(other.T_world_imu) @ one.T_world_imu) / sigmas[:, :6]
    covs = (one.cov - other.cov) / (sigmas[:, :, None] * sigmas[:, None, :])
    return float(np.abs(off).max()), float(np.abs(covs).max())


@pytest.mark.parametrize("scenario", RECORDINGS)
@pytest.mark.parametrize("name", USING_TRACKS)
def test_a_weight_is_an_update_by_the_stated_covariance_over_it(name: str, scenario: str) -> None:
    weighted, stated = (
        run_on(name, with_noise(recording(scenario), *noise), "none") for noise in ((WEIGHT, 1.0), (1.0, 1.0 / WEIGHT))
    )
    # The second order of errors that both make of each other's linearisation: some hundredths of a standard deviation.
    limit = 0.03 if (name, scenario) in LINEARISED_ELSEWHERE else 1e-7
    for one, other in ((weighted.causal, stated.causal), (weighted.final, stated.final)):
        assert (one is None) == (other is None)
        if one is not None and other is not None:
            assert max(apart_in_sigmas(one, other)) < limit
    plain = run_on(name, recording(scenario), "none")
    volumes = [np.linalg.slogdet(run.final.cov[-1, :6, :6])[1] for run in (weighted, plain)]
    assert volumes[0] > volumes[1] + 0.3, "a weight makes an estimator less certain"
    assert limit > 1e-3 or weighted.landmarks.points_world == pytest.approx(stated.landmarks.points_world, rel=1e-9)


def with_mismatches(sequence: Sequence) -> Sequence:
    """Return a recording of which one sighting in ten, first ones left alone, is off by a dozen pixels or less."""
    seen, rng = sequence.observations, np.random.default_rng(0)
    wrong = rng.random(len(seen)) < 0.1
    wrong[np.unique(seen.track_id, return_index=True)[1]] = False
    uv_px = seen.uv_px + wrong[:, None] * rng.normal(0.0, 6.0, (len(seen), 3))
    return replace(sequence, observations=replace(seen, uv_px=uv_px))


@pytest.mark.parametrize("name", ["ekf", "ekf-slam", "iekf", "msckf-slam"])
def test_the_gate_does_not_open_with_the_weight(name: str) -> None:
    """It opens by what the landmarks themselves are less certain; a larger covariance would open it altogether."""
    mismatched = with_mismatches(recording("flight"))

    def accepted(weight: float, factor: float) -> float:
        run = run_on(name, with_noise(mismatched, weight, factor), "robust")
        return float(np.sum(run.info["gate_accepted"]) / np.sum(run.info["gate_tested"]))

    plain, weighted, larger = accepted(1.0, 1.0), accepted(0.05, 1.0), accepted(1.0, 20.0)
    assert larger > 0.97
    assert weighted - plain < 0.5 * (larger - plain)
