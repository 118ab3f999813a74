"""Every way of making the errors of a track independent, against its whole covariance written out."""

import numpy as np
import pytest
from scipy.linalg import block_diag

from toolkit.models import correlated_noise, left_only
from toolkit.models.correlated_noise import Chain
from toolkit.simulation import DRIVE
from toolkit.track_noise import CHANNELS, TrackNoise

NOISE = TrackNoise(np.array([0.2, 0.3, 0.1]), np.array([0.3, 0.2, 0.1]), np.array([0.1, 1.4, 0.2]))
RIG = DRIVE.rig
AGES = np.array([[0, 1, 2, 3, 4], [7, 8, 9, 12, 13]])
SEEN = np.array([[True, False, True, True, True], [True, True, True, True, True]])


def cov_of_stacked_channels(noise: TrackNoise, ages: np.ndarray) -> np.ndarray:
    """Return the covariance (3 n, 3 n) of a track's errors in (c, d, v), stacked by sighting."""
    by_channel = block_diag(*noise.cov(ages.astype(float)))
    order = np.arange(3 * len(ages)).reshape(3, -1).T.ravel()
    return by_channel[np.ix_(order, order)]


@pytest.mark.parametrize("track", [0, 1])
def test_decorrelated_residuals_have_the_identity_for_covariance(track):
    seen, ages = SEEN[track], AGES[track]
    mixing = correlated_noise.decorrelation(NOISE, RIG, AGES, SEEN)[track]
    to_whitened = np.kron(np.eye(seen.sum()), RIG.whitener @ np.linalg.inv(CHANNELS))
    cov = to_whitened @ cov_of_stacked_channels(NOISE, ages[seen]) @ to_whitened.T
    used = np.repeat(seen, 3)
    np.testing.assert_allclose(
        mixing[np.ix_(used, used)] @ cov @ mixing[np.ix_(used, used)].T, np.eye(len(cov)), atol=1e-9
    )
    assert not mixing[np.ix_(used, ~used)].any()
    assert not mixing[np.ix_(~used, used)].any()


def test_the_error_of_the_last_sighting_has_the_covariance_with_all_that_the_track_has():
    mixing = correlated_noise.decorrelation(NOISE, RIG, AGES, SEEN)[0]
    last = correlated_noise.error_of_the_last(NOISE, AGES, SEEN)
    ages = AGES[0][SEEN[0]]
    cov = cov_of_stacked_channels(NOISE, ages)
    # Less its own white noise, an error is what walks on.
    with_all = cov[-3:].copy()
    with_all[:, -3:] -= np.diag(np.square(NOISE.white_px))
    to_whitened = np.kron(np.eye(len(ages)), RIG.whitener @ np.linalg.inv(CHANNELS))
    used = np.repeat(SEEN[0], 3)
    expected = with_all @ (mixing[np.ix_(used, used)] @ to_whitened).T
    np.testing.assert_allclose(last.gain[0][:, used], expected, atol=1e-9)
    np.testing.assert_allclose(last.cov[0], with_all[:, -3:], atol=1e-12)


LEFT_ONLY = np.array([[False, False, True, False, True], [False, False, False, True, False]])


@pytest.mark.parametrize("track", [0, 1])
def test_without_right_images_decorrelated_residuals_have_the_identity_for_covariance(track):
    seen, ages, left = SEEN[track], AGES[track], LEFT_ONLY[track]
    mixing = correlated_noise.decorrelation(NOISE, RIG, AGES, SEEN, LEFT_ONLY)[track]
    to_uv = np.kron(np.eye(seen.sum()), np.linalg.inv(CHANNELS))
    cov_uv = to_uv @ cov_of_stacked_channels(NOISE, ages[seen]) @ to_uv.T
    uv_px = np.where(np.arange(3) == 1, np.where(left, np.nan, 0.0)[seen][:, None], 0.0)
    whitened = block_diag(*np.broadcast_to(left_only.whitener(uv_px, RIG), (seen.sum(), 3, 3)))
    used = np.repeat(seen, 3)
    there = mixing[np.ix_(used, used)] @ whitened
    expected = np.diag(np.where(np.isnan(uv_px), 0.0, 1.0).ravel())
    np.testing.assert_allclose(there @ cov_uv @ there.T, expected, atol=1e-9)


