"""EuRoC (ASL) recordings: the real IMU, with stereo tracks from the images or simulated along the true trajectory.

A folder with ``mav0/`` (or ``mav0`` itself), or a lean one: imu.csv, cam_timestamps_ns.txt and a truth table. Where
nearly all stamps have both images, the tracks are made of them (:mod:`toolkit.frontend`): undistorted and rectified
with the folder's calibration, sensor.yaml or Kalibr's camchain, as TUM-VI has it. Otherwise what the pair would see is
simulated at the real camera stamps: a rectified pair with the left camera's intrinsics and extrinsic and the real
baseline, in a room around the trajectory. The sequence's name and provenance state which, and with them every report.

Where tracks are simulated, errors of the truth reach the estimators as disagreement of tracks and IMU;
``io/euroc_calibration`` has the noise densities that allow for it.
The body is the IMU; quaternions are Hamilton, w first.
Source: Burri et al., "The EuRoC micro aerial vehicle datasets" (IJRR 2016).
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from toolkit.datasets.io.euroc_calibration import PIXEL_SIGMA_PX, AslCalibration, published, read_calibration
from toolkit.datasets.io.fields import check_frame_count
from toolkit.datasets.io.image_pairs import Listed, check_both_cameras, image_folder, images_in, pairs_of_asl, seen_in
from toolkit.datasets.io.tables import columns_of_file, headings_of, imu_columns, read_stamps
from toolkit.datasets.io.truth import (
    LONGEST_TRUTH_GAP_S,
    find_truth,
    seconds_apart,
    stamps_within,
    truth_at,
    truth_near,
)
from toolkit.errors import DataError, printable
from toolkit.files.reading import is_regular
from toolkit.frontend import ImageRecording, rectified
from toolkit.geometry import Array
from toolkit.measurements import StereoRig
from toolkit.motion_samples import ImuSamples
from toolkit.progress import Progress
from toolkit.sequence import Observations, Provenance, Sequence
from toolkit.settings import Frontend, Tracks
from toolkit.simulation import scenes, sensors
from toolkit.simulation.filming import is_simulated, with_scene_errors
from toolkit.simulation.sensors import CameraLimits

CITES = ("burri2016euroc",)
REAL = "real IMU, stereo tracks from the images"
RENDERED = "simulated IMU, stereo tracks from rendered images"
SIMULATED = "real IMU, stereo tracks simulated on the true trajectory"
ALL_SIMULATED = "simulated IMU, stereo tracks simulated on the true trajectory"
_STAMPS, _LEAN_IMU = "cam_timestamps_ns.txt", "imu.csv"
_GYRO, _ACCEL = (tuple(f"{name}_{axis}" for axis in "xyz") for name in ("w_RS_S", "a_RS_S"))
_MAX_TRACKS, _RATE_HZ, _LOSS_PER_FRAME = 100, 20.0, 0.02
_BAGS = {".bag", ".db3", ".mcap"}
# With fewer of its images a recording is cut short or a sample: tracks from them would be of another recording.
_NEARLY_ALL = 0.9
# Up to 14 m the disparity stays five standard deviations above zero.
_DEPTH_M = (0.5, 14.0)
# The walls stand this far outside the box of all positions: below, beside and above.
_MARGIN_LOWER_M, _MARGIN_UPPER_M = np.array([2.0, 2.0, 1.0]), np.array([2.0, 2.0, 1.5])
# So dense that a pair with EuRoC's field of view has 100 landmarks before it at 2 m from a wall.
_LANDMARKS_PER_M2 = 20.0
# A hall of 100 m by 100 m by 20 m; what flies farther flies outdoors, and a damaged truth farther still.
_MOST_SURFACE_M2 = 28_000.0
_WORLD_SEED = 20  # draws the landmarks, the same for every seed of the noise


@dataclass(frozen=True)
class _Layout:
    """Where a recording keeps its parts; ``mav0`` is None in a lean one."""

    root: Path
    mav0: Path | None

    @property
    def imu(self) -> Path:
        """The table of the IMU, which Kalibr's bag extractor puts beside the cameras."""
        if self.mav0 is None:
            return self.root / _LEAN_IMU
        extracted = self.mav0 / "imu0.csv"
        return extracted if is_regular(extracted) else self.mav0 / "imu0" / "data.csv"

    @property
    def stamps(self) -> Path:
        beside = self.root / _STAMPS
        return beside if self.mav0 is None or beside.is_file() else self.mav0 / "cam0" / "data.csv"


