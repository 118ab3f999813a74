"""A simulated recording as stereo images of a pair of cameras, in the layout of EuRoC's recordings.

Motion, IMU and truth are those of the scenario under the same seed. Tracks are not simulated: a front end has to make
them from the images. The seed also draws the noise of each image.

Errors of tracks made of the images measure the accuracy of a front end, in pixels. The ray of a track's first sighting,
from the true pose, meets a point of the hall; every later sighting of the track should be where that point is. Tracks
on flying crates count as wrong, as they do for an estimator.
"""

import json
import os
import shutil
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from toolkit.arrays import rows_of
from toolkit.errors import OutputError
from toolkit.files.writing import check_replaceable, replaced_directory
from toolkit.frontend.cameras import Camera, Distortion
from toolkit.geometry import Array, quaternion_from_rotation, se3, se3_inverse, so3_exp, transform
from toolkit.measurements import NS_PER_S
from toolkit.models import stereo
from toolkit.models.gating import MAD_TO_SIGMA
from toolkit.motion_samples import ImuSamples
from toolkit.progress import SILENT, Progress
from toolkit.sequence import Sequence
from toolkit.settings import SettingsError
from toolkit.simulation.renderer import Eye, Floats, Surfaces, atlas, developed, furnished_hall, light
from toolkit.simulation.scenarios import START_NS, Scenario, simulate
from toolkit.simulation.scenes import SmoothTrajectory
from toolkit.simulation.sensors import Imu

# The file that marks a folder in the layout of real recordings as simulated, and says what was simulated.
ABOUT, SCHEMA = "simulation.json", "vislam.simulation/1"
_CAMERAS = ("cam0", "cam1")
_PAIR_GB = 4e-4
_TRUTH = "state_groundtruth_estimate0"
_IMAGES_STREAM = 5  # stream of random numbers of a seed; simulate() uses the first five
# Automatic exposure: the gain of both images oscillates by a share, with a period (s); the right image is brighter.
_SWING, _SWING_S, _RIGHT_GAIN = 0.12, 7.0, 1.04
_SHOTS = 5  # in an exposure that blurs
# Imperfect mounting of a pair with lenses: the rotation of the right camera against the left one (rad).
_TURNED_RAD = np.array([0.008, -0.005, 0.006])
_COEFFICIENTS: dict[Distortion, tuple[float, ...]] = {
    "none": (0.0, 0.0, 0.0, 0.0),
    "radtan": (-0.28, 0.07, 2e-4, 1e-4),
    "equidistant": (3e-3, 7e-4, -2e-3, 2e-4),
}
# A fisheye sees more on the same sensor.
_FISHEYE_FOCAL = 0.72
_EUROC_NAMES: dict[Distortion, str] = {"none": "none", "radtan": "radial-tangential", "equidistant": "equidistant"}
_MISMATCH_PX = 3.0


@dataclass(frozen=True)
class Filming:
    """How images are taken: lenses, exposure time (s, 0: no blur), and the number of flying crates."""

    lens: Distortion = "none"
    exposure_s: float = 0.0
    moving: int = 0


def check_filmable(scenario: Scenario, directory: Path) -> None:
    """Raise SettingsError for a scenario without surfaces, OutputError for a directory not ours or without room."""
    if not (scenario.has_surfaces and isinstance(scenario.motion, Imu)):
        raise SettingsError(f"{scenario.name} has landmarks and no surfaces to take images of; flight has")
    if scenario.varied:
        raise SettingsError(
            f"{scenario.name}: images of a world that the seed draws cannot be rendered; use the scenario's own"
        )
    check_replaceable(directory, _written_by_us)
    there = next(path for path in (directory.absolute(), *directory.absolute().parents) if path.is_dir())
    needed_gb, free_gb = size_gb(scenario), shutil.disk_usage(there).free / 1e9
    if needed_gb > free_gb:
        raise OutputError(
            f"{directory}: {pair_count(scenario)} stereo pairs take about {needed_gb:.3g} GB, and {free_gb:.3g} GB are "
            "free there; film less, or elsewhere"
        )


def pair_count(scenario: Scenario) -> int:
    return int(scenario.duration_s * scenario.camera.rate_hz) + 1


