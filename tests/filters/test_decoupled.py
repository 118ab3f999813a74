"""The decoupled filter: the report's corrections, the map that is kept of what is in view, and its gate."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest

from filters.ekf import correct_pose
from filters.kalman.landmark_map import LandmarkMap, TrackedMap, correct_landmarks
from toolkit.geometry import Array, se3_exp
from toolkit.measurements import StereoFrame
from toolkit.models import stereo
from toolkit.models.gating import FrameGate, chi2_bound, huber_weights, mahalanobis_squared
from toolkit.models.state import IMU_LAYOUT, TWIST_LAYOUT, Belief, Layout
from toolkit.simulation import DRIVE

RIG = DRIVE.rig
N = 60
PROBABILITY, HUBER = 0.95, 1.5
# Both forms invert matrices whose condition is about 1e6 here: nine digits are left of sixteen.
RELATIVE = 1e-9

each_layout = pytest.mark.parametrize("layout", [TWIST_LAYOUT, IMU_LAYOUT], ids=["twist", "imu"])


class Scene(NamedTuple):
    """A belief, a map drawn from its own covariances, and noisy sightings (N, 3) px of it."""

    belief: Belief
    landmarks: LandmarkMap
    uvs_px: Array


def correlated(size: int, rng: np.random.Generator) -> Array:
    """Return a covariance with correlations of every pair."""
    root = np.eye(size) + 0.3 * rng.standard_normal((size, size))
    covariance: Array = root @ root.T
    return covariance


def scene(layout: Layout, seed: int = 1) -> Scene:
    rng = np.random.default_rng(seed)
    true_pose = se3_exp(np.array([0.1, -0.2, 1.3, 20.0, -7.0, 2.0]))
    cov = np.diag(np.full(layout.size, 0.02)) @ correlated(layout.size, rng) @ np.diag(np.full(layout.size, 0.02))
    depth_m = rng.uniform(5.0, 25.0, N)
    points_cam = np.stack([rng.uniform(-0.6, 0.6, N) * depth_m, rng.uniform(-0.2, 0.2, N) * depth_m, depth_m], axis=1)
    T_world_cam = true_pose @ RIG.T_imu_cam
    points = points_cam @ T_world_cam[:3, :3].T + T_world_cam[:3, 3]
    covs = np.array([0.05**2 * correlated(3, rng) for _ in range(N)])
    noise_px = rng.standard_normal((N, 3)) @ np.linalg.cholesky(RIG.cov_uv_px2).T
    uvs_px = stereo.predict(points, true_pose, RIG).uv_px + noise_px
    guessed = points + np.einsum("nij,nj->ni", np.linalg.cholesky(covs), rng.standard_normal((N, 3)))
    root = np.linalg.cholesky(cov)
    T_world_imu = true_pose @ se3_exp(root[:6] @ rng.standard_normal(layout.size))
    belief = Belief(layout, T_world_imu, np.array([5.0, 1.0, 0.2]), np.zeros(6), cov)
    return Scene(belief, LandmarkMap(np.arange(N), guessed, covs), uvs_px)


@each_layout
def test_pose_correction_is_the_reports_update_with_the_weights_and_gates_it_reports(layout):
    """In the form of information, against Kang's eqs. 12-14: the gain with all measurements in one matrix."""
    belief, landmarks, uvs_px = scene(layout)
    uvs_px[::7] += 80.0
    gate = FrameGate(PROBABILITY, HUBER)
    corrected, accepted = correct_pose(belief, landmarks, uvs_px, RIG, gate)
    assert not accepted[::7].any()
    predicted = stereo.predict(landmarks.points, belief.T_world_imu, RIG)
    residual_px = uvs_px - predicted.uv_px
    own_cov = RIG.cov_uv_px2 + predicted.d_uv_d_point @ landmarks.covs @ np.swapaxes(predicted.d_uv_d_point, 1, 2)
    innovation_cov = own_cov + predicted.d_uv_d_pose @ belief.cov[:6, :6] @ np.swapaxes(predicted.d_uv_d_pose, 1, 2)
    nis = np.array([r @ np.linalg.inv(S) @ r for r, S in zip(residual_px, innovation_cov, strict=True)])
    np.testing.assert_array_equal(accepted, nis < chi2_bound(3, PROBABILITY))
    assert (gate.tested, gate.accepted, gate.dof) == (N, accepted.sum(), 3 * accepted.sum())
    assert gate.nis == pytest.approx(nis[accepted].sum(), rel=RELATIVE)
    weights = huber_weights(mahalanobis_squared(residual_px, own_cov), HUBER)
    kept = np.flatnonzero(accepted)
    noise = np.zeros((3 * kept.size, 3 * kept.size))
    for row, i in enumerate(kept):
        noise[3 * row : 3 * row + 3, 3 * row : 3 * row + 3] = own_cov[i] / weights[i]
    H = np.zeros((3 * kept.size, layout.size))
    H[:, :6] = predicted.d_uv_d_pose[kept].reshape(-1, 6)
    gain = belief.cov @ H.T @ np.linalg.inv(H @ belief.cov @ H.T + noise)
    correction = gain @ residual_px[kept].ravel()
    expected, largest = (
        belief.moved(correction, (np.eye(layout.size) - gain @ H) @ belief.cov),
        np.abs(correction).max(),
    )
    np.testing.assert_allclose(corrected.cov, expected.cov, rtol=0.0, atol=RELATIVE * np.abs(expected.cov).max())
    for name in ("T_world_imu", "v_world", "bias"):
        np.testing.assert_allclose(getattr(corrected, name), getattr(expected, name), rtol=0.0, atol=RELATIVE * largest)