def recognises(path: Path) -> bool:
    """Say whether the path is laid out as an ASL folder, whole or lean."""
    return _layout(path) is not None


def load(path: Path) -> Sequence:
    """Read a recording with simulated tracks and the noise of seed 0; see :func:`load_with_seed`."""
    return load_with_seed(path, 0)


def uses_images(path: Path, tracks: Tracks) -> bool:
    """Say whether the tracks are made of the images: as asked for, or where nearly all stamps have both of theirs."""
    layout = _layout(path)
    if tracks != "auto" or layout is None or layout.mav0 is None:
        return tracks == "images"
    return _share_with_images(layout.mav0, layout.stamps) >= _NEARLY_ALL


def images_of(path: Path, frontend: Frontend) -> ImageRecording:
    """Return the image pairs within the IMU's time and their cameras; raises DataError as :func:`load_from_images`."""
    layout = _whole(path)
    mav0 = _with_images(layout)
    return _filmed(layout, mav0, _imu(layout), read_calibration(layout.root, mav0))[0]


def load_from_images(path: Path, frontend: Frontend, progress: Progress) -> Sequence:
    """Read IMU and calibration, and make the tracks of the image pairs within the IMU's time; a truth may be missing.

    Raises DataError where a part is missing or damaged, or the images cannot be used.
    """
    layout = _whole(path)
    mav0 = _with_images(layout)
    imu, calibration = _imu(layout), read_calibration(layout.root, mav0)
    filmed, remarks = _filmed(layout, mav0, imu, calibration)
    seen = seen_in(layout.root, filmed, calibration.T_imu_left, frontend, progress)
    choice = find_truth(layout.root, mav0, imu)
    truth, of_truth = (None, ()) if choice is None else truth_near(choice.truth, seen.frames_t_ns)
    facts = (
        *seen.facts,
        *remarks,
        *(() if choice is None else choice.facts),
        *of_truth,
        *(calibration.source, calibration.noise_source, *calibration.shifted, *calibration.unused),
    )
    simulated = is_simulated(layout.root)
    sequence = Sequence(
        name=layout.root.name,
        rig=seen.rig,
        noise=calibration.noise,
        frames_t_ns=seen.frames_t_ns,
        observations=seen.observations,
        motion=imu,
        provenance=Provenance("euroc", f"{path}: {RENDERED if simulated else REAL}", facts),
        truth=truth,
    )
    return with_scene_errors(sequence) if simulated else sequence


