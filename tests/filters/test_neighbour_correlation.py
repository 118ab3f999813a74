"""Neighbours count as one as far as their errors are one: by what that costs a mean, and no farther than they do."""

import numpy as np
import pytest

from filters.kalman import neighbour_correlation
from filters.kalman.neighbour_correlation import NeighbourCorrelation, freed_of_poses
from filters.kalman.residual_correlation import ResidualCorrelation
from toolkit.geometry import Array, IntArray
from toolkit.simulation import DRIVE, simulate

FRAMES, CLUSTERS, SIZE = 40, 12, 4


def clusters(seed: int, alike: float, width_px: float = 10.0) -> tuple[IntArray, Array, Array]:
    """Return frames (N,), pixels (N, 3) and unit errors (N, 3) of clusters of four whose errors are so much alike."""
    rng = np.random.default_rng(seed)
    centres = np.stack(np.meshgrid(np.arange(4) * 400.0, np.arange(3) * 400.0), axis=-1).reshape(-1, 2)
    places = centres[:, None] + rng.uniform(-0.5, 0.5, (FRAMES, CLUSTERS, SIZE, 2)) * width_px
    own, shared = rng.normal(size=(FRAMES, CLUSTERS, SIZE, 3)), rng.normal(size=(FRAMES, CLUSTERS, 1, 3))
    errors = np.sqrt(alike) * shared + np.sqrt(1.0 - alike) * own
    uvs_px = np.stack([places[..., 0], places[..., 0] - 10.0, places[..., 1]], axis=-1)
    frames = np.repeat(np.arange(FRAMES), CLUSTERS * SIZE)
    return frames, uvs_px.reshape(-1, 3), errors.reshape(-1, 3)


def learnt(frames: IntArray, uvs_px: Array, errors: Array) -> NeighbourCorrelation:
    found = NeighbourCorrelation()
    found.add(frames, uvs_px, errors)
    return found


@pytest.mark.parametrize("seed", range(10))
def test_neighbours_that_err_each_by_itself_count_one_by_one(seed: int) -> None:
    assert learnt(*clusters(seed, alike=0.0)).erring_as_one() == 1.0


@pytest.mark.parametrize("alike", [0.2, 0.5, 0.9])
def test_as_many_count_as_one_as_the_variance_of_a_sum_is_larger_by(alike: float) -> None:
    frames, uvs_px, errors = clusters(3, alike)
    together = learnt(frames, uvs_px, errors).erring_as_one()
    sums = errors.reshape(FRAMES * CLUSTERS, SIZE, 3).sum(axis=1)
    assert together == pytest.approx(np.square(sums).sum() / np.square(errors).sum(), rel=1e-9)
    assert together == pytest.approx(1.0 + (SIZE - 1) * alike, rel=0.1)  # three standard errors of 480 sums


def test_neighbours_are_near_and_in_one_image() -> None:
    assert learnt(*clusters(4, alike=0.5, width_px=200.0)).erring_as_one() > 1.5
    frames, uvs_px, errors = clusters(4, alike=0.9)
    assert learnt(frames, 1e4 * uvs_px, errors).erring_as_one() == 1.0
    assert learnt(np.arange(len(frames)), uvs_px, errors).erring_as_one() == 1.0


def test_frame_by_frame_is_as_all_at_once() -> None:
    frames, uvs_px, errors = clusters(5, alike=0.5)
    found = NeighbourCorrelation()
    for k in range(FRAMES):
        found.add(np.zeros(CLUSTERS * SIZE, dtype=np.int64), uvs_px[frames == k], errors[frames == k])
    assert found.erring_as_one() == pytest.approx(learnt(frames, uvs_px, errors).erring_as_one(), rel=1e-12)


