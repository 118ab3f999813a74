"""A trajectory that contradicts the measured motion is told from one that works, without any truth."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from toolkit.answers import Run
from toolkit.divergence import MOST_FAR_STEPS, contradiction, gate_collapse
from toolkit.estimate import Trajectory
from toolkit.geometry import Array, se3_exp, se3_inverse
from toolkit.sequence import Sequence
from toolkit.simulation import DRIVE, DRIVE_IMU, FLIGHT, simulate

SCENARIOS = {"drive": DRIVE, "drive-imu": DRIVE_IMU, "flight": FLIGHT}
every_scenario = pytest.mark.parametrize("scenario", SCENARIOS)


# A recording has 100 or 200 frames; that a smoother works shows in fewer.
FRAMES = {"batch": 60}


@cache
def recording(scenario: str, seed: int = 0) -> Sequence:
    return simulate(replace(SCENARIOS[scenario], duration_s=10.0), seed)


def seen_by(name: str, scenario: str) -> Sequence:
    return recording(scenario).truncated(FRAMES.get(name, 10**6))


@pytest.fixture(scope="module")
def run_on(run_estimator: Callable[..., Run]) -> Callable[[str, str], Run]:
    """Return a function that runs an estimator once on a scenario."""
    return cache(lambda name, scenario: run_estimator(name, seen_by(name, scenario)))


def jumping(trajectory: Trajectory, share: float, jump: Array) -> Trajectory:
    """Return the trajectory with a jump (6,), in the body frame, at the end of a share of its steps."""
    steps = se3_inverse(trajectory.T_world_imu[:-1]) @ trajectory.T_world_imu[1:]
    struck = np.random.default_rng(3).uniform(size=len(steps)) < share
    poses = [trajectory.T_world_imu[0]]
    for step, jumps in zip(steps, struck, strict=True):
        poses.append(poses[-1] @ step @ se3_exp(jump if jumps else np.zeros(6)))
    return replace(trajectory, T_world_imu=np.stack(poses))


@every_scenario
@pytest.mark.parametrize("name", ["dead-reckoning", "ekf", "batch"])
def test_a_run_that_works_contradicts_nothing(name, scenario, run_on):
    assert contradiction(run_on(name, scenario).final, seen_by(name, scenario)) is None
    truth = recording(scenario, seed=1).truth
    exact = Trajectory(truth.t_ns, truth.T_world_imu, truth.v_world, truth.bias)
    assert contradiction(exact, recording(scenario, seed=1)) is None


# Fifty standard deviations of a drive's step (0.016 m) and of a flight's.
JUMP_M = np.array([0.0, 0.0, 0.0, 0.0, 0.8, 0.0])
TURN = np.array([0.0, 0.0, 0.2, 0.0, 0.0, 0.0])


@every_scenario
@pytest.mark.parametrize("jump", [JUMP_M, TURN], ids=["position", "heading"])
def test_jumps_in_a_fifth_of_the_steps_are_a_contradiction_and_a_few_are_not(scenario, jump, run_on):
    sequence = recording(scenario)
    spoiled = jumping(run_on("ekf", scenario).causal, 0.2, jump)
    reason = contradiction(spoiled, sequence)
    assert "contradict the measured motion" in reason
    assert int(reason.split()[0]) > 15 and f"at most {100 * MOST_FAR_STEPS:.0f} %" in reason
    few = jumping(run_on("ekf", scenario).causal, 0.02, jump)
    assert contradiction(few, sequence) is None


@every_scenario
@pytest.mark.parametrize("leap_m", [1e5, 1e20])
def test_a_single_leap_beyond_what_the_measured_motion_goes_is_a_contradiction(scenario, leap_m, run_on):
    causal = run_on("dead-reckoning", scenario).causal
    poses = causal.T_world_imu.copy()
    poses[-5:, 1, 3] += leap_m
    reason = contradiction(replace(causal, T_world_imu=poses), recording(scenario))
    assert ("farther away than the Moon" if leap_m > 1e9 else "and the measured motion covers") in reason


@pytest.mark.parametrize(("ways", "is_one"), [(1.9, False), (2.1, True)])
def test_twice_the_way_that_odometry_measured_is_in_reach(ways, is_one):
    """Straight ahead at 10 m/s for 10 s, ten metres beside what no correction is."""
    sequence = recording("drive")
    values = np.tile([10.0, 0.0, 0.0, 0.0, 0.0, 0.0], (len(sequence.motion.t_ns), 1))
    straight = replace(sequence, motion=sequence.motion.of(sequence.motion.t_ns, values))
    poses = np.tile(np.eye(4), (sequence.frame_count, 1, 1))
    gone_s = sequence.frames_s - sequence.frames_s[0]
    poses[:, 0, 3] = 10.0 * gone_s
    poses[-1, 0, 3] = 10.0 + ways * 10.0 * gone_s[-1]
    found = contradiction(Trajectory(sequence.frames_t_ns, poses), straight)
    assert (found is not None) == is_one


@pytest.mark.parametrize(("jump_m", "is_one"), [(0.1, False), (5.0, True)])
def test_jumps_of_half_a_hundredth_of_what_the_pose_is_uncertain_by_are_no_contradiction(jump_m, is_one, run_on):
    """Twenty metres: a state far from its start, which jumps as the whole way behind it turns a little."""
    causal = run_on("dead-reckoning", "drive").causal
    vague = causal.cov.copy()
    vague[:, 3:6, 3:6] += 20.0**2 * np.eye(3)
    poses = causal.T_world_imu.copy()
    poses[1::2, 1, 3] += jump_m
    found = contradiction(replace(causal, T_world_imu=poses, cov=vague), recording("drive"))
    assert (found is not None) == is_one


def test_a_pose_that_is_not_a_number_is_a_contradiction():
    sequence = recording("drive")
    poses = sequence.truth.T_world_imu.copy()
    poses[17:, 0, 3] = np.inf
    reason = contradiction(Trajectory(sequence.truth.t_ns, poses), sequence)
    assert reason == "its poses are not numbers from estimate 17 on"


@pytest.mark.parametrize("count", [0, 1])
def test_a_trajectory_without_a_step_contradicts_nothing(count):
    sequence = recording("drive")
    truth = sequence.truth
    assert contradiction(Trajectory(truth.t_ns[:count], truth.T_world_imu[:count]), sequence) is None


def gated(share: float, share_in_the_end: float, tested: int = 20) -> dict[str, Array]:
    tested_of = np.full(100, float(tested))
    return {"gate_tested": tested_of, "gate_accepted": tested_of * np.repeat([share, share_in_the_end], [75, 25])}


@pytest.mark.parametrize(
    ("share", "in_the_end", "reason"),
    [
        (0.06, 0.06, "6 % of its measurements passed its own gate"),
        (0.95, 0.1, "10 % of its last quarter's"),
        (0.65, 0.5, None),  # on a rough recording
    ],
)
def test_a_filter_that_rejects_nearly_all_measurements_has_diverged(share, in_the_end, reason):
    assert gate_collapse(gated(0.0, 0.0, tested=1)) is gate_collapse({}) is None  # a few rejections are no sign
    found = gate_collapse(gated(share, in_the_end))
    assert found is None if reason is None else found.startswith(reason)


def test_tracks_tested_as_a_whole_may_fail_more_often_than_sightings_for_outliers_spoil_all_of_one():
    """One sighting in ten of tracks of 12 sightings: 0.9^12 = 28 % of them are without an outlier."""
    few = gated(0.23, 0.23)
    of_sightings, of_tracks = ({**few, "nis_dof": dof * few["gate_accepted"]} for dof in (3.0, 33.0))
    assert gate_collapse(of_sightings).endswith("(at least 30 % pass in a run that works)")
    assert gate_collapse(of_tracks) is None
    collapsed = gated(0.23, 0.05)
    assert "at least 9 % pass" in gate_collapse({**collapsed, "nis_dof": 33.0 * collapsed["gate_accepted"]})


def test_a_filter_of_tracks_with_outliers_that_is_millimetres_off_has_not_diverged(run_estimator):
    """Its tracks last, and one sighting in ten is an outlier: most tracks have one."""
    camera = replace(FLIGHT.camera, max_tracks=40, loss_per_frame=0.0, outlier_rate=0.1)
    sequence = simulate(replace(FLIGHT, camera=camera, duration_s=6.0), 0)
    run = run_estimator("msckf-fej", sequence)
    accepted, tested = run.info["gate_accepted"].sum(), run.info["gate_tested"].sum()
    assert tested > 200
    assert accepted < 0.3 * tested
    assert gate_collapse(run.info) is None
    off_m = run.causal.T_world_imu[:, :3, 3] - sequence.truth.T_world_imu[:, :3, 3]
    assert np.abs(off_m).max() < 0.05
