"""Images of textured planes by a camera with or without distortion, and the noise of its sensor.

Each pixel's ray is intersected with every plane and the nearest one is visible, so that positions, disparities and
occlusions are exact: a plane's inverse depth is linear in the ray (x, y, 1), and the largest is the nearest.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from toolkit.frontend.cameras import Camera
from toolkit.geometry import Array, IntArray, se3_inverse, transform
from toolkit.simulation.surfaces import LEVELS, TEXEL_M, TEXELS, Atlas, Floats, Grey, Panel, atlas

_NEAREST_M = 0.05
_NEARNESS_OF_NOTHING = 1e-6
# The optics' own blur, as a Gaussian (px).
_OPTICS_PX = 0.6


@dataclass(frozen=True, eq=False)
class Eye:
    """The rays of a camera: x and y (height, width) where each pixel's ray meets the plane at depth 1."""

    x: Floats
    y: Floats
    focal_px: float

    @cached_property
    def _reach(self) -> tuple[tuple[Floats, Floats], tuple[Floats, Floats]]:
        """Return the least and the largest x of each column, and y of each row."""
        return (self.x.min(axis=0), self.x.max(axis=0)), (self.y.min(axis=1), self.y.max(axis=1))

    @classmethod
    def of(cls, camera: Camera) -> "Eye":
        """Return the rays of a camera."""
        import cv2

        (width, height), (fx, fy, cx, cy) = camera.size_px, camera.pinhole_px
        pixels = np.stack(np.meshgrid(np.arange(width, dtype=float), np.arange(height, dtype=float)), -1)
        flat = pixels.reshape(-1, 1, 2)
        if camera.distortion == "equidistant":
            plain = cv2.fisheye.undistortPoints(flat, camera.K, camera.coefficients)
        elif camera.distortion == "radtan":
            enough = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 50, 1e-10)
            plain = cv2.undistortPoints(flat, camera.K, camera.coefficients, criteria=enough)
        else:
            plain = (flat - [cx, cy]) / [fx, fy]
        rays = np.asarray(plain, dtype=np.float32).reshape(height, width, 2)
        return cls(np.ascontiguousarray(rays[..., 0]), np.ascontiguousarray(rays[..., 1]), 0.5 * (fx + fy))

    def extent(self, corners_cam: Array) -> tuple[slice, slice] | None:
        """Return rows and columns in which a polygon (N, 3) m may be seen, or None where it is out of view."""
        before = _before_the_camera(corners_cam)
        if len(before) < 3:
            return None
        seen = before[:, :2] / before[:, 2:]
        lower, upper = seen.min(axis=0), seen.max(axis=0)
        columns, rows = (
            np.flatnonzero((most >= low) & (least <= high))
            for (least, most), low, high in zip(self._reach, lower, upper, strict=True)
        )
        if not (rows.size and columns.size):
            return None
        return slice(int(rows[0]), int(rows[-1]) + 1), slice(int(columns[0]), int(columns[-1]) + 1)


def _before_the_camera(corners_cam: Array) -> Array:
    """Return the part (M, 3) of a polygon (N, 3) that is in front of the camera (Sutherland & Hodgman 1974)."""
    in_front = corners_cam[:, 2] > _NEAREST_M
    if in_front.all():
        return corners_cam
    kept = []
    for a, b in zip(corners_cam, np.roll(corners_cam, -1, axis=0), strict=True):
        if a[2] > _NEAREST_M:
            kept.append(a)
        if (a[2] > _NEAREST_M) != (b[2] > _NEAREST_M):
            kept.append(a + (b - a) * (_NEAREST_M - a[2]) / (b[2] - a[2]))
    return np.array(kept)


@dataclass(frozen=True, eq=False)
class _Hits:
    """The first panel that each pixel's ray meets: its row, the inverse depth (1/m), and positions times that."""

    panel: IntArray
    nearness: Floats
    u: Floats
    v: Floats


def light(panels: Sequence[Panel], eye: Eye, T_world_cam: Array) -> Floats:
    """Return the light on each pixel (height, width), in grey values, from panels seen from a pose (4, 4).

    The camera must be among panels on all sides: a ray that meets none is dark.
    """
    T_panel_cam = se3_inverse(np.stack([panel.T_world_panel for panel in panels])) @ T_world_cam
    corners_cam = transform(se3_inverse(T_world_cam), np.stack([panel.corners for panel in panels]))
    height_m = T_panel_cam[:, 2, 3]
    hits = _Hits(
        np.zeros(eye.x.shape, np.intp),
        *(np.full(eye.x.shape, start, np.float32) for start in (_NEARNESS_OF_NOTHING, 0.0, 0.0)),
    )
    for row in np.flatnonzero(height_m > 0.0).tolist():  # the others are seen from behind
        part = eye.extent(corners_cam[row])
        if part is not None:
            rays = eye.x[part], eye.y[part]
            _cut(hits, row, part, panels[row].size_m, rays, T_panel_cam[row].astype(np.float32))
    return _looked_up(panels, hits, (height_m * eye.focal_px).astype(np.float32))