def test_landmark_correction_is_a_kalman_update_of_each_landmark_alone_to_which_a_doubtful_pose_is_noise():
    """Kang, eqs. 8-10; with a pose that is known they are proved by the report's whole filter (test_seed_ekf.py)."""
    belief, landmarks, uvs_px = scene(TWIST_LAYOUT)
    pose_cov = belief.cov[:6, :6]
    corrected, nis, _ = correct_landmarks(landmarks, uvs_px, belief.T_world_imu, pose_cov, RIG)
    predicted = stereo.predict(landmarks.points, belief.T_world_imu, RIG)
    for i in range(N):
        H, H_pose, P = predicted.d_uv_d_point[i], predicted.d_uv_d_pose[i], landmarks.covs[i]
        innovation_cov = H @ P @ H.T + RIG.cov_uv_px2 + H_pose @ pose_cov @ H_pose.T
        gain = P @ H.T @ np.linalg.inv(innovation_cov)
        residual = uvs_px[i] - predicted.uv_px[i]
        expected = landmarks.points[i] + gain @ residual
        np.testing.assert_allclose(corrected.points[i], expected, atol=RELATIVE)
        expected_cov = (np.eye(3) - gain @ H) @ P
        tolerance = RELATIVE * np.abs(P).max()
        np.testing.assert_allclose(corrected.covs[i], expected_cov, rtol=0.0, atol=tolerance)
        assert nis[i] == pytest.approx(residual @ np.linalg.inv(innovation_cov) @ residual, rel=RELATIVE)


POSE = se3_exp(np.array([0.1, -0.2, 1.3, 20.0, -7.0, 2.0]))


def frame_of(ids: list[int], u_left: float = 400.0) -> StereoFrame:
    uvs_px = np.array([[u_left + i, u_left + i - 40.0, 150.0 + i] for i in ids]).reshape(-1, 3)
    return StereoFrame(0, np.array(ids, dtype=np.int64), uvs_px)


def take_in(tracked: TrackedMap, frame: StereoFrame, moved_m: float = 0.0) -> list[int]:
    """Take in a frame, all landmarks that are seen again corrected by so much, and return the ids of these."""
    seen, _ = tracked.seen_again(frame)
    tracked.keep(replace(seen, points=seen.points + moved_m), frame, POSE)
    return seen.track_ids.tolist()


def test_a_lost_landmark_keeps_its_last_value_until_its_id_comes_back_as_a_new_one() -> None:
    tracked, first, returned = TrackedMap(RIG), frame_of([4, 7]), frame_of([4], u_left=500.0)
    assert take_in(tracked, first) == []
    assert take_in(tracked, frame_of([7], u_left=450.0), moved_m=0.5) == [7]
    assert take_in(tracked, frame_of([])) == []
    began = stereo.triangulate_world(first.uvs_px, POSE, RIG)
    landmarks = tracked.landmarks()
    assert landmarks.track_ids.tolist() == [4, 7]
    np.testing.assert_allclose(landmarks.points_world, np.add(began, [[0.0], [0.5]]), atol=1e-12)
    assert take_in(tracked, returned) == []
    anew = np.vstack([stereo.triangulate_world(returned.uvs_px, POSE, RIG), began[1] + 0.5])
    np.testing.assert_allclose(tracked.landmarks().points_world, anew, atol=1e-12)
