"""How well an incremental smoother knows its landmarks, which decides what is an outlier to it."""

from dataclasses import replace

import msgspec
import numpy as np
import pytest

from filters.smoothing.outlier_check import KnownLandmarks, OutlierCheck
from toolkit.geometry import se3, transform
from toolkit.measurements import StereoFrame
from toolkit.models import stereo
from toolkit.models.motion import motion_model
from toolkit.models.state import Belief
from toolkit.settings import POLICIES
from toolkit.simulation import DRIVE, simulate

RIG, COUNT = DRIVE.rig, 4000
IDS = np.arange(COUNT)
AHEAD = np.array([1.0, 0.0, 0.0])
ROOT = np.linalg.cholesky(RIG.cov_uv_px2)


def landmarks_ahead() -> np.ndarray:
    """Return points (N, 3) at 20 to 30 m in front of the camera at the origin, so near that their errors are small."""
    rng = np.random.default_rng(0)
    places = np.column_stack([rng.uniform(-5.0, 5.0, (COUNT, 2)), rng.uniform(20.0, 30.0, COUNT)])
    return transform(RIG.T_imu_cam, places)


def pose_after(way_m: float) -> np.ndarray:
    return se3(np.eye(3), way_m * AHEAD)


def frame_from(T_world_imu: np.ndarray, points: np.ndarray, seed: int) -> StereoFrame:
    """Return what a camera sees of points, with the noise that is stated."""
    noise = np.random.default_rng(seed).standard_normal((COUNT, 3)) @ ROOT.T
    return StereoFrame(0, IDS, stereo.predict(points, T_world_imu, RIG).uv_px + noise)


def estimated(frames: list[tuple[StereoFrame, np.ndarray]], true: np.ndarray) -> np.ndarray:
    """Return the least-squares points (N, 3) of sightings from known poses, one Gauss-Newton step from the truth."""
    information, vector = np.zeros((COUNT, 3, 3)), np.zeros((COUNT, 3, 1))
    whitener = np.linalg.inv(ROOT)
    for frame, pose in frames:
        at = stereo.predict(true, pose, RIG)
        H = whitener @ at.d_uv_d_point
        information += np.swapaxes(H, 1, 2) @ H
        vector += np.swapaxes(H, 1, 2) @ (whitener @ (frame.uvs_px - at.uv_px)[..., None])
    return true + np.linalg.solve(information, vector)[..., 0]


@pytest.mark.parametrize("seen_from_m", [(0.0,), (0.0, 1.0), tuple(np.arange(0.0, 8.0))])
@pytest.mark.parametrize("way_m", [0.5, 12.0])
def test_the_gate_refuses_of_sound_sightings_what_it_says_however_often_a_landmark_was_seen(seen_from_m, way_m):
    """One in a hundred: of 4000 that is 40, with a standard deviation of 6."""
    true, landmarks = landmarks_ahead(), KnownLandmarks(RIG)
    frames = [(frame_from(pose_after(m), true, seed), pose_after(m)) for seed, m in enumerate(seen_from_m)]
    points = dict(zip(IDS.tolist(), estimated(frames, true), strict=True))
    for frame, pose in frames:
        landmarks.see(frame, points, pose)
    policy = msgspec.structs.replace(POLICIES["robust"], gate_probability=0.99)
    pose = pose_after(seen_from_m[-1] + way_m)
    refused = OutlierCheck(RIG, policy).outliers(frame_from(pose, true, 99), landmarks, certain_at(pose))
    assert 20 <= refused.sum() <= 62


def certain_at(T_world_imu: np.ndarray) -> Belief:
    """Return a state whose pose is exact."""
    sequence = simulate(replace(DRIVE, duration_s=1.0), 0)
    belief = motion_model(sequence.noise, sequence.gravity_world).initial_belief(sequence.prior)
    return replace(belief, T_world_imu=T_world_imu, cov=np.zeros((9, 9)))


def told_by(sightings: int) -> np.ndarray:
    """Return the covariance (3, 3) of a landmark seen so often from one place."""
    landmarks, point = KnownLandmarks(RIG), landmarks_ahead()[:1]
    uvs_px = stereo.predict(point, np.eye(4), RIG).uv_px
    for _ in range(sightings):
        landmarks.see(StereoFrame(0, IDS[:1], uvs_px), {0: point[0]}, np.eye(4))
    return landmarks.of([0])[1][0]


def test_a_sighting_without_the_right_image_leaves_the_depth_known():
    """Alone it determines no depth."""
    landmarks, point = KnownLandmarks(RIG), landmarks_ahead()[:1]
    both_px = stereo.predict(point, np.eye(4), RIG).uv_px
    for uvs_px in (both_px, both_px * [1.0, np.nan, 1.0]):
        landmarks.see(StereoFrame(0, IDS[:1], uvs_px), {0: point[0]}, np.eye(4))
    once, (cov,) = told_by(1), landmarks.of([0])[1]
    assert np.linalg.eigvalsh(once - cov).min() > -1e-9 * np.trace(once)


def test_a_landmark_that_was_dropped_starts_anew():
    landmarks, point = KnownLandmarks(RIG), landmarks_ahead()[:1]
    frame = StereoFrame(0, IDS[:1], stereo.predict(point, np.eye(4), RIG).uv_px)
    for _ in range(3):
        landmarks.see(frame, {0: point[0]}, np.eye(4))
    landmarks.keep({})
    assert 0 not in landmarks
    landmarks.move({0: point[0]})
    assert 0 not in landmarks, "only what is seen is known"
    landmarks.see(frame, {0: point[0]}, np.eye(4))
    np.testing.assert_allclose(landmarks.of([0])[1][0], told_by(1), rtol=1e-9)
