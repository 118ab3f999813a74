"""Rendered images show the scene where it is, and a folder of them is the scenario's recording."""

import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from toolkit.datasets import load_sequence
from toolkit.errors import OutputError
from toolkit.frontend.cameras import Distortion
from toolkit.geometry import Array, se3_inverse
from toolkit.sequence import Observations
from toolkit.settings import Frontend, SettingsError
from toolkit.simulation import DRIVE_IMU, FLIGHT, filming, simulate
from toolkit.simulation.filming import Filming, errors_px, film
from toolkit.simulation.renderer import Eye, Panel, furnished_hall, light

SHORT = replace(FLIGHT, duration_s=0.2)
FRAMES = 5


def pose_at(t_s: float) -> Array:
    """Return where the left camera is in the world (4, 4)."""
    T_world_imu = FLIGHT.scene(10.0).trajectory.at(np.array([t_s])).T_world_imu[0]
    return np.asarray(T_world_imu @ FLIGHT.rig.T_imu_cam)


def first_hit(panels: tuple[Panel, ...], origin: Array, towards: Array) -> Array:
    """Return the point of the nearest panel on a ray, or NaN: plane by plane, with nothing shared with the renderer."""
    nearest, hit = np.inf, np.full(3, np.nan)
    for panel in panels:
        corner, normal = panel.T_world_panel[:3, 3], panel.T_world_panel[:3, 2]
        slope = normal @ towards
        if slope >= 0.0 or normal @ (origin - corner) <= 0.0:
            continue
        reach = normal @ (corner - origin) / slope
        x, y = panel.T_world_panel[:3, :2].T @ (origin + reach * towards - corner)
        if reach < nearest and 0.0 <= x <= panel.size_m[0] and 0.0 <= y <= panel.size_m[1]:
            nearest, hit = reach, origin + reach * towards
    return hit


@pytest.mark.parametrize("model", ["none", "radtan", "equidistant"])
def test_what_two_cameras_see_at_two_times_are_the_same_points(model: Distortion) -> None:
    """A point seen in one image has its grey value where the other shows it, unless something stands before it."""
    pair, panels = filming._Pair.of(FLIGHT, model), furnished_hall()(0.0)
    poses = pose_at(2.0), pose_at(2.1) @ se3_inverse(FLIGHT.rig.T_imu_cam) @ pair.T_imu_cams[1]
    eye, camera = Eye.of(pair.camera), pair.camera
    project = cv2.fisheye.projectPoints if model == "equidistant" else cv2.projectPoints
    images = [light(panels, eye, pose) for pose in poses]
    rng, differences, hidden = np.random.default_rng(1), [], 0
    for column, row in zip(rng.integers(100, 650, 160), rng.integers(60, 420, 160), strict=True):
        ray = poses[0][:3, :3] @ np.array([eye.x[row, column], eye.y[row, column], 1.0])
        point = first_hit(panels, poses[0][:3, 3], ray)
        towards = point - poses[1][:3, 3]
        if np.linalg.norm(first_hit(panels, poses[1][:3, 3], towards) - point) > 0.01:
            hidden += 1
            continue
        place = (poses[1][:3, :3].T @ towards).reshape(1, 1, 3), np.zeros(3), np.zeros(3)
        u, v = np.ravel(project(*place, camera.K, camera.coefficients)[0])
        if 1.0 < u < 750.0 and 1.0 < v < 478.0:
            shown = cv2.remap(images[1], np.float32([[u]]), np.float32([[v]]), cv2.INTER_LINEAR)
            differences.append(float(shown[0, 0]) - float(images[0][row, column]))
    assert len(differences) > 100
    assert hidden > 0
    # Grey values of 20 to 240; prints have edges, beside which half a pixel is a difference of many.
    assert np.median(np.abs(differences)) < 2.0
    assert np.mean(np.abs(differences) < 15.0) > 0.9


@pytest.fixture(scope="module")
def filmed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    directory = tmp_path_factory.mktemp("filmed") / "hall"
    film(SHORT, 3, directory, Filming("radtan"))
    return directory


def image_bytes(directory: Path) -> list[bytes]:
    return [path.read_bytes() for path in sorted(directory.glob("mav0/cam?/data/*.png"))]