def size_gb(scenario: Scenario) -> float:
    """Return the approximate size of a scenario's images (GB)."""
    return _PAIR_GB * pair_count(scenario)


def film(
    scenario: Scenario, seed: int, directory: Path, filming: Filming | None = None, progress: Progress = SILENT
) -> Sequence:
    """Write a scenario under one seed as a folder of images, whole or not at all, and return its simulated recording.

    The folder has EuRoC's layout: both cameras' images, IMU, truth at the frames and sensor.yaml files. The same
    arguments give the same images. Raises as :func:`check_filmable`.
    """
    filming = filming or Filming()
    check_filmable(scenario, directory)
    progress.advance(0, pair_count(scenario), "simulating")
    sequence = simulate(scenario, seed)
    pair = _Pair.of(scenario, filming.lens)
    with replaced_directory(directory, _written_by_us) as partial:
        about = {"schema": SCHEMA, "scenario": scenario.name, "seed": seed, "duration_s": scenario.duration_s}
        (partial / ABOUT).write_text(json.dumps(about | asdict(filming), indent=2) + "\n")
        _write_tables(sequence, pair, scenario, partial / "mav0")
        crew = _Crew(
            scenario.scene(scenario.duration_s).trajectory, furnished_hall(filming.moving), pair, filming, seed
        )
        _shoot_all(crew, sequence.frames_t_ns.tolist(), partial / "mav0", progress)
    return sequence


def _shoot_all(crew: "_Crew", frames_t_ns: list[int], mav0: Path, progress: Progress) -> None:
    def shoot(k: int) -> None:
        for side, camera in enumerate(_CAMERAS):
            (mav0 / camera / "data" / f"{frames_t_ns[k]}.png").write_bytes(crew.png(k, frames_t_ns[k], side))

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        try:
            for done, _ in enumerate(pool.map(shoot, range(len(frames_t_ns))), start=1):
                progress.advance(done, len(frames_t_ns), "rendering")
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise


# The cameras --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Pair:
    """Two cameras of one kind, and where they are mounted (4, 4)."""

    camera: Camera
    T_imu_cams: tuple[Array, Array]

    @classmethod
    def of(cls, scenario: Scenario, model: Distortion) -> "_Pair":
        """Return the cameras of a scenario: its rectified pair, or two with lenses, the right one slightly rotated."""
        rig, scale = scenario.rig, _FISHEYE_FOCAL if model == "equidistant" else 1.0
        pinhole_px = (scale * rig.fx_px, scale * rig.fy_px, rig.cx_px, rig.cy_px)
        camera = Camera(pinhole_px, model, np.array(_COEFFICIENTS[model]), scenario.camera.size_px)
        turned = np.eye(3) if model == "none" else so3_exp(_TURNED_RAD)
        return cls(camera, (rig.T_imu_cam, rig.T_imu_cam @ se3(turned, np.array([rig.baseline_m, 0.0, 0.0]))))


class _Crew:
    """Takes any image of a recording, in any order: each has a random stream of its own for its noise."""

    def __init__(
        self, trajectory: SmoothTrajectory, surfaces: Surfaces, pair: _Pair, filming: Filming, seed: int
    ) -> None:
        self._trajectory, self._surfaces, self._pair, self._seed = trajectory, surfaces, pair, seed
        self._filming, self._eye = filming, Eye.of(pair.camera)
        atlas()  # before any thread asks for it
        self._swing_rad = 2.0 * np.pi * float(self._rng(0, 2).uniform())

    def png(self, k: int, t_ns: int, side: int) -> bytes:
        """Return the image of the left (0) or right (1) camera at frame k, whose stamp is the middle of exposure."""
        import cv2

        t_s = (t_ns - START_NS) / NS_PER_S

        def shot(at_s: float) -> Floats:
            T_world_imu = self._trajectory.at(np.array([at_s])).T_world_imu[0]
            return light(self._surfaces(at_s), self._eye, T_world_imu @ self._pair.T_imu_cams[side])

        gain = (1.0 + _SWING * np.sin(2.0 * np.pi * t_s / _SWING_S + self._swing_rad)) * (_RIGHT_GAIN if side else 1.0)
        exposure_s = self._filming.exposure_s
        shots_s = t_s + exposure_s * ((np.arange(_SHOTS) + 0.5) / _SHOTS - 0.5) if exposure_s else [t_s]
        seen = np.asarray(np.mean([shot(float(at_s)) for at_s in shots_s], axis=0), dtype=np.float32)
        image = developed(seen, gain, self._rng(k, side))
        return cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, 1])[1].tobytes()

    def _rng(self, k: int, what: int) -> np.random.Generator:
        return np.random.default_rng(np.random.SeedSequence(self._seed, spawn_key=(_IMAGES_STREAM, k, what)))


