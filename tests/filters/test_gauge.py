"""No filter with first-estimate Jacobians learns where it is in the world or which way is north: nothing measures it.

Moving and turning everything about gravity changes no measurement. Where the filter is linearised so that this
holds for its Jacobians too, (1) the information along these four directions never exceeds the prior's, and (2) a
prior made looser along them gives the same estimates, looser by exactly as much at every step. Sources: Huang,
Mourikis & Roumeliotis 2010; Li & Mourikis 2013, section 4. The standard MSCKF on the same run fails both, in yaw.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial
from typing import NamedTuple

import numpy as np
import pytest

from filters import iekf
from filters.ekf_slam import JointEkf
from filters.kalman.coordinates import AnchoredBelief
from filters.kalman.joint import AtFirstEstimates, AtLatestEstimates, JointBelief, Linearisation, correct_by_landmarks
from filters.msckf import Msckf
from tests.filters.conftest import LOOSENESS, loosened, recorded, setup_of, short
from tests.filters.conftest import gauge as directions
from toolkit.estimator import Setup
from toolkit.geometry import Array
from toolkit.models.motion import motion_model
from toolkit.sequence import Sequence
from toolkit.simulation import DRIVE, FLIGHT

UP, YAW = np.eye(3)[:, 2:], 3

SCENARIOS = {"drive": replace(DRIVE, duration_s=3.0), "flight": replace(FLIGHT, duration_s=3.0)}
SCENARIOS = {name: replace(s, camera=replace(s.camera, max_tracks=25)) for name, s in SCENARIOS.items()}
FILTERS = {"ekf-slam": JointEkf, "msckf": Msckf, "msckf-slam": lambda setup, at: Msckf(setup, at, landmarks=15)}

every_scenario = pytest.mark.parametrize("scenario", SCENARIOS)
every_filter = pytest.mark.parametrize("name", FILTERS)


class Watched:
    """A linearisation that remembers the joint belief it serves."""

    def __init__(self, at) -> None:
        self._at = at
        self.joint = None

    def transition(self, joint, increment, prediction):
        self.joint = joint
        return self._at.transition(joint, increment, prediction)

    def __getattr__(self, name):
        return getattr(self._at, name)


class Answers(NamedTuple):
    """A filter's answers at every step: means (K, 4, 4), covariances (K, d, d), and the gauge (K, d, 4) it kept."""

    poses: Array
    covs: Array
    gauge: Array

    def information(self) -> Array:
        """Return the information (K, 4, 4) along the gauge."""
        return np.swapaxes(self.gauge, 1, 2) @ np.linalg.solve(self.covs, self.gauge)


@cache
def run(name: str, scenario: str, at: Callable[[], Linearisation], *, loose: bool) -> Answers:
    recording = recorded(SCENARIOS[scenario], 1.0)
    setup = recording.setup
    first = motion_model(setup.noise, setup.gravity_world).initial_belief(setup.prior)
    if loose:
        setup = replace(setup, prior=loosened(setup.prior, first, UP))
    return answers(name, setup, recording.sequence, at())


def answers(name: str, setup: Setup, sequence: Sequence, at: Linearisation) -> Answers:
    first, watched = motion_model(setup.noise, setup.gravity_world).initial_belief(setup.prior), Watched(at)
    under_test = FILTERS[name](setup, watched)
    poses, covs, gauge = [], [], []
    for packet in sequence.packets():
        estimate = under_test.step(packet)
        poses.append(estimate.T_world_imu)
        covs.append(estimate.cov)
        gauge.append(directions(JointBelief(watched.joint.first_core if watched.joint else first), UP))
    return Answers(np.array(poses), np.array(covs), np.array(gauge))


@every_scenario
def test_landmarks_that_start_anew_gain_no_information_about_position_and_yaw_either(scenario):
    information = run("ekf-slam", scenario, partial(AtFirstEstimates, most_moved=0.02), loose=True).information()
    root = np.linalg.cholesky(np.linalg.inv(information[0]))
    assert np.linalg.eigvalsh(root.T @ information @ root).max() < 1.0 + 1e-6


@every_scenario
@every_filter
def test_a_looser_start_stays_looser_by_exactly_as_much(name, scenario):
    """Then no correction depends on the gauge, and nothing is learnt of it.

    The estimates are the same, and the covariances differ by what was added.
    """
    tight, loose = (run(name, scenario, AtFirstEstimates, loose=loose) for loose in (False, True))
    np.testing.assert_allclose(loose.poses, tight.poses, rtol=0.0, atol=1e-6)
    added = (tight.gauge * LOOSENESS[:4] ** 2) @ np.swapaxes(tight.gauge, 1, 2)
    sigmas = np.sqrt(np.diagonal(loose.covs, axis1=1, axis2=2))
    assert np.abs((loose.covs - tight.covs - added) / (sigmas[:, :, None] * sigmas[:, None, :])).max() < 1e-6


@every_scenario
@every_filter
def test_jacobians_at_the_latest_estimates_invent_yaw(name, scenario):
    """The contrast that shows the tests above can fail: half as much again as the prior knew, or more."""
    information = run(name, scenario, AtLatestEstimates, loose=True).information()
    assert information[:, YAW, YAW].max() > 1.5 * information[0, YAW, YAW]


def most_information_gained(scenario, belief, correct) -> float:
    """Return by how much of the prior's the information along the gauge ever rises, at worst, in a run."""
    sequence = short(scenario, 3.0 if scenario is DRIVE else 2.0, 20, 3)
    setup = setup_of(sequence)
    # Without an accelerometer nothing measures the vertical either.
    turns = np.eye(3) if setup.motion_kind == "twist" else np.eye(3)[:, 2:]
    model = motion_model(setup.noise, setup.gravity_world)
    core = model.initial_belief(setup.prior)
    setup = replace(setup, prior=loosened(setup.prior, core, turns))
    along = directions(JointBelief(core), turns)
    first = along.T @ np.linalg.solve(model.initial_belief(setup.prior).cov, along)
    root = np.linalg.inv(np.linalg.cholesky(first))
    ekf, gained = JointEkf(setup, AtLatestEstimates(), belief(setup.rig), correct), -1.0
    for packet in sequence.packets():
        ekf.step(packet)
        along = directions(ekf.joint, turns)
        information = along.T @ np.linalg.solve(ekf.joint.cov, along)
        gained = max(gained, float(np.linalg.eigvalsh(root @ information @ root.T).max()) - 1.0)
    return gained


@pytest.mark.parametrize("scenario", [DRIVE, FLIGHT], ids=["twist", "imu"])
def test_at_latest_estimates_none_is_gained_in_invariant_errors_but_in_plain_ones(scenario) -> None:
    """Of the whole joint belief, landmarks included; after marginalising them less is left."""
    for correct in (correct_by_landmarks, iekf.correct):
        # The condition of a joint covariance is some 1e9: seven digits of the information are left.
        gained = most_information_gained(
            scenario, lambda rig: partial(AnchoredBelief, T_imu_cam=rig.T_imu_cam), correct
        )
        assert gained < 1e-6
    assert most_information_gained(scenario, lambda rig: JointBelief, correct_by_landmarks) > 0.01
