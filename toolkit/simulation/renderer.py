"""The textured planes of the hall of `flight`, their images by a camera, and the noise of its sensor.

Walls and furniture belong to the scenario like the landmarks and are the same under every seed. Textures are periodic
and kept at every halving of their resolution, so that a distant plane does not flicker (Williams, "Pyramidal
parametrics", 1983). Each pixel's ray is intersected with every plane and the nearest one is visible, so that positions,
disparities and occlusions are exact: a plane's inverse depth is linear in the ray (x, y, 1), and the largest is the
nearest.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np
import numpy.typing as npt

from toolkit.frontend.cameras import Camera
from toolkit.geometry import Array, IntArray, about_z, se3, se3_inverse, transform
from toolkit.simulation.scenes import HALL_LOWER_M, HALL_UPPER_M

Grey = npt.NDArray[np.uint8]
Floats = npt.NDArray[np.float32]
TEXEL_M = 0.004

_WORLD_SEED = 21  # draws textures and furniture, the same for every seed of the scenario
TEXELS, LEVELS = 2048, 7
# Prints on each texture: plain walls, busy posters and boxes.
_PRINTS = (130, 350, 900)
_TEXTURES, _WALL_TEXTURES = len(_PRINTS), 2
_FRAME = 4
# Nothing stands where the camera flies: it keeps within 2.1 m of the middle, and above 1.4 m.
_FLOWN_M, _LOWEST_M = 2.5, 1.2
_POSTERS, _CRATES, _LAMPS = 44, 16, 8
# Brightness of the faces of a box, by the direction they face: x, y, z and their opposites.
_SHADES = (0.95, 0.85, 1.0, 0.8, 0.9, 0.7)
_NEAREST_M = 0.05
_NEARNESS_OF_NOTHING = 1e-6
# The optics' own blur, as a Gaussian (px).
_OPTICS_PX = 0.6
# Noise of the sensor: sigma in the dark (grey values), and variance for each grey value of light, as photons have.
_DARK_SIGMA, _VARIANCE_PER_GREY = 1.2, 0.02


@dataclass(frozen=True, eq=False)
class Panel:
    """A textured rectangle, seen from the side its z-axis points to.

    ``T_world_panel`` (4, 4) has its origin in a corner and the x and y axes along the edges; ``texture`` is the number
    of its texture, ``offset_m`` (2,) the position of the corner in the texture, and ``shade`` multiplies its grey
    values.
    """

    T_world_panel: Array
    size_m: tuple[float, float]
    texture: int
    offset_m: tuple[float, float]
    shade: float = 1.0

    @property
    def corners(self) -> Array:
        """Return its corners (4, 3) in the world, in order around it."""
        width, height = self.size_m
        local = np.array([[0.0, 0.0, 0.0], [width, 0.0, 0.0], [width, height, 0.0], [0.0, height, 0.0]])
        return np.asarray(local @ self.T_world_panel[:3, :3].T + self.T_world_panel[:3, 3])

    def moved(self, T_world_body: Array) -> "Panel":
        """Return the panel of a body at a pose (4, 4); this panel's own pose is relative to the body."""
        return replace(self, T_world_panel=T_world_body @ self.T_world_panel)


# The visible panels at any time (s).
Surfaces = Callable[[float], tuple[Panel, ...]]


def furnished_hall(moving: int = 0) -> Surfaces:
    """Return the hall of `flight`: walls, posters up to 0.3 m before them, pillars, crates, lamps.

    ``moving`` crates fly circles between the camera and the walls, at walking pace.
    """
    rng = np.random.default_rng(_WORLD_SEED)
    standing = (*_walls(rng), *_posters(rng), *_furniture(rng))
    circling = _circling(moving, rng) if moving else lambda t_s: ()
    return lambda t_s: standing + circling(t_s)


# The furniture ------------------------------------------------------------------------------------------------------


def _walls(rng: np.random.Generator) -> Iterator[Panel]:
    """Yield the six faces of the hall, seen from inside."""
    for axis in range(3):
        for far in (False, True):
            wall = _on_wall(axis, far, HALL_LOWER_M, HALL_UPPER_M - HALL_LOWER_M, rng)
            yield replace(wall, texture=axis % _WALL_TEXTURES)


def _on_wall(axis: int, far: bool, corner_m: Array, size_m: Array, rng: np.random.Generator) -> Panel:
    """Return a panel on the face of a box that is crossed by an axis, the near or the far one, looking inwards.

    The box is given by its lower corner (3,) and its size (3,).
    """
    inwards = -1.0 if far else 1.0
    z = inwards * np.eye(3)[axis]
    x, y = np.eye(3)[(axis + 1) % 3], np.eye(3)[(axis + 2) % 3]
    edges_m = float(size_m[(axis + 1) % 3]), float(size_m[(axis + 2) % 3])
    origin = corner_m + far * size_m * np.eye(3)[axis]
    if far:  # x, y and z stay right-handed
        x, y, edges_m = y, x, edges_m[::-1]
    return _painted((x, y, z), origin, edges_m, rng)