def _cut(
    hits: _Hits,
    row: int,
    part: tuple[slice, slice],
    size_m: tuple[float, float],
    rays: tuple[Floats, Floats],
    T_panel_cam: Floats,
) -> None:
    """Intersect a part of the rays with a panel, and keep the panel where it is nearer than the earlier hits.

    Inverse depth, and positions in the panel times that, are linear in the ray: no pixel needs a division.
    """
    x, y = rays
    directions = T_panel_cam[:3, :3]
    nearness = (directions[2, 0] * x + directions[2, 1] * y + directions[2, 2]) * (-1.0 / T_panel_cam[2, 3])
    first = nearness > hits.nearness[part]
    u, v = (
        d[0] * x + d[1] * y + d[2] + shift * nearness
        for d, shift in zip(directions[:2], T_panel_cam[:2, 3], strict=True)
    )
    for place, size in ((u, size_m[0]), (v, size_m[1])):
        first &= place >= 0.0
        first &= place <= np.float32(size) * nearness
    for kept, found in ((hits.nearness, nearness), (hits.u, u), (hits.v, v), (hits.panel, row)):
        np.copyto(kept[part], found, where=first)


def _looked_up(panels: Sequence[Panel], hits: _Hits, focal_heights: Floats) -> Floats:
    """Return the grey values (height, width) of the textures where rays meet them, between two levels of each.

    ``focal_heights`` (P,) is the camera's height over each panel times its focal length.
    """
    kept = atlas()
    texels = np.float32(1.0 / TEXEL_M)
    table = np.array([(*p.offset_m, p.shade) for p in panels], dtype=np.float32)
    column = kept.first_column[[p.texture for p in panels]][hits.panel]
    depth = 1.0 / hits.nearness
    u = (hits.u * depth + table[:, 0][hits.panel]) * texels
    v = (hits.v * depth + table[:, 1][hits.panel]) * texels
    # How many texels of the finest level a pixel covers down the slope of the panel, in halvings.
    level = np.log2(np.maximum(depth * depth * (texels / focal_heights)[hits.panel], 1.0))
    level = np.minimum(level, np.float32(LEVELS - 1.001))
    finer = np.floor(level)
    share = level - finer
    grey = (1.0 - share) * _at_level(kept, finer, u, v, column) + share * _at_level(kept, finer + 1.0, u, v, column)
    return np.asarray(grey * table[:, 2][hits.panel], dtype=np.float32)


def _at_level(kept: Atlas, level: Floats, u: Floats, v: Floats, column: Floats) -> Floats:
    """Return the textures at positions in texels of the finest level, each read from one level."""
    import cv2

    level_index = level.astype(np.intp)
    scale = np.exp2(-level)
    size = np.float32(TEXELS) * scale
    columns, rows = (_wrapped(place * scale - np.float32(0.5), size) for place in (u, v))
    columns += column
    rows += kept.first_row[level_index]
    return np.asarray(cv2.remap(kept.image, columns, rows, cv2.INTER_LINEAR), dtype=np.float32)


def _wrapped(x: Floats, period: Floats) -> Floats:
    """Return x modulo the period, in a tenth of the time that numpy.mod takes."""
    return np.asarray(x - period * np.floor(x / period), dtype=np.float32)


@dataclass(frozen=True)
class SensorNoise:
    """Sensor noise: standard deviation in the dark (grey values), and variance for each grey value of light.

    The variance grows with the light, as photon noise does.
    """

    dark_sigma: float = 1.2
    variance_per_grey: float = 0.02

    def developed(self, light: Floats, exposure: float, rng: np.random.Generator) -> Grey:
        """Return the image of 8 bits of the light times the exposure."""
        import cv2

        sharp = np.asarray(cv2.GaussianBlur(light, (0, 0), _OPTICS_PX), dtype=np.float32) * np.float32(exposure)
        sigma = np.sqrt(np.float32(self.dark_sigma**2) + np.float32(self.variance_per_grey) * sharp)
        noisy = sharp + sigma * rng.standard_normal(sharp.shape, dtype=np.float32)
        return np.asarray(np.clip(np.rint(noisy), 0, 255), dtype=np.uint8)


def exposed(shot: Callable[[float], Floats], t_s: float, exposure_s: float, shots: int) -> Floats:
    """Return the mean light over an exposure about a time, from ``shots`` instants: motion blur."""
    if exposure_s == 0.0:
        return shot(t_s)
    times_s = t_s + exposure_s * ((np.arange(shots) + 0.5) / shots - 0.5)
    return np.asarray(np.mean([shot(float(t)) for t in times_s], axis=0), dtype=np.float32)
