"""What is compiled of the decoupled filter computes what its NumPy does: NumPy is the definition."""

import numpy as np
import pytest

from filters.kalman import correction, landmark_map
from filters.kalman.compiled import decoupled_steps
from filters.kalman.frame_gate import FrameGate
from filters.kalman.landmark_map import LandmarkMap
from toolkit.compilation import Compilation
from toolkit.geometry import read_only, se3_exp, transform
from toolkit.measured_motion import TwistMotion, TwistNoise
from toolkit.models import stereo
from toolkit.models.imu import IMU_LAYOUT
from toolkit.models.motion import predicted
from toolkit.models.state import Belief
from toolkit.models.twist import TWIST_LAYOUT, TwistModel
from toolkit.simulation import DRIVE

N = 40
# Both round at 1e-16 of terms that cancel by up to a million.
TOLERANCE = 1e-9
NOISE = TwistNoise(np.array([0.1, 0.2, 0.3]), np.array([0.01, 0.02, 0.03]), np.array([1e-3, 2e-3, 3e-3]))


@pytest.fixture(scope="module")
def compiled():
    pytest.importorskip("numba", reason="the extra 'fast' is not installed: there is nothing compiled to compare")

    return decoupled_steps(TwistModel(NOISE), NOISE, Compilation("compiled"))


def belief_of(layout, seed=3) -> Belief:
    """Return a belief whose errors are all correlated, in arrays by columns, as GTSAM gives them, or read-only."""
    rng = np.random.default_rng(seed)
    root = 0.02 * (np.eye(layout.size) + 0.3 * rng.standard_normal((layout.size, layout.size)))
    pose = np.asfortranarray(se3_exp(np.array([0.1, -0.2, 1.3, 20.0, -7.0, 2.0])))
    pose.flags.writeable = False
    bias = read_only(rng.normal(scale=0.01, size=6))
    return Belief(layout, pose, np.array([5.0, 1.0, 0.2]), bias, np.asfortranarray(root @ root.T))


def landmarks_and_sightings(belief: Belief, left_only: bool):
    """Return landmarks and noisy sightings of them: some of other points, one behind the camera, some by one image."""
    rng, rig = np.random.default_rng(4), DRIVE.rig
    depth_m = rng.uniform(5.0, 25.0, N)
    rays = np.stack([rng.uniform(-0.6, 0.6, N), rng.uniform(-0.2, 0.2, N), np.ones(N)], axis=1)
    points = transform(belief.T_world_imu @ rig.T_imu_cam, rays * depth_m[:, None])
    uvs_px = stereo.predict(points, belief.T_world_imu, rig).uv_px
    uvs_px += rng.standard_normal((N, 3)) @ np.linalg.cholesky(rig.cov_uv_px2).T
    uvs_px[:5] += [40.0, -30.0, 25.0]
    points[5] = transform(belief.T_world_imu @ rig.T_imu_cam, np.array([0.0, 0.0, -4.0]))
    if left_only:
        uvs_px[[1, 7, 8, 20], 1] = np.nan
    roots = 0.05 * (np.eye(3) + 0.3 * rng.standard_normal((N, 3, 3)))
    points += np.einsum("nij,nj->ni", roots, rng.standard_normal((N, 3)))
    return LandmarkMap(np.arange(N), points, roots @ np.swapaxes(roots, 1, 2)), uvs_px


def assert_close(ours, theirs):
    np.testing.assert_allclose(theirs, ours, rtol=0.0, atol=TOLERANCE * np.abs(ours).max())


@pytest.mark.parametrize("layout", [TWIST_LAYOUT, IMU_LAYOUT], ids=["twist", "imu"])
@pytest.mark.parametrize("left_only", [False, True], ids=["both images", "some by the left alone"])
@pytest.mark.parametrize(("probability", "huber"), [(0.95, 1.5), (0.95, None), (None, 1.5)])
def test_compiled_and_numpy_correct_alike(compiled, layout, left_only, probability, huber):
    belief = belief_of(layout)
    landmarks, uvs_px = landmarks_and_sightings(belief, left_only)
    gates = FrameGate(probability, huber), FrameGate(probability, huber)
    ours, theirs = (
        correct(belief, landmarks, uvs_px, DRIVE.rig, gate)
        for correct, gate in zip((correction.corrected, compiled.correct), gates, strict=True)
    )
    assert 0 < gates[0].accepted < gates[0].tested == N
    assert gates[0].info() == pytest.approx(gates[1].info(), rel=TOLERANCE)
    assert not np.allclose(ours.belief.T_world_imu, belief.T_world_imu, atol=1e-5)
    for name in ("T_world_imu", "v_world", "bias", "cov"):
        assert_close(getattr(ours.belief, name), getattr(theirs.belief, name))
    assert ours.landmarks.track_ids.tolist() == theirs.landmarks.track_ids.tolist()
    assert_close(ours.landmarks.points, theirs.landmarks.points)
    assert_close(ours.landmarks.covs, theirs.landmarks.covs)
    moved = np.any(ours.landmarks.points != landmarks.points, axis=1)
    assert np.any(theirs.landmarks.points != landmarks.points, axis=1).tolist() == moved.tolist()
    assert np.isnan(uvs_px).any() == left_only, "what is given stays as it was"


def test_compiled_and_numpy_start_landmarks_alike(compiled):
    belief = belief_of(TWIST_LAYOUT)
    uvs_px = landmarks_and_sightings(belief, left_only=False)[1]
    for some in (uvs_px, uvs_px[:0]):
        ours, theirs = (start(some, belief.T_world_imu, DRIVE.rig) for start in (landmark_map.started, compiled.start))
        for one, other in zip(ours, theirs, strict=True):
            assert one.shape == other.shape
            assert not one.size or other == pytest.approx(one, rel=1e-7, abs=TOLERANCE * np.abs(one).max())


@pytest.mark.parametrize("turn_rate", [0.0, 1e-6, 0.3, 30.0])
@pytest.mark.parametrize("scaled", [False, True], ids=["measured", "with noise scaled"])
def test_compiled_and_numpy_predict_alike(compiled, turn_rate, scaled):
    """Over three twists; at the largest rate each turns by more than half a radian, where closed forms take over."""
    belief, rng = belief_of(TWIST_LAYOUT), np.random.default_rng(5)
    motion = TwistMotion(
        read_only([0.03, 0.05, 0.02]),
        read_only(rng.normal(scale=5.0, size=(3, 3))),
        read_only(turn_rate * rng.normal(size=(3, 3))),
        read_only(rng.uniform(1.0, 3.0, (3, 2))) if scaled else None,
    )
    ours, theirs = predicted(belief, TwistModel(NOISE), motion), compiled.predict(belief, motion)
    for name in ("T_world_imu", "v_world", "bias", "cov"):
        assert_close(getattr(ours, name), getattr(theirs, name))
    assert np.array_equal(theirs.cov, theirs.cov.T)


def test_numpy_runs_where_nothing_is_set_and_where_it_is_requested():
    for compilation in (Compilation(), Compilation("numpy")):
        found = decoupled_steps(TwistModel(NOISE), NOISE, compilation)
        assert (found.correct, found.start) == (correction.corrected, landmark_map.started)
        assert compilation.ran == "numpy"
