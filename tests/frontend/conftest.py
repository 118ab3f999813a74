"""Textured images of a scene whose geometry is known, through cameras with distortion, and folders of them.

A wall with a texture and a board before it, rendered as recordings are: places, disparities and occlusions are exact
(tests/simulation/test_filming.py).
"""

import shutil
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pytest

from toolkit.frontend import Camera, RectifiedPair, already_rectified, rectified
from toolkit.frontend.cameras import Image
from toolkit.geometry import Array, se3, so3_exp
from toolkit.simulation.renderer import Eye, Panel, light

SIZE = (320, 240)
BASELINE_M = 0.12
RADTAN = Camera((230.0, 228.0, 163.0, 118.0), "radtan", np.array([-0.28, 0.07, 2e-4, 1e-4]), SIZE)
EQUIDISTANT = Camera((150.0, 150.0, 160.0, 121.0), "equidistant", np.array([3e-3, 7e-4, -2e-3, 2e-4]), SIZE)
PLAIN = Camera((230.0, 230.0, 160.0, 120.0), "none", np.zeros(4), SIZE)
# The right camera is turned a little against the left one, as no pair is mounted perfectly.
T_RIGHT_LEFT = se3(so3_exp(np.array([0.01, -0.006, 0.008])), np.array([-BASELINE_M, 0.001, -0.0015]))
RECTIFIED = se3(np.eye(3), np.array([-BASELINE_M, 0.0, 0.0]))
WALL_M, BOARD_M = 3.0, 1.6


def seen(seed: int, camera: Camera, T_cam_scene: Array, of_noise: int) -> Image:
    """Return what a camera sees of a wall and of a board before its right half, with noise of a grey value."""
    towards_camera = np.diag([1.0, -1.0, -1.0])
    panels = [
        Panel(se3(towards_camera, np.array([left_m, 4.0, depth_m])), (8.0, 8.0), texture, (float(seed), 1.0))
        for left_m, depth_m, texture in ((-4.0, WALL_M, 2), (0.0, BOARD_M, 1))
    ]
    grey = light(panels, Eye.of(camera), np.linalg.inv(T_cam_scene))
    return np.clip(np.rint(grey + np.random.default_rng(of_noise).normal(0.0, 1.0, grey.shape)), 0, 255).astype(
        np.uint8
    )


def along(k: int, speed_m: float = 0.015) -> Array:
    """Return T_cam_scene (4, 4) of the left camera at frame k of a straight, level motion to the right and forward."""
    return se3(np.eye(3), -k * speed_m * np.array([1.0, 0.2, 0.4]))


# Of EuRoC's IMU, in the units of its sensor.yaml.
IMU_NOISE = "gyroscope_noise_density: 1.6968e-04     # [ rad / s / sqrt(Hz) ]\ngyroscope_random_walk: 1.9393e-05\n"
IMU_NOISE += "accelerometer_noise_density: 2.0e-3\naccelerometer_random_walk: 3.0e-3\n"
Pair = tuple[Image, Image]
FRAMES = 10
START_NS, PERIOD_NS = 1_403_715_273_262_142_976, 50_000_000
# The IMU looks ahead with its x, to the left with its y; the camera stands a little off it.
T_IMU_LEFT = se3(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]), np.array([0.05, 0.06, 0.01]))


@dataclass(frozen=True, eq=False)
class Filmed:
    """The rectified images of a pair along the motion, and its calibration."""

    rig: RectifiedPair
    images: list[Pair]

    def depths_m(self, corners_px: Array, k: int) -> Array:
        """Return how far before the first camera the points lie that corners (N, 4) of frame k show."""
        rig = self.rig
        depth = rig.fx_px * rig.baseline_m / (corners_px[:, 0] - corners_px[:, 2])
        return np.asarray(self.points_m(corners_px, depth, k)[:, 2])

    def points_m(self, corners_px: Array, depth_m: Array, k: int) -> Array:
        """Return the points (N, 3) of corners with depths (N,), in the first camera's axes."""
        rig = self.rig
        x, y = (corners_px[:, 0] - rig.cx_px) / rig.fx_px, (corners_px[:, 1] - rig.cy_px) / rig.fy_px
        points_rect = np.stack([x, y, np.ones_like(x)], axis=1) * depth_m[:, None]
        return np.asarray(points_rect @ rig.R_rect_cam - along(k)[:3, 3])


def film(cameras: tuple[Camera, Camera], T_right_left: Array, frames: int, seed: int = 3) -> list[Pair]:
    """Return the images of both cameras along the motion."""
    poses = [(k, along(k)) for k in range(frames)]
    left, right = cameras
    return [(seen(seed, left, T, 2 * k), seen(seed, right, T_right_left @ T, 2 * k + 1)) for k, T in poses]


@pytest.fixture(scope="session")
def plain() -> Filmed:
    """Return a film of cameras without distortion that are mounted perfectly."""
    return Filmed(already_rectified(PLAIN.pinhole_px, BASELINE_M, SIZE), film((PLAIN, PLAIN), RECTIFIED, 10))


@pytest.fixture(scope="session")
def papered(plain: Filmed) -> Filmed:
    """Return the plain film in which the wall and the board fade, from frame to frame, into others in their place."""
    other = film((PLAIN, PLAIN), RECTIFIED, 6, seed=8)
    images = []
    for k, (pair, others) in enumerate(zip(plain.images[:6], other, strict=True)):
        share = 0.14 * k
        mixed = [np.rint((1.0 - share) * a + share * b).astype(np.uint8) for a, b in zip(pair, others, strict=True)]
        images.append((mixed[0], mixed[1]))
    return Filmed(plain.rig, images)


