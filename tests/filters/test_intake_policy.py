"""What an estimator takes in: how near a point must be to become a landmark, and how long the past stays open."""

from dataclasses import replace

import numpy as np
import pytest

from toolkit.geometry import se3_inverse, transform
from toolkit.models import stereo
from toolkit.sequence import Observations, Sequence, is_held_out
from toolkit.settings import DEFAULTS, Settings, Window
from toolkit.simulation import DRIVE, DRIVE_IMU, Scenario, simulate
from toolkit.simulation.scenarios import noise_free

RATE_HZ = 10.0


def default_lag_s(scenario: Scenario) -> float:
    return DEFAULTS.window.seconds("imu" if scenario is DRIVE_IMU else "twist")


@pytest.fixture(scope="module")
def exact():
    return simulate(noise_free(replace(DRIVE, duration_s=0.6)), 0)


def with_points(sequence: Sequence, points: np.ndarray) -> tuple[Sequence, list[int]]:
    """Add exact sightings of points (N, 3) in the world from every frame; return their tracks too."""
    seen, poses = sequence.observations, sequence.truth.T_world_imu
    free = np.arange(10**6, 10**6 + 100)
    ids = free[~is_held_out(free)][: len(points)]
    T_cam_world = se3_inverse(poses @ sequence.rig.T_imu_cam)
    uv_px = np.concatenate([stereo.project(transform(T, points), sequence.rig) for T in T_cam_world])
    frame = np.concatenate([seen.frame, np.repeat(np.arange(len(poses)), len(points))])
    track = np.concatenate([seen.track_id, np.tile(ids, len(poses))])
    everything = Observations.sorted(frame, track, np.concatenate([seen.uv_px, uv_px]))
    return replace(sequence, observations=everything), ids.tolist()


# One of each kind of map: the decoupled filters', the joint filters', the windowed filters' and each smoother's.
MAPS = ("ekf", "ekf-slam", "msckf", "msckf-slam", "fixed-lag", "isam2", "smart", "batch")


@pytest.mark.parametrize("name", MAPS)
def test_a_landmark_has_a_disparity_of_a_pixel_or_more(exact, run_estimator, name):
    """With less, a pixel of noise is worth more than the depth itself. The car drives 6 m: 1.2 px stays below 1.3."""
    rig = exact.rig
    ahead = np.array([[0.0, 0.0, rig.fx_px * rig.baseline_m / disparity_px] for disparity_px in (0.8, 1.2)])
    sequence, (far, near) = with_points(exact, transform(exact.truth.T_world_imu[0] @ rig.T_imu_cam, ahead))
    # A window short enough for tracks to leave it.
    known = run_estimator(name, sequence, settings=Settings(window=Window(lag_s=0.45))).landmarks.track_ids
    assert near in known
    assert far not in known


@pytest.mark.parametrize("scenario", [DRIVE, DRIVE_IMU], ids=["twist", "imu"])
def test_a_track_corrects_the_window_once_its_first_pose_is_older_than_the_lag(run_estimator, scenario):
    """Whatever moves the IMU, as in the smoothers; a pose adds three rows to a track."""
    lag_s = default_lag_s(scenario)
    sequence = simulate(noise_free(replace(scenario, duration_s=lag_s + 0.4)), 0)
    poses = round(lag_s * RATE_HZ) + 2
    seen = sequence.observations
    at_first = seen.track_id[seen.frame == 0]
    longest = max(at_first[~is_held_out(at_first)], key=lambda i: int((seen.track_id == i).sum()))
    alone = replace(sequence, observations=seen.select(seen.track_id == longest))
    dof = run_estimator("msckf", alone).info["nis_dof"]
    assert int(np.flatnonzero(dof > 0)[0]) == poses - 1
    assert dof.max() == 3 * poses - 3


@pytest.mark.parametrize("name", ["fixed-lag", "smart"])
def test_a_state_is_open_to_what_is_seen_within_the_lag(run_estimator, name):
    """All sightings of a frame are moved by 2 px: a pose changes that is in the window then, and no older one."""
    sequence = simulate(replace(DRIVE, duration_s=3.0), 0)
    seen, changed = sequence.observations, 28
    moved = seen.uv_px + np.where(seen.frame == changed, 1.0, 0.0)[:, None] * np.array([2.0, 2.0, 0.0])
    as_is = run_estimator(name, sequence).final.T_world_imu
    otherwise = run_estimator(name, replace(sequence, observations=replace(seen, uv_px=moved))).final.T_world_imu
    changed_poses = np.flatnonzero((as_is != otherwise).any(axis=(1, 2)))
    within = changed - round(default_lag_s(DRIVE) * RATE_HZ)
    assert within - 1 <= changed_poses[0] <= within + 1