# The folder ---------------------------------------------------------------------------------------------------------


def _write_tables(sequence: Sequence, pair: _Pair, scenario: Scenario, mav0: Path) -> None:
    stamps = sequence.frames_t_ns.tolist()
    names = "".join(f"{t},{t}.png\n" for t in stamps)
    for camera, T_imu_cam in zip(_CAMERAS, pair.T_imu_cams, strict=True):
        (mav0 / camera / "data").mkdir(parents=True)
        (mav0 / camera / "data.csv").write_text(f"#timestamp [ns],filename\n{names}")
        about = _sensor_yaml(
            "camera",
            T_imu_cam,
            rate_hz=f"{scenario.camera.rate_hz:g}",
            resolution=list(pair.camera.size_px),
            camera_model="pinhole",
            intrinsics=list(pair.camera.pinhole_px),
            distortion_model=_EUROC_NAMES[pair.camera.distortion],
            distortion_coefficients=pair.camera.coefficients.tolist(),
        )
        (mav0 / camera / "sensor.yaml").write_text(about)
    imu, sensor, truth = sequence.motion, scenario.motion, sequence.truth
    assert isinstance(imu, ImuSamples) and isinstance(sensor, Imu)
    assert truth is not None and truth.v_world is not None and truth.bias is not None
    (mav0 / "imu0").mkdir()
    heading = _columns(w_RS_S="rad s^-1", a_RS_S="m s^-2")
    samples = _table(imu.t_ns.tolist(), heading, np.hstack([imu.gyro_radps, imu.accel_mps2]))
    (mav0 / "imu0/data.csv").write_text(samples)
    stated = {"rate_hz": sensor.rate_hz} | {
        f"{name}_{kind}": getattr(sensor.noise, f"{short}_{kind}")
        for name, short in (("gyroscope", "gyro"), ("accelerometer", "accel"))
        for kind in ("noise_density", "random_walk")
    }
    about = _sensor_yaml("imu", np.eye(4), **{name: f"{value:g}" for name, value in stated.items()})
    (mav0 / "imu0/sensor.yaml").write_text(about)
    poses = truth.T_world_imu
    q_wxyz = np.roll(quaternion_from_rotation(poses[:, :3, :3]), 1, axis=1)
    values = np.hstack([poses[:, :3, 3], q_wxyz, truth.v_world, truth.bias[:, 3:], truth.bias[:, :3]])
    heading = (
        _columns(p_RS_R="m")
        + "".join(f",q_RS_{axis} []" for axis in "wxyz")
        + _columns(v_RS_R="m s^-1", b_w_RS_S="rad s^-1", b_a_RS_S="m s^-2")
    )
    (mav0 / _TRUTH).mkdir()
    (mav0 / _TRUTH / "data.csv").write_text(_table(truth.t_ns.tolist(), heading, values))
    (mav0 / _TRUTH / "sensor.yaml").write_text(_sensor_yaml("ground truth", np.eye(4)))


def _columns(**units: str) -> str:
    return "".join(f",{name}_{axis} [{unit}]" for name, unit in units.items() for axis in "xyz")


def _table(t_ns: list[int], heading: str, values: Array) -> str:
    rows = (f"{t},{','.join(f'{x:.15g}' for x in row)}\n" for t, row in zip(t_ns, values.tolist(), strict=True))
    return f"#timestamp{heading}\n{''.join(rows)}"


def _sensor_yaml(kind: str, T_imu_sensor: Array, **fields: object) -> str:
    data = ", ".join(f"{x:.15g}" for x in T_imu_sensor.ravel())
    head = f"%YAML:1.0\nsensor_type: {kind}\ncomment: simulated\nT_BS:\n  cols: 4\n  rows: 4\n  data: [{data}]\n"
    return head + "".join(f"{name}: {value}\n" for name, value in fields.items())