@pytest.fixture(scope="session")
def raw() -> dict[str, list[Pair]]:
    """Return films of real lenses, as the cameras give them, by the model of their distortion."""
    return {
        camera.distortion: film((camera, camera), T_RIGHT_LEFT, frames)
        for camera, frames in ((RADTAN, FRAMES), (EQUIDISTANT, 6))
    }


@pytest.fixture(scope="session", params=["none", "radtan", "equidistant"])
def filmed(request: pytest.FixtureRequest, plain: Filmed, raw: dict[str, list[Pair]]) -> Filmed:
    """Return a film for each model of distortion, rectified."""
    if request.param == "none":
        return plain
    camera = {"radtan": RADTAN, "equidistant": EQUIDISTANT}[request.param]
    rig = rectified(camera, camera, T_RIGHT_LEFT, "rig")
    return Filmed(rig, [(rig.apply(left, 0), rig.apply(right, 1)) for left, right in raw[request.param][:6]])


@pytest.fixture(autouse=True)
def _in_this_process(one_process: None) -> None:
    """Start no process: a folder that is refused needs none."""


def camera_yaml(camera: Camera, T_body_sensor: Array) -> str:
    """Return the sensor.yaml of a camera."""
    data = ", ".join(f"{x:.12g}" for x in T_body_sensor.ravel())
    model = {"radtan": "radial-tangential", "equidistant": "equidistant", "none": "none"}[camera.distortion]
    return (
        f"%YAML:1.0\nsensor_type: camera\nT_BS:\n  cols: 4\n  rows: 4\n  data: [{data}]\nrate_hz: 20\n"
        f"resolution: [{camera.size_px[0]}, {camera.size_px[1]}]\ncamera_model: pinhole\n"
        f"intrinsics: {list(camera.pinhole_px)}\ndistortion_model: {model}\n"
        f"distortion_coefficients: {camera.coefficients.tolist()}\n"
    )


def imu_text(frames: int) -> str:
    """Return the IMU of a level motion at constant speed, at 200 Hz, from 50 ms before the first frame on."""
    columns = ",".join([f"w_RS_S_{a}" for a in "xyz"] + [f"a_RS_S_{a}" for a in "xyz"])
    stamps = START_NS - PERIOD_NS + 5_000_000 * np.arange(10 * (frames + 2))
    rng = np.random.default_rng(7)
    gyro, accel = (rng.normal(0.0, sigma, (stamps.size, 3)) for sigma in (0.002, 0.03))
    rows = zip(stamps.tolist(), np.hstack([gyro, accel + np.array([0.0, 0.0, 9.81])]).tolist(), strict=True)
    return f"#timestamp [ns],{columns}\n" + "".join(f"{t},{','.join(f'{x:.9g}' for x in row)}\n" for t, row in rows)


def write_asl(root: Path, camera: Camera, T_imu_cams: list[Array], stamps_ns: list[int]) -> None:
    """Write an ASL folder of alike cameras with the IMU's motion, and folders for the images."""
    table = "#timestamp [ns],filename\n" + "".join(f"{t},{t}.png\n" for t in stamps_ns)
    for side, T in enumerate(T_imu_cams):
        (root / f"mav0/cam{side}/data").mkdir(parents=True)
        (root / f"mav0/cam{side}/data.csv").write_text(table)
        (root / f"mav0/cam{side}/sensor.yaml").write_text(camera_yaml(camera, T))
    (root / "mav0/imu0").mkdir()
    (root / "mav0/imu0/data.csv").write_text(imu_text(len(stamps_ns)))
    (root / "mav0/imu0/sensor.yaml").write_text(camera_yaml(camera, np.eye(4)) + IMU_NOISE)


def positions(frames: range) -> Array:
    """Return where the IMU is (N, 3) m at frames, in a world whose axes are the IMU's at the first."""
    moved = -np.stack([along(k)[:3, 3] for k in frames])
    return np.asarray(moved @ T_IMU_LEFT[:3, :3].T)


@pytest.fixture(scope="session")
def asl_template(raw: dict[str, list[Pair]], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return an ASL folder with real lenses' images, an IMU and a truth."""
    root = tmp_path_factory.mktemp("film") / "film"
    stamps = [START_NS + PERIOD_NS * k for k in range(FRAMES)]
    write_asl(root, RADTAN, [T_IMU_LEFT, T_IMU_LEFT @ np.linalg.inv(T_RIGHT_LEFT)], stamps)
    for t_ns, pair in zip(stamps, raw["radtan"], strict=True):
        for side, image in enumerate(pair):
            cv2.imwrite(str(root / f"mav0/cam{side}/data/{t_ns}.png"), image)
    # Seconds as doubles are off by 1e-7: the truth begins before the first frame and ends behind the last.
    frames = range(-1, FRAMES + 1)
    rows = zip((START_NS + PERIOD_NS * k for k in frames), positions(frames).tolist(), strict=True)
    lines = [f"{t / 1e9:.9f} {x:.9f} {y:.9f} {z:.9f} 0 0 0 1\n" for t, (x, y, z) in rows]
    (root / "truth.tum").write_text("".join(lines))
    return root


@pytest.fixture
def asl(asl_template: Path, tmp_path: Path) -> Path:
    """Return a copy of the ASL folder that a test may spoil."""
    return Path(shutil.copytree(asl_template, tmp_path / "film"))