def load_with_seed(path: Path, seed: int) -> Sequence:
    """Read IMU, calibration, stamps and truth, and simulate the tracks at the stamps both IMU and truth reach.

    The seed draws the pixel noise and the ends of tracks; the landmarks are the same under every seed. Raises
    DataError where a part is missing or damaged, or there is no truth to simulate along.
    """
    layout = _whole(path)
    imu = _imu(layout)
    calibration = published() if layout.mav0 is None else read_calibration(layout.root, layout.mav0)
    choice, few_images = find_truth(layout.root, layout.mav0, imu), tuple(_few_images(layout))
    if choice is None:
        where = "mav0/state_groundtruth_estimate0/data.csv or a .csv or .tum table beside it"
        why = "and the stereo tracks are simulated along it where there are no images; add one of them"
        raise DataError(": ".join((f"{layout.root}: no ground truth in {where}, {why}", *few_images)))
    stamps = read_stamps(layout.stamps)
    frames_t_ns = stamps_within(stamps, imu.t_ns, choice.truth.t_ns)
    if frames_t_ns.size < 2 and seconds_apart(choice.truth) > LONGEST_TRUTH_GAP_S:
        slow = f"the truth has a pose every {seconds_apart(choice.truth):.3g} s"
        why = "where there are no images the tracks are simulated along it"
        raise DataError(f"{layout.root}: {slow}, and {why}; give a truth of 10 Hz or more")
    check_frame_count(layout.root, frames_t_ns.size)
    truth = truth_at(choice.truth, frames_t_ns)
    points = _room_around(layout.root, truth.T_world_imu[:, :3, 3])
    camera = CameraLimits(_RATE_HZ, calibration.size_px, _DEPTH_M, _MAX_TRACKS, _LOSS_PER_FRAME)
    kind, errors = SIMULATED, ", and errors of the truth appear as errors of the IMU"
    if is_simulated(layout.root):
        kind, errors = ALL_SIMULATED, ""
    tracks = f"{_MAX_TRACKS} a frame, {PIXEL_SIGMA_PX:g} px of noise, landmarks in a room around the trajectory"
    how = f"{kind} ({tracks}): no image was read{errors}"
    return Sequence(
        name=f"{layout.root.name} (simulated stereo)",
        rig=calibration.rig,
        noise=calibration.noise,
        frames_t_ns=frames_t_ns,
        observations=_tracks_of(points, truth.T_world_imu, calibration.rig, camera, seed),
        motion=imu,
        provenance=Provenance(
            "euroc",
            f"{path}: {kind}, seed {seed}",
            (how, *choice.facts, calibration.source, calibration.noise_source, *calibration.unused, *few_images),
        ),
        truth=truth,
    )


def _whole(path: Path) -> _Layout:
    layout = _layout(path)
    assert layout is not None  # as of what is recognised
    return layout


def _imu(layout: _Layout) -> ImuSamples:
    if layout.mav0 is not None and not is_regular(layout.imu):
        files = sorted((*layout.root.glob("*"), *layout.root.glob("*/*")))
        bags = [path.relative_to(layout.root).parts[0] for path in files if _BAGS & set(path.suffixes)]
        if bags:
            raise DataError(f"{layout.root}: holds no measurements but those of a bag: name {printable(bags[0])} in it")
        raise DataError(
            f"{layout.imu}: cannot be read, and there is no imu0.csv of Kalibr's: name the folder that has mav0, or "
            "rectify images without an IMU and lay them out as KITTI's image_0, image_1 and calib.txt"
        )
    table = columns_of_file(layout.imu)
    values = table.numbers(*(imu_columns(table.names) or _ACCEL + _GYRO))
    return ImuSamples(table.whole(table.names[0]), values[:, :3], values[:, 3:])


def _few_images(layout: _Layout) -> Iterator[str]:
    if layout.mav0 is None or not _has_images(layout.mav0):
        return
    share = _share_with_images(layout.mav0, layout.stamps)
    if share < _NEARLY_ALL:
        if share > 0.0:
            yield f"{100.0 * share:.1f} % of the camera's stamps have both images; --tracks images uses those there are"
            return
        count = len(images_in(image_folder(layout.mav0 / "cam0")))
        lacking = _no_pair_is_there(layout.mav0, pairs_of_asl(layout.mav0))
        yield f"the tracks are simulated although {count} images lie in cam0: {lacking}"


def _with_images(layout: _Layout) -> Path:
    if layout.mav0 is None:
        raise DataError(f"{layout.root}: a lean recording has no images; its tracks can be simulated")
    if _has_images(layout.mav0):
        check_both_cameras(layout.root, *(image_folder(layout.mav0 / camera) for camera in ("cam0", "cam1")))
    return layout.mav0


