"""First patches fitted into a later image: a planted warp is recovered, gain and bias do not matter, others do."""

import cv2
import numpy as np
import pytest

from toolkit.frontend.patches import Patches
from toolkit.geometry import Array

CENTRES = np.array([[60.0, 60.0], [90.0, 70.0], [70.0, 100.0]])


@pytest.fixture(scope="module")
def image() -> Array:
    return cv2.GaussianBlur(np.random.default_rng(4).uniform(0, 255, (160, 160)), (0, 0), 2.0).astype(np.float32)


def warped(image: Array, warp: Array, about: Array, shift: Array) -> Array:
    """Return an image in which what was at ``about`` + x is at ``about`` + ``warp`` x + ``shift``."""
    whole = np.hstack([warp, (about + shift - warp @ about)[:, None]])
    return np.asarray(cv2.warpAffine(image, whole, (160, 160), flags=cv2.INTER_CUBIC))


def test_a_planted_warp_is_recovered_whatever_the_exposure(image: Array) -> None:
    warp, shift = np.array([[1.06, 0.03], [-0.04, 0.97]]), np.array([0.7, -0.5])
    for centre in CENTRES:
        patches = Patches.taken(image, centre[None])
        now = 0.6 * warped(image, warp, centre, shift) + 31.0
        fitted, places, alike = patches.fitted(now.astype(np.float32), centre[None])
        for _ in range(3):
            fitted, places, alike = fitted.fitted(now.astype(np.float32), places)
        # bilinear sampling of a texture of 2 px blurs by a few hundredths
        np.testing.assert_allclose(places[0], centre + shift, atol=0.05)
        np.testing.assert_allclose(fitted.warps[0], warp, atol=0.02)
        assert alike[0] > 0.98


def test_another_texture_does_not_fit(image: Array) -> None:
    other = image[::-1, ::-1].copy()
    _, _, alike = Patches.taken(image, CENTRES).fitted(other, CENTRES)
    assert (alike < 0.8).all()


def test_patches_of_no_track_can_be_fitted_and_joined(image: Array) -> None:
    none = Patches.none()
    _, places, alike = none.fitted(image, np.empty((0, 2)))
    assert places.shape == (0, 2)
    assert alike.size == 0
    assert len(Patches.taken(image, CENTRES).joined(none).values) == 3


def test_a_flat_patch_is_no_error(image: Array) -> None:
    flat = np.full_like(image, 7.0)
    _, places, alike = Patches.taken(flat, CENTRES).fitted(image, CENTRES)
    assert np.isfinite(places).all()
    assert (alike < 0.5).all()
