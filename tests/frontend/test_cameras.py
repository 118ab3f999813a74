"""Rectification: rows agree for any pair of lenses, the mounting is what comes out, and what is no pair is refused."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from tests.frontend.conftest import EQUIDISTANT, RADTAN, SIZE
from toolkit.frontend import Camera, rectified
from toolkit.geometry import Array, se3, so3_exp, transform

T_RIGHT_LEFT = se3(so3_exp(np.array([0.02, -0.01, 0.015])), np.array([-0.12, 0.003, -0.002]))
POINTS = np.random.default_rng(1).uniform([-1.0, -0.7, 1.5], [1.0, 0.7, 6.0], (40, 3))


def pixels(camera: Camera, points: Array) -> Array:
    """Return where a camera with distortion sees points (N, 3)."""
    project = cv2.fisheye.projectPoints if camera.distortion == "equidistant" else cv2.projectPoints
    seen = project(points[:, None], np.zeros(3), np.zeros(3), camera.K, camera.coefficients)[0]
    return np.asarray(seen).reshape(-1, 2)


@pytest.mark.parametrize("camera", [RADTAN, EQUIDISTANT], ids=["radtan", "equidistant"])
def test_the_maps_lead_where_the_lens_puts_a_point_and_rows_agree(camera: Camera) -> None:
    rig = rectified(camera, camera, T_RIGHT_LEFT, "rig")
    assert rig.baseline_m == pytest.approx(np.linalg.norm(T_RIGHT_LEFT[:3, 3]), rel=1e-9)
    points = POINTS @ rig.R_rect_cam.T
    u = rig.fx_px * points[:, 0] / points[:, 2] + rig.cx_px
    v = rig.fy_px * points[:, 1] / points[:, 2] + rig.cy_px
    inside = (u > 8) & (u < SIZE[0] - 8) & (v > 8) & (v < SIZE[1] - 8)
    assert inside.sum() > 15
    assert rig.maps is not None
    sides = ((POINTS, u), (transform(T_RIGHT_LEFT, POINTS), u - rig.fx_px * rig.baseline_m / points[:, 2]))
    for (seen_from, column), maps in zip(sides, rig.maps, strict=True):
        raw = pixels(camera, seen_from)
        for i in np.flatnonzero(inside & (column > 8) & (column < SIZE[0] - 8)):
            at = maps.columns[round(v[i]), round(float(column[i]))]
            # the map holds whole pixels, taken at a rounded pixel of the rectified image
            assert np.abs(at - raw[i]).max() < 2.0


def test_pixels_beyond_the_lens_are_known_as_such() -> None:
    rig = rectified(EQUIDISTANT, EQUIDISTANT, T_RIGHT_LEFT, "rig")
    wide = rectified(*2 * [replace(EQUIDISTANT, pinhole_px=(75.0, 75.0, 160.0, 121.0))], T_RIGHT_LEFT, "rig")
    for one in (rig, wide):
        assert 0.5 < one.seen(0).mean() < 1.0
        assert not one.seen(0)[0].any()