def is_simulated(root: Path) -> bool:
    try:
        return SCHEMA in (root / ABOUT).read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError):
        return False


def _written_by_us(directory: Path) -> frozenset[str]:
    """Return the file names of a folder that was written here; none without its mark, as it may be a real recording."""
    if not is_simulated(directory):
        return frozenset()
    sensors = (*_CAMERAS, "imu0", _TRUTH)
    tables = [f"mav0/{sensor}/{name}" for sensor in sensors for name in ("", "data.csv", "sensor.yaml")]
    images = [path for c in _CAMERAS for path in directory.glob(f"mav0/{c}/data/*.png") if path.stem.isdecimal()]
    folders = ["mav0/", *(f"mav0/{c}/data/" for c in _CAMERAS)]
    return frozenset({ABOUT, *folders, *tables, *(path.relative_to(directory).as_posix() for path in images)})


def errors_px(sequence: Sequence) -> Array:
    """Return the error of each sighting (N, 3) px; NaN where the frame has no truth or the ray meets nothing."""
    truth, seen, rig = sequence.truth, sequence.observations, sequence.rig
    if truth is None:
        return np.full((len(seen), 3), np.nan)
    row, is_true = rows_of(sequence.frames_t_ns, truth.t_ns)
    T_world_cam = np.where(is_true[:, None, None], truth.T_world_imu[row] @ rig.T_imu_cam, np.nan)
    _, first, track = np.unique(seen.track_id, return_index=True, return_inverse=True)
    u_px, _, v_px = seen.uv_px[first].T
    rays = np.stack([(u_px - rig.cx_px) / rig.fx_px, (v_px - rig.cy_px) / rig.fy_px, np.ones(first.size)], axis=1)
    points = _met(T_world_cam[seen.frame[first]], rays)
    return seen.uv_px - stereo.project(transform(se3_inverse(T_world_cam)[seen.frame], points[track]), rig)


def _met(T_world_cam: Array, rays: Array) -> Array:
    """Return the points (M, 3) of the hall that rays (M, 3), each from its own camera (M, 4, 4), meet first."""
    origin, towards = T_world_cam[:, :3, 3], (T_world_cam[:, :3, :3] @ rays[:, :, None])[..., 0]
    nearest = np.full(len(rays), np.inf)
    with np.errstate(divide="ignore", invalid="ignore"):
        for panel in furnished_hall()(0.0):
            axes, corner = panel.T_world_panel[:3, :3], panel.T_world_panel[:3, 3]
            start, step = (origin - corner) @ axes, towards @ axes
            reach = -start[:, 2] / step[:, 2]
            place = start[:, :2] + reach[:, None] * step[:, :2]
            inside = ((place >= 0.0) & (place <= panel.size_m)).all(axis=1)
            met = inside & (start[:, 2] > 0.0) & (reach > 0.0) & (reach < nearest)
            nearest[met] = reach[met]
        return np.where(np.isfinite(nearest)[:, None], origin + nearest[:, None] * towards, np.nan)


def with_scene_errors(sequence: Sequence) -> Sequence:
    """Return the sequence, made of rendered images, with the size of its tracks' errors as a fact."""
    off_px = errors_px(sequence)
    off_px = off_px[np.isfinite(off_px).all(axis=1)]
    if not len(off_px):
        return sequence
    u_left, u_right, v = (MAD_TO_SIGMA * np.median(np.abs(off_px), axis=0)).tolist()
    beyond = 100.0 * float((np.abs(off_px) > _MISMATCH_PX).any(axis=1).mean())
    fact = (
        f"against the rendered scene, at the points that tracks began with, sightings are off by {u_left:.2f} px (uL), "
        f"{u_right:.2f} px (uR) and {v:.2f} px (v), by the median; {beyond:.1f} % by more than {_MISMATCH_PX:g} px"
    )
    provenance = sequence.provenance
    return replace(sequence, provenance=replace(provenance, facts=(provenance.facts[0], fact, *provenance.facts[1:])))