def _filmed(
    layout: _Layout, mav0: Path, imu: ImuSamples, calibration: AslCalibration
) -> tuple[ImageRecording, tuple[str, ...]]:
    """Return the pairs within the IMU's time with their cameras, and what had to be put right."""
    if calibration.cameras is None:
        raise DataError(f"{layout.root}: the calibration lacks distortion_model or intrinsics of a camera; add them")
    named = pairs_of_asl(mav0)
    if named.apart_ms is not None:
        apart = f"no image of cam0 has one of cam1 within 1 ms, the nearest is {named.apart_ms:.4g} ms away (median)"
        remedy = "where only the cameras' clocks differ, correct the stamps of cam1"
        raise DataError(f"{mav0}: {apart}: a stereo pair has one trigger; {remedy}")
    listed = named.existing(_NEARLY_ALL)
    if named.pairs and not listed.pairs:
        raise DataError(f"{mav0}: {_no_pair_is_there(mav0, named)}")
    check_frame_count(layout.root, len(listed.pairs))
    listed = listed.shifted(calibration.shift_s)
    shifted = f" (timeshift_cam_imu, {calibration.shift_s:g} s, is added to the images')" if calibration.shift_s else ""
    samples = f"the samples of the IMU{shifted}"
    within = listed.within(layout.root, imu.t_ns, samples)
    rig = rectified(*calibration.cameras, calibration.T_right_left, str(mav0))
    return ImageRecording(within.pairs, rig), within.remarks


def _no_pair_is_there(mav0: Path, named: Listed) -> str:
    if not named.pairs:
        return "no image of cam0 has one of cam1 by its name or its table; write cam0/data.csv and cam1/data.csv"
    first = named.pairs[0].left
    return (
        f"none of the {len(named.pairs)} image pairs of the tables is there, as {first.name} in "
        f"{first.parent.relative_to(mav0)}; take these images' own data.csv, or none, where their names are stamps"
    )


def _share_with_images(mav0: Path, stamps: Path) -> float:
    """Return which share of the camera's stamps have both images; 0 where nothing can be read."""
    if not _has_images(mav0):
        return 0.0
    try:
        count = np.unique(read_stamps(stamps)).size if is_regular(stamps) else 0
        listed = pairs_of_asl(mav0)
    except DataError:
        return 1.0  # there are images: what is wrong with their stamps is said when they are read
    if listed.apart_ms is not None:
        return 1.0  # as above
    there = sum(is_regular(pair.left) and is_regular(pair.right) for pair in listed.pairs)
    return there / max(count, listed.stamps, 1)


def _has_images(mav0: Path) -> bool:
    return any(images_in(image_folder(mav0 / camera)) for camera in ("cam0", "cam1"))


def _layout(path: Path) -> _Layout | None:
    path = path.resolve()
    mav0 = next((p for p in (path / "mav0", path) if (p / "imu0").is_dir() or (p / "cam0").is_dir()), None)
    if mav0 is not None:
        return _Layout(mav0.parent if mav0.name == "mav0" else mav0, mav0)
    lean = (path / _STAMPS).is_file() or headings_of(path / _LEAN_IMU) >= set(_GYRO)
    return _Layout(path, None) if lean else None


def _tracks_of(points: Array, T_world_imu: Array, rig: StereoRig, camera: CameraLimits, seed: int) -> Observations:
    """Simulate what a tracker sees of points (N, 3) m from poses (K, 4, 4), with the noise of the rig's covariance."""
    tracks_rng, pixels_rng = (np.random.default_rng(stream) for stream in np.random.SeedSequence(seed).spawn(2))
    tracks = sensors.follow(sensors.visibility(points, T_world_imu, rig, camera), camera, tracks_rng)
    exact = sensors.sightings(tracks, points, T_world_imu, rig)
    # Track ids grow with time and a frame's places keep their order, so the rows are sorted already.
    return sensors.with_pixel_noise(exact, 1.0, rig.cov_uv_px2, camera.step_px, pixels_rng)


def _room_around(root: Path, positions: Array) -> Array:
    """Return landmarks (N, 3) m on the walls of a room around positions (K, 3); raises DataError where it is a hall."""
    lower, upper = positions.min(axis=0) - _MARGIN_LOWER_M, positions.max(axis=0) + _MARGIN_UPPER_M
    x, y, z = upper - lower
    surface_m2 = 2.0 * float(x * y + y * z + z * x)
    if not surface_m2 < _MOST_SURFACE_M2:
        span, remedy = f"{np.ptp(positions, axis=0).max():.3g} m", "check its unit, or take the tracks of images"
        raise DataError(f"{root}: the truth spans {span}, and tracks are simulated in a room; {remedy}")
    return scenes.room(lower, upper, round(_LANDMARKS_PER_M2 * surface_m2), np.random.default_rng(_WORLD_SEED))