def test_without_right_images_the_error_of_the_last_is_determined_by_the_rest():
    """By regression on what was measured of (uL, uR, v), written out."""
    last = correlated_noise.error_of_the_last(NOISE, AGES, SEEN, LEFT_ONLY)
    for track in (0, 1):
        seen, ages = SEEN[track], AGES[track]
        to_uv = np.kron(np.eye(seen.sum()), np.linalg.inv(CHANNELS))
        cov = cov_of_stacked_channels(NOISE, ages[seen])
        with_all = cov[-3:].copy()
        with_all[:, -3:] -= np.diag(np.square(NOISE.white_px))
        measured = np.ones((seen.sum(), 3), dtype=bool)
        measured[:, 1] = ~LEFT_ONLY[track][seen]
        rows = np.flatnonzero(measured)
        across = (with_all @ to_uv.T)[:, rows]
        explained = across @ np.linalg.solve((to_uv @ cov @ to_uv.T)[np.ix_(rows, rows)], across.T)
        np.testing.assert_allclose(last.gain[track] @ last.gain[track].T, explained, atol=1e-9)


def test_in_a_chain_the_left_image_follows_what_was_seen_and_a_pair_the_pair_before():
    left = np.array([False, True, True, False, False])
    chain = Chain.of(NOISE, np.zeros(5, dtype=np.int64), AGES[0], left)
    assert chain.before.tolist() == [-1, 0, 1, 0, 3]
    of_left = np.array([[1.0, 0.5, 0.0], [0.0, 0.0, 1.0]])
    common = np.square(NOISE.offset_px) + np.square(NOISE.walk_px) * AGES[0][:, None]
    variance = common + np.square(NOISE.white_px)
    # Of uL = c + d / 2 and of v: the regression on those of the sighting before.
    slope = (common[1] @ np.square(of_left).T) / (variance[1] @ np.square(of_left).T)
    np.testing.assert_allclose(chain.carried[2, [0, 2]], slope)
    left_over = variance[2] @ np.square(of_left).T - slope * (common[1] @ np.square(of_left).T)
    np.testing.assert_allclose(np.square(chain.sigma_px[2, [0, 2]]), left_over)
    pairs = Chain.of(NOISE, np.zeros(3, dtype=np.int64), AGES[0][~left])
    np.testing.assert_allclose(chain.sigma_px[~left], pairs.sigma_px)


def innovations_of(chain: Chain, n: int) -> np.ndarray:
    """Return the matrix (3 n, 3 n) of the chain's innovations, by channel, then sighting."""
    columns = []
    for unit in np.eye(3 * n):
        in_channels = unit.reshape(3, n).T
        columns.append(chain.innovations(in_channels @ np.linalg.inv(CHANNELS).T).T.ravel())
    return np.array(columns).T


def chain_of(noise: TrackNoise, ages: np.ndarray) -> Chain:
    return Chain.of(noise, np.zeros(len(ages), dtype=np.int64), ages)


@pytest.mark.parametrize(
    ("noise", "tolerance"),
    [
        (TrackNoise(np.full(3, 0.5), np.zeros(3), np.zeros(3)), 1e-12),
        # White noise is never quite nothing: what the chain forgets of the offset is its share of the variance.
        (TrackNoise(np.zeros(3), np.full(3, 0.3), np.array([0.4, 1.4, 0.0])), 3e-3),
    ],
    ids=["white", "walk and offset"],
)
def test_innovations_of_a_chain_are_independent(noise, tolerance):
    innovations = innovations_of(chain_of(noise, AGES[1]), 5)
    floored = TrackNoise(np.maximum(noise.white_px, correlated_noise.LEAST_WHITE_PX), noise.walk_px, noise.offset_px)
    cov = block_diag(*floored.cov(AGES[1].astype(float)))
    np.testing.assert_allclose(innovations @ cov @ innovations.T, np.eye(15), atol=tolerance)


def test_a_chain_keeps_the_variances_and_the_covariances_of_successive_sightings():
    inverse = np.linalg.inv(innovations_of(chain_of(NOISE, AGES[1]), 5))
    implied = (inverse @ inverse.T).reshape(3, 5, 3, 5)
    expected = NOISE.cov(AGES[1].astype(float))
    for channel in range(3):
        for offset in (0, 1):
            np.testing.assert_allclose(
                np.diagonal(implied[channel, :, channel], offset), np.diagonal(expected[channel], offset), rtol=1e-9
            )


def test_sightings_of_many_tracks_in_any_order_are_chained_each_to_the_one_before_in_its_track():
    track = np.array([5, 2, 9, 2, 5, 2])
    chain = Chain.of(NOISE, track, np.array([0, 0, 0, 1, 1, 3]))
    assert chain.before.tolist() == [-1, -1, -1, 1, 0, 3]
    kept = track != 5
    assert chain.of_tracks(kept).before.tolist() == [-1, -1, 0, 2]
    np.testing.assert_array_equal(chain.of_tracks(kept).sigma_px, chain.sigma_px[kept])


def test_the_white_part_alone_is_that_of_each_channel():
    cov = correlated_noise.white_rig(NOISE, RIG).cov_uv_px2
    np.testing.assert_allclose(CHANNELS @ cov @ CHANNELS.T, np.diag(np.square(NOISE.white_px)), atol=1e-12)