def test_the_folder_is_the_scenarios_recording(filmed: Path) -> None:
    mine, read = simulate(SHORT, 3), load_sequence(str(filmed), 0, Frontend(tracks="images"))
    np.testing.assert_array_equal(read.frames_t_ns, mine.frames_t_ns)
    np.testing.assert_allclose(read.motion.values, mine.motion.values, rtol=1e-12)
    assert read.noise == mine.noise
    np.testing.assert_allclose(read.truth.T_world_imu, mine.truth.T_world_imu, atol=1e-12)
    np.testing.assert_allclose(read.truth.bias, mine.truth.bias, rtol=1e-12)
    assert read.rig.baseline_m == pytest.approx(mine.rig.baseline_m, rel=1e-6)
    assert "rendered images" in read.provenance.source
    assert np.bincount(read.observations.frame).min() > 100
    # KLT reaches a tenth of a pixel in time, and a third from left to right, where a window sees two depths.
    off_px = errors_px(read)
    assert np.isfinite(off_px).all()
    assert (np.median(np.abs(off_px), axis=0) < [0.1, 0.4, 0.15]).all()
    assert read.provenance.facts[1].startswith("against the rendered scene")


def test_errors_against_the_scene_are_those_planted(filmed: Path) -> None:
    read = load_sequence(str(filmed), 0, Frontend(tracks="images"))
    before, seen = errors_px(read), read.observations
    later = np.isin(seen.frame, [3, 4]) & np.isin(seen.track_id, seen.track_id[seen.frame == 0])
    shifted = Observations(seen.frame, seen.track_id, seen.uv_px + later[:, None] * [1.5, 0.0, -0.5])
    moved = errors_px(replace(read, observations=shifted)) - before
    np.testing.assert_allclose(moved[later], np.tile([1.5, 0.0, -0.5], (int(later.sum()), 1)), atol=1e-9)
    np.testing.assert_allclose(moved[~later], 0.0, atol=1e-9)


def test_the_same_seed_gives_the_same_images(filmed: Path, tmp_path: Path) -> None:
    assert len(image_bytes(filmed)) == 2 * FRAMES
    begun = replace(SHORT, duration_s=0.05)
    film(begun, 3, tmp_path / "again", Filming("radtan"))
    film(begun, 4, tmp_path / "other", Filming("radtan"))
    for side in (0, 1):
        first = image_bytes(filmed)[side * FRAMES : side * FRAMES + 2]
        assert image_bytes(tmp_path / "again")[2 * side : 2 * side + 2] == first
        assert image_bytes(tmp_path / "other")[2 * side : 2 * side + 2] != first


def test_a_folder_of_ours_is_replaced_and_no_other(filmed: Path, tmp_path: Path) -> None:
    filming.check_filmable(SHORT, filmed)
    real = tmp_path / "MH_01"
    (real / "mav0/cam0").mkdir(parents=True)
    (real / "mav0/cam0/data.csv").write_text("#timestamp [ns],filename\n")
    with pytest.raises(OutputError, match="mav0"):
        film(SHORT, 0, real)
    assert (real / "mav0/cam0/data.csv").is_file()


def test_what_fails_on_the_way_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(self: object, k: int, t_ns: int, side: int) -> bytes:
        if k == 1:
            raise OSError(28, "No space left on device")
        return b"image"

    monkeypatch.setattr(filming._Crew, "png", refuse)
    with pytest.raises(OutputError, match="No space left"):
        film(SHORT, 0, tmp_path / "full")
    assert list(tmp_path.iterdir()) == []


def test_images_for_which_there_is_no_room_are_refused_before_any_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    hour = replace(FLIGHT, duration_s=3600.0)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=20e9))
    monkeypatch.setattr(filming, "simulate", lambda *_: pytest.fail("simulated before the room was looked at"))
    with pytest.raises(OutputError, match=r"72001 stereo pairs take about 28\.8 GB, and 20 GB are free there"):
        film(hour, 0, tmp_path / "new" / "deeper")
    assert not list(tmp_path.iterdir())


def test_a_world_of_points_cannot_be_filmed(tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match="no surfaces to take images of; flight has"):
        film(DRIVE_IMU, 0, tmp_path / "drive")