def test_in_what_order_sightings_come_and_how_many_are_looked_at_together_changes_nothing(monkeypatch) -> None:
    frames, uvs_px, errors = clusters(7, alike=0.5)
    at_once, order = learnt(frames, uvs_px, errors), np.random.default_rng(7).permutation(len(frames))
    for most in (1, 100, 1000):
        monkeypatch.setattr(neighbour_correlation, "_AT_ONCE", most)
        found = learnt(frames[order], uvs_px[order], errors[order])
        assert found.erring_as_one() == pytest.approx(at_once.erring_as_one(), rel=1e-12)


def test_what_repeats_from_frame_to_frame_proves_no_more_than_once() -> None:
    one = CLUSTERS * SIZE
    repeated = []
    for seed in range(20):
        frames, uvs_px, errors = clusters(seed, alike=0.0)
        repeated.append(learnt(frames, np.tile(uvs_px[:one], (FRAMES, 1)), np.tile(errors[:one], (FRAMES, 1))))
    assert max(found.erring_as_one() for found in repeated) > 1.2
    assert max(found.erring_as_one(0.98) for found in repeated) == 1.0


def test_chance_is_that_of_products_whose_factors_are_both_correlated_along_tracks() -> None:
    """A product of two autoregressions of rho is one of rho squared: its mean has (1 + rho^2) / (1 - rho^2)."""
    frames, uvs_px, errors = clusters(8, alike=0.12, width_px=1.0)
    found, pairs = learnt(frames, uvs_px, errors), 3 * FRAMES * CLUSTERS * SIZE * (SIZE - 1) // 2
    shared = found.erring_as_one() - 1.0
    beyond = shared / (neighbour_correlation._STANDARD_ERRORS * 2.0 * np.sqrt(pairs) / errors.size)
    assert beyond > 1.1
    just = np.sqrt((beyond**2 - 1.0) / (beyond**2 + 1.0))
    assert found.erring_as_one(0.9999 * just) == 1.0 + shared
    assert found.erring_as_one(1.0001 * just) == 1.0


def test_tracks_that_are_correlated_count_for_less_by_as_many_neighbours_as_err_as_one() -> None:
    rig = simulate(DRIVE, 0).rig
    rng = np.random.default_rng(0)
    before = rng.normal(size=(4000, 3))
    after = 0.6 * before + 0.8 * rng.normal(size=(4000, 3))
    alone, beside, white = (ResidualCorrelation(rig) for _ in range(3))
    alone.add(before, after)
    beside.add(before, after)
    frames, uvs_px, errors = clusters(6, alike=0.5)
    for correlation in (beside, white):
        correlation.add_images(frames, uvs_px, errors, np.zeros((len(frames), 3, 6)))
    together = learnt(frames, uvs_px, errors).erring_as_one(alone.correlation)
    assert beside.share == pytest.approx(alone.share / together, rel=1e-12)
    assert f"{together:.1f} neighbours have a common error" in beside.messages[0]
    assert "neighbours" not in alone.messages[0]
    assert white.share == 1.0  # what an image shares alone is another matter: tracks that are white change no bit


def test_what_poses_explain_is_taken_from_each_image_and_nothing_else() -> None:
    rng = np.random.default_rng(1)
    frames = rng.permutation(np.repeat(np.arange(3), 20))
    H_pose, poses, own = rng.normal(size=(60, 3, 6)), rng.normal(size=(3, 6)), rng.normal(size=(60, 3))
    explained = (H_pose @ poses[frames][..., None])[..., 0]
    left = freed_of_poses(frames, own + explained, H_pose)
    np.testing.assert_allclose(left, freed_of_poses(frames, own, H_pose), atol=1e-12)
    for k in range(3):
        H = H_pose[frames == k].reshape(60, 6)
        np.testing.assert_allclose(H.T @ left[frames == k].ravel(), 0.0, atol=1e-11)
        best = np.linalg.lstsq(H, own[frames == k].ravel(), rcond=None)[0]
        np.testing.assert_allclose(left[frames == k].ravel(), own[frames == k].ravel() - H @ best, atol=1e-12)