def _painted(
    axes: tuple[Array, Array, Array], origin: Array, size_m: tuple[float, float], rng: np.random.Generator
) -> Panel:
    """Return a panel with axes x, y and z along axes of the world, with a texture and the shade of where it looks."""
    offset_m = rng.uniform(0.0, TEXELS * TEXEL_M, 2).tolist()
    shade = _SHADES[int(np.argmax(np.concatenate([axes[2], -axes[2]])))]
    T_world_panel = se3(np.stack(axes, axis=1), origin)
    return Panel(T_world_panel, size_m, int(rng.integers(_TEXTURES)), (offset_m[0], offset_m[1]), shade)


def _posters(rng: np.random.Generator) -> Iterator[Panel]:
    """Yield rectangles parallel to the walls and up to 0.3 m before them, as the landmarks of the scene are."""
    size_m = HALL_UPPER_M - HALL_LOWER_M
    for i in range(_POSTERS):
        axis, far = i % 3, bool(i // 3 % 2)
        edges_m = rng.uniform(0.5, 1.5, 3)
        corner_m = HALL_LOWER_M + rng.uniform(size=3) * (size_m - edges_m)
        proud_m = rng.uniform(0.03, 0.3)
        edges_m[axis] = 0.0
        corner_m[axis] = HALL_UPPER_M[axis] - proud_m if far else HALL_LOWER_M[axis] + proud_m
        yield _on_wall(axis, far, corner_m, edges_m, rng)


def box(size_m: Array, rng: np.random.Generator) -> tuple[Panel, ...]:
    """Return the six faces of a box of some size (3,) about the origin, seen from outside."""
    faces = []
    for axis in range(3):
        for sign in (1.0, -1.0):
            z, x = sign * np.eye(3)[axis], np.eye(3)[(axis + 1) % 3]
            y = np.cross(z, x)
            edges_m = float(size_m[(axis + 1) % 3]), float(size_m[(axis + 2) % 3])
            origin = 0.5 * (z * size_m[axis] - x * edges_m[0] - y * edges_m[1])
            faces.append(_painted((x, y, z), origin, edges_m, rng))
    return tuple(faces)


def _furniture(rng: np.random.Generator) -> Iterator[Panel]:
    """Yield pillars, crates on the floor, and lamps that hang from the ceiling, above where the camera flies.

    Crates where it flies are low enough to be flown over.
    """

    def standing(size_m: Array, centre_m: Array, yaw_rad: float) -> Iterator[Panel]:
        return (face.moved(se3(about_z(yaw_rad), centre_m)) for face in box(size_m, rng))

    height_m = HALL_UPPER_M[2]
    for x, y in ((3.6, 3.4), (-3.5, 3.7), (-3.7, -3.3), (3.4, -3.6)):
        yield from standing(np.array([0.45, 0.45, height_m]), np.array([x, y, 0.5 * height_m]), 0.0)
    for _ in range(_CRATES):
        place_m = rng.uniform(-4.2, 4.2, 2)
        below = np.abs(place_m).max() < _FLOWN_M + 0.7
        size_m = np.append(rng.uniform(0.4, 0.9, 2), rng.uniform(0.3, 0.7 if below else 1.6))
        yield from standing(size_m, np.append(place_m, 0.5 * size_m[2]), float(rng.uniform(0.0, np.pi)))
    for _ in range(_LAMPS):
        size_m = np.append(rng.uniform(0.3, 0.9, 2), rng.uniform(0.1, 0.3))
        place_m = np.append(rng.uniform(-4.0, 4.0, 2), rng.uniform(3.7, 4.1))
        yield from standing(size_m, place_m, float(rng.uniform(0.0, np.pi)))


def _circling(count: int, rng: np.random.Generator) -> Callable[[float], tuple[Panel, ...]]:
    """Return crates that circle around the middle of the hall, beyond where the camera flies, and turn as they go."""
    bodies = [box(rng.uniform(0.4, 0.8, 3), rng) for _ in range(count)]
    phase = rng.uniform(0.0, 2.0 * np.pi, count)
    radius_m, height_m = rng.uniform(3.3, 4.3, count), rng.uniform(_LOWEST_M, 3.2, count)
    turn_radps = rng.choice([-1.0, 1.0], count) * rng.uniform(0.6, 1.4, count) / radius_m

    def panels(t_s: float) -> tuple[Panel, ...]:
        angle = phase + turn_radps * t_s
        places = np.stack([radius_m * np.cos(angle), radius_m * np.sin(angle), height_m], axis=1)
        return tuple(
            face.moved(se3(about_z(float(2.0 * a)), place))
            for body, a, place in zip(bodies, angle, places, strict=True)
            for face in body
        )

    return panels


# The textures -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Atlas:
    """All textures at all levels in one image: textures side by side, and of each the halved ones below each other.

    ``first_column`` (textures,) and ``first_row`` (levels,) say where an image begins; its first rows and columns are
    repeated after the last ones, so that interpolation needs no special case at the border.
    """

    image: Grey
    first_column: Floats
    first_row: Floats


@lru_cache(maxsize=1)
def atlas() -> Atlas:
    """Return the textures; a texel of the finest level is ``TEXEL_M`` wide. Made once in a process."""
    columns = [_column(_texture(i, np.random.default_rng([_WORLD_SEED, i]))) for i in range(_TEXTURES)]
    heights = [(TEXELS >> level) + _FRAME for level in range(LEVELS)]
    width = TEXELS + _FRAME
    first_row = np.concatenate([[0.0], np.cumsum(heights)[:-1]]).astype(np.float32)
    return Atlas(np.hstack(columns), (width * np.arange(_TEXTURES)).astype(np.float32), first_row)


def _column(image: Grey) -> Grey:
    """Return the levels of a texture below each other, each padded periodically."""
    import cv2

    column = np.zeros((sum((TEXELS >> level) + _FRAME for level in range(LEVELS)), TEXELS + _FRAME), np.uint8)
    row = 0
    for level in range(LEVELS):
        size = TEXELS >> level
        halved = cv2.resize(image, (size, size), interpolation=cv2.INTER_AREA)
        column[row : row + size + _FRAME, : size + _FRAME] = np.pad(halved, ((0, _FRAME), (0, _FRAME)), mode="wrap")
        row += size + _FRAME
    return column


def _texture(which: int, rng: np.random.Generator) -> Grey:
    """Return a periodic image: plaster with prints of many greys and sizes over it, more for higher numbers."""
    import cv2

    image = (125.0 + 20.0 * _clouds(rng, 1.3)).astype(np.float32)
    for size in np.geomspace(350.0, 12.0, _PRINTS[which]):
        middle, angle = rng.uniform(0.0, TEXELS, 2), rng.choice([0.0, rng.uniform(0.0, np.pi)])
        half = 0.5 * size * rng.uniform(0.4, 1.0, 2)
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        outline = middle + (np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * half) @ turn.T
        grey = float(rng.uniform(35.0, 215.0))
        for shift in np.ndindex(3, 3):  # also across the borders, because the image is periodic
            place = outline + TEXELS * (np.array(shift) - 1)
            if (place.max(axis=0) >= 0.0).all() and (place.min(axis=0) < TEXELS).all():
                cv2.fillPoly(image, [np.rint(place).astype(np.int32)], grey)
    image += (10.0 * _clouds(rng, 0.9)).astype(np.float32)
    smooth = cv2.GaussianBlur(np.pad(image, _FRAME, mode="wrap"), (0, 0), 0.8)[_FRAME:-_FRAME, _FRAME:-_FRAME]
    return np.clip(np.rint(smooth), 5, 250).astype(np.uint8)


def _clouds(rng: np.random.Generator, roughness: float) -> Array:
    """Return a periodic noise whose amplitude falls with the frequency to the power of the roughness; mean 0, sd 1."""
    size = TEXELS // 2
    frequency = np.hypot(*np.meshgrid(np.fft.fftfreq(size), np.fft.rfftfreq(size), indexing="ij"))
    frequency[0, 0] = np.inf
    spectrum = np.fft.rfft2(rng.standard_normal((size, size))) / np.maximum(frequency, 4e-3) ** roughness
    clouds = np.fft.irfft2(spectrum, s=(size, size))
    return np.tile(clouds / clouds.std(), (2, 2))


# The images ---------------------------------------------------------------------------------------------------------


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
    columns, rows = (place * scale - np.float32(0.5) for place in (u, v))
    columns -= size * np.floor(columns / size)  # numpy.mod takes ten times as long
    rows -= size * np.floor(rows / size)
    columns += column
    rows += kept.first_row[level_index]
    return np.asarray(cv2.remap(kept.image, columns, rows, cv2.INTER_LINEAR), dtype=np.float32)


def developed(light: Floats, exposure: float, rng: np.random.Generator) -> Grey:
    """Return the image of 8 bits of the light times the exposure, with the sensor's noise."""
    import cv2

    sharp = np.asarray(cv2.GaussianBlur(light, (0, 0), _OPTICS_PX), dtype=np.float32) * np.float32(exposure)
    sigma = np.sqrt(np.float32(_DARK_SIGMA**2) + np.float32(_VARIANCE_PER_GREY) * sharp)
    noisy = sharp + sigma * rng.standard_normal(sharp.shape, dtype=np.float32)
    return np.asarray(np.clip(np.rint(noisy), 0, 255), dtype=np.uint8)
