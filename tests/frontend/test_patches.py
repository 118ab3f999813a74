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


def test_a_flat_patch_is_no_error(image: Array) -> None:
    flat = np.full_like(image, 7.0)
    _, places, alike = Patches.taken(flat, CENTRES).fitted(image, CENTRES)
    assert np.isfinite(places).all()
    assert (alike < 0.5).all()


@pytest.mark.parametrize("opening_deg", [60.0, 90.0])
def test_the_best_place_of_a_corner_is_its_tip_wherever_the_patch_was_taken(opening_deg: float) -> None:
    """A wedge looks alike at every scale about its tip, so that the scale that fits is anyone's guess."""
    tip, sides = np.array([50.3, 50.3]), 0.4 + np.deg2rad([0.0, opening_deg])
    ends = tip + 200.0 * np.stack([np.cos(sides), np.sin(sides)], axis=1)
    fine = np.zeros((800, 800), dtype=np.uint8)
    cv2.fillPoly(fine, [np.rint(8.0 * np.vstack([tip, ends]) + 3.5).astype(np.int32)], 160)
    drawn = cv2.GaussianBlur(cv2.resize(fine, (100, 100), interpolation=cv2.INTER_AREA), (0, 0), 0.7)
    centres = tip + np.array([[0.0, 0.0], [1.5, -1.0], [-1.0, 2.0], [2.0, 0.0], [0.0, -2.0]])
    best = centres + Patches.taken(drawn.astype(np.float32), centres).best_places
    # blur moves the corner of the grey values inwards, the more the sharper it is; the centres are 3 to 4 px apart
    assert np.linalg.norm(best - tip, axis=1).max() < 1.0
    assert np.ptp(best, axis=0).max() < 0.6
