"""ASL folders with images, from end to end: the choice of tracks, what is left out and named.

What is refused stands in the table of tests/datasets/test_advice.py.
"""

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from tests.datasets.conftest import edit
from tests.frontend.conftest import PERIOD_NS, START_NS
from toolkit.datasets import is_drawn_from_a_seed, load_images, load_sequence
from toolkit.datasets.io.euroc_calibration import read_calibration
from toolkit.datasets.io.image_pairs import pairs_of_asl
from toolkit.errors import DataError
from toolkit.experiment.recording import Recording, prepare
from toolkit.frontend import rectified, track_images, tracking
from toolkit.frontend.cameras import Image
from toolkit.geometry import se3_inverse
from toolkit.settings import Frontend

FRAMES = 10
IMAGES = "mav0/cam{}/data"


def images(root: Path, camera: int) -> list[Path]:
    return sorted((root / IMAGES.format(camera)).iterdir())


def test_a_folder_with_few_of_its_images_has_its_tracks_simulated_and_says_so(asl: Path) -> None:
    for path in images(asl, 1)[:4]:
        path.unlink()
    facts = load_sequence(str(asl)).provenance.facts
    assert "no image was read" in facts[0]
    assert facts[-1].startswith("60.0 % of the camera's stamps have both images")
    sequence = load_sequence(str(asl), 0, Frontend(tracks="images"))
    assert sequence.frame_count == FRAMES - 4


def test_the_rig_is_the_rectified_one_as_it_is_mounted(asl: Path) -> None:
    rig = load_sequence(str(asl)).rig
    assert rig.baseline_m == pytest.approx(0.12, abs=1e-3)
    T_imu_left = load_sequence(str(asl), 0, Frontend(tracks="simulated")).rig.T_imu_cam
    turned = se3_inverse(T_imu_left) @ rig.T_imu_cam
    np.testing.assert_allclose(turned[:3, 3], 0.0, atol=1e-9)
    assert 0.003 < np.arccos(0.5 * (np.trace(turned[:3, :3]) - 1.0)) < 0.03  # half of what the two differ by, and more


def test_an_estimator_finds_the_motion_in_the_images(asl: Path, run_estimator: Callable[..., Any]) -> None:
    prepared = prepare(Recording(str(asl)))
    run = run_estimator("batch", prepared.sequence, prepared.prior)
    assert run.status == "ok"
    found = run.final.T_world_imu[:, :3, 3]
    truth = prepared.sequence.truth
    assert truth is not None
    moved = np.linalg.norm(found - found[0], axis=1)
    true = np.linalg.norm(truth.T_world_imu[:, :3, 3] - truth.T_world_imu[0, :3, 3], axis=1)
    # 0.15 m of motion, seen at 1.6 to 3 m
    np.testing.assert_allclose(moved, true, atol=0.005)


def test_what_was_tracked_is_kept_and_other_images_or_settings_are_tracked_anew(
    asl: Path, own_cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def kept() -> list[Path]:
        return list((own_cache / "tracks").iterdir())

    sequence = load_sequence(str(asl))
    assert "stereo tracks from the images" in sequence.provenance.source
    first = sequence.content_hash()
    assert not is_drawn_from_a_seed(str(asl))
    assert load_sequence(str(asl), 5).content_hash() == first
    (file,) = kept()
    file.write_bytes(file.read_bytes()[:500])  # what is damaged is made again
    assert load_sequence(str(asl), 0, Frontend(tracks="images")).content_hash() == first
    assert len(kept()) == 1
    with monkeypatch.context() as patched:
        patched.setattr(tracking, "Tracker", None)
        assert load_sequence(str(asl)).content_hash() == first
    load_sequence(str(asl), 0, Frontend(window_px=21))
    assert len(kept()) == 2
    shutil.copy(images(asl, 0)[3], images(asl, 0)[4])
    load_sequence(str(asl))
    assert len(kept()) == 3


def rewrite(path: Path, change: Callable[[Image], Any]) -> None:
    read = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert read is not None
    cv2.imwrite(str(path), change(np.asarray(read, dtype=np.uint8)))


def every(root: Path, camera: int, change: Callable[[Image], Any]) -> None:
    for path in images(root, camera):
        rewrite(path, change)


def reverse_rows(path: Path) -> None:
    head, *rows = path.read_text().splitlines()
    path.write_text("\n".join([head, *rows[::-1]]) + "\n")


def stalled(root: Path) -> None:
    for camera in (0, 1):
        for path in images(root, camera)[5:8]:
            shutil.copy(images(root, camera)[4], path)


def until_the_seventh(imu: Path) -> None:
    head, *rows = imu.read_text().splitlines()
    end_ns = START_NS + 6 * PERIOD_NS
    imu.write_text("\n".join([head, *(row for row in rows if int(row.split(",")[0]) <= end_ns)]) + "\n")


def drop_row(path: Path, row: int) -> None:
    rows = path.read_text().splitlines()
    path.write_text("\n".join([*rows[:row], *rows[row + 1 :]]) + "\n")


# What is spoilt, how many pairs are left out, and what is told of that.
LEFT_OUT: list[tuple[Callable[[Path], object], int, str]] = [
    (lambda d: images(d, 0)[7].write_bytes(images(d, 0)[7].read_bytes()[:900]), 1, "damaged or truncated"),
    (lambda d: rewrite(images(d, 1)[7], lambda i: i[::-1]), 1, "not of the same instant"),
    (stalled, 3, "those of the pair before"),
    (lambda d: drop_row(d / "mav0/cam1/data.csv", 8), 1, "1 left images have no right one"),
    (
        lambda d: until_the_seventh(d / "mav0/imu0/data.csv"),
        3,
        "3 of 10 image pairs are outside the time of the motion",
    ),
]


@pytest.mark.parametrize(("spoil", "count", "complaint"), LEFT_OUT)
def test_bad_images_are_named_and_left_out(
    asl: Path, spoil: Callable[[Path], object], count: int, complaint: str
) -> None:
    name = images(asl, 0)[7].name
    spoil(asl)
    sequence = load_sequence(str(asl), 0, Frontend(tracks="images"))
    assert sequence.frame_count == FRAMES - count
    told = " ".join(sequence.provenance.facts)
    assert complaint in told
    if complaint not in (LEFT_OUT[-2][2], LEFT_OUT[-1][2]):  # of images that are there and cannot be used
        assert f"{count} of {FRAMES} image pairs" in told
        assert name in told
    seen = sequence.observations
    behind = min(7, sequence.frame_count - 1)
    across = np.intersect1d(seen.track_id[seen.frame == behind - 1], seen.track_id[seen.frame == behind])
    assert across.size > 20  # the tracks go on behind it


USED: list[Callable[[Path], object]] = [
    lambda d: [every(d, c, lambda i: cv2.merge([i, i, i])) for c in (0, 1)],
    lambda d: every(d, 1, lambda i: i.astype(np.uint16) * 256),
    lambda d: [reverse_rows(d / f"mav0/cam{c}/data.csv") for c in (0, 1)],
    lambda d: [(d / f"mav0/cam{c}/data.csv").unlink() for c in (0, 1)],
    lambda d: [edit(d / f"mav0/cam{c}/data.csv", "#timestamp [ns],filename\n", "") for c in (0, 1)],
    lambda d: (d / "mav0/cam0/data.csv").write_text((d / "mav0/cam0/data.csv").read_text(), newline="\r\n"),
]


@pytest.mark.parametrize("change", USED)
def test_the_same_images_in_another_guise_give_the_same_tracks(asl: Path, change: Callable[[Path], object]) -> None:
    before = load_sequence(str(asl))
    change(asl)
    after = load_sequence(str(asl), 0, Frontend(tracks="images"))
    np.testing.assert_array_equal(after.observations.uv_px, before.observations.uv_px)
    np.testing.assert_array_equal(after.frames_t_ns, before.frames_t_ns)


def test_a_truth_that_turns_otherwise_than_the_gyro_is_reported(asl: Path) -> None:
    def stranger() -> bool:
        return any("its rotation differs from the gyro's" in fact for fact in load_sequence(str(asl)).provenance.facts)

    assert not stranger()
    rows = [line.split() for line in (asl / "truth.tum").read_text().splitlines()]
    for row in rows:  # turned about the vertical, to and fro within half a second
        half_rad = 0.1 * np.sin(4.0 * np.pi * float(row[0]))
        row[4:] = ["0", "0", f"{np.sin(half_rad):.9f}", f"{np.cos(half_rad):.9f}"]
    (asl / "truth.tum").write_text("".join(f"{' '.join(row)}\n" for row in rows))
    assert stranger()


def test_a_truth_too_slow_to_be_interpolated_is_kept_at_its_own_stamps(asl: Path) -> None:
    lines = (asl / "truth.tum").read_text().splitlines(keepends=True)[::3]
    (asl / "truth.tum").write_text("".join(lines))
    truth = load_sequence(str(asl)).truth
    assert truth is not None
    stamps_s = [float(line.split()[0]) for line in lines]
    np.testing.assert_allclose(truth.t_ns / 1e9, stamps_s, rtol=0.0, atol=2.4e-7)  # as doubles they are so far apart


def test_images_that_are_not_used_are_spoken_of_where_tracks_are_simulated(asl: Path) -> None:
    for camera in (0, 1):
        for path in reversed(images(asl, camera)):
            path.rename(path.with_stem(str(int(path.stem) + 7)))
    simulated = "the tracks are simulated although 10 images lie in cam0: none of the 10 image pairs of the tables is"
    assert load_sequence(str(asl)).provenance.facts[-1].startswith(simulated)
    with pytest.raises(DataError, match=r"none of the 10 image pairs .* is there, as 1403.*\.png in cam0/data"):
        load_sequence(str(asl), 0, Frontend(tracks="images"))


def as_rows(key: str, T: Any) -> str:
    return f"  {key}:\n" + "".join(f"  - [{', '.join(f'{x:.12g}' for x in row)}]\n" for row in T)


def as_opencv(key: str, T: Any) -> str:
    numbers = ", ".join(f"{x:.12g}" for x in T.ravel())
    return f"  {key}: !!opencv-matrix\n    rows: 4\n    cols: 4\n    dt: d\n    data: [{numbers}]\n"


def camchain(
    root: Path, key: str = "T_cn_cnm1", write: Callable[..., str] = as_rows, more: tuple[str, str] = ("", "")
) -> None:
    """Put Kalibr's files in the place of sensor.yaml, with more of each camera."""
    T_left_imu = se3_inverse(load_sequence(str(root), 0, Frontend(tracks="simulated")).rig.T_imu_cam)
    T_right_left = read_calibration(root, root / "mav0").T_right_left
    T = T_right_left if key == "T_cn_cnm1" else T_right_left @ T_left_imu
    for sensor in ("cam0", "cam1", "imu0"):
        (root / "mav0" / sensor / "sensor.yaml").unlink()
    common = (
        "  camera_model: pinhole\n  distortion_coeffs: [-0.28, 0.07, 2.0e-4, 1.0e-4]\n  distortion_model: radtan\n"
        "  intrinsics: [230.0, 228.0, 163.0, 118.0]\n  resolution: [320, 240]\n  rostopic: /cam/image_raw\n"
    )
    of_each = (more[0] + write("T_cam_imu", T_left_imu), more[1] + write(key, T))
    chain = "".join(f"cam{c}:\n{of_each[c]}  cam_overlaps: [{1 - c}]\n{common}" for c in (0, 1))
    (root / "camchain-imucam.yaml").write_text(f"%YAML:1.0\n{chain}")
    (root / "imu0.yaml").write_text(
        "accelerometer_noise_density: 2.0e-3\naccelerometer_random_walk: 3.0e-3\ngyroscope_noise_density: 1.7e-4\n"
        "gyroscope_random_walk: 1.9e-5\nrostopic: /imu0\nupdate_rate: 200.0\n"
    )


@pytest.mark.parametrize("write", [as_rows, as_opencv])
@pytest.mark.parametrize("key", ["T_cam_imu", "T_cn_cnm1"])
def test_kalibrs_camchain_is_the_same_calibration(asl: Path, key: str, write: Callable[..., str]) -> None:
    before = load_sequence(str(asl))
    camchain(asl, key, write)
    after = load_sequence(str(asl))
    np.testing.assert_allclose(after.rig.T_imu_cam, before.rig.T_imu_cam, atol=1e-9)
    assert after.rig.baseline_m == pytest.approx(before.rig.baseline_m, rel=1e-9)
    # twelve printed digits move a rectified pixel by nothing that shows
    columns = (np.sort(one.observations.uv_px[:, 0])[::50] for one in (after, before))
    np.testing.assert_allclose(*columns, atol=0.05)
    assert any("camchain-imucam.yaml" in fact for fact in after.provenance.facts)


@pytest.mark.parametrize(("shift_s", "frames"), [(0.0, 10), (0.0052, 9), (-0.0208, 9)])
def test_the_time_shift_that_kalibr_found_is_applied_and_told(asl: Path, shift_s: float, frames: int) -> None:
    """A frame at an end of the motion may fall out of it."""
    before = load_sequence(str(asl)).frames_t_ns
    camchain(asl, more=2 * (f"  timeshift_cam_imu: {shift_s}\n",))
    after = load_sequence(str(asl))
    assert after.frame_count >= frames
    assert np.isin(after.frames_t_ns - round(shift_s * 1e9), before).all()
    told = [fact for fact in after.provenance.facts if "timeshift_cam_imu" in fact]
    words = f"{1e3 * shift_s:+.3f} ms are added to the stamps of images: timeshift_cam_imu in camchain-imucam.yaml"
    assert told == ([words] if shift_s else [])


def test_what_a_calibration_states_and_nobody_uses_is_named(asl: Path) -> None:
    camchain(asl, more=("  line_delay: 1.0e-5\n  timeshift_cam_imu: 0.004\n", "  timeshift_cam_imu: 0.009\n"))
    edit(
        asl / "imu0.yaml",
        "update_rate",
        "T_i_b: [[1.0, 0.0], [0.0, 1.0]]\ntime_offset: 0.0\ngyro_skew: 0.1\nupdate_rate",
    )
    facts = load_sequence(str(asl)).provenance.facts
    assert any("states another timeshift_cam_imu for cam1, +9.000 ms; cam0's is that of both" in fact for fact in facts)
    assert [fact for fact in facts if fact.startswith("not used of")] == [
        "not used of camchain-imucam.yaml: cam0.line_delay",
        f"not used of {asl.name}/imu0.yaml: gyro_skew",
    ]
    (asl / "imu0.yaml").unlink()
    assert any("that of a MEMS unit in motion is assumed" in fact for fact in load_sequence(str(asl)).provenance.facts)
    edit(asl / "camchain-imucam.yaml", "0.004", "500.0")
    with pytest.raises(DataError, match=r"timeshift_cam_imu, 500 s, is added to the images'"):
        load_sequence(str(asl))


def test_the_first_seconds_of_a_real_flight_have_tracks_enough(real: Callable[[str], Path]) -> None:
    root = real("euroc/MH_01_easy_8s")
    calibration = read_calibration(root, root / "mav0")
    assert calibration.cameras is not None
    rig = rectified(*calibration.cameras, calibration.T_right_left, "rig")
    tracks = track_images(pairs_of_asl(root / "mav0").pairs[:12], rig, Frontend())
    a_frame = np.bincount(tracks.frame)
    assert tracks.skipped == ()
    assert a_frame.mean() > 110
    assert a_frame.min() > 60
    lives = np.bincount(tracks.track_id)
    assert lives.mean() > 4


# As people download, extract and convert them -------------------------------------------------------------------------


def stamps(root: Path) -> list[int]:
    pairs = load_images(str(root)).pairs
    assert all(pair.left.is_file() and pair.right.is_file() for pair in pairs)
    return [pair.t_ns for pair in pairs]


def moved(path: Path, folder: str) -> None:
    """Move an image, as into TUM-VI's ``images`` of dso, or into the camera's own folder, as extractors of bags do."""
    target = path.parent.parent / folder
    target.mkdir(exist_ok=True)
    shutil.move(path, target / path.name)


def converted(path: Path, suffix: str) -> None:
    cv2.imwrite(str(path.with_suffix(suffix)), cv2.imread(str(path), cv2.IMREAD_GRAYSCALE))
    path.unlink()


def named_in_seconds(path: Path, _: str) -> None:
    (path.parent.parent / "data.csv").unlink(missing_ok=True)
    path.rename(path.with_name(f"{path.stem[:-9]}.{path.stem[-9:]}.png"))


@pytest.mark.parametrize(
    ("change", "how"),
    [(moved, "images"), (moved, "."), *((converted, end) for end in (".jpg", ".pgm", ".tiff")), (named_in_seconds, "")],
)
def test_images_laid_out_otherwise_are_the_same_recording(
    asl: Path, change: Callable[[Path, str], None], how: str
) -> None:
    """Tables go on to name data/*.png."""
    expected = stamps(asl)
    for image in asl.glob("mav0/cam*/data/*.png"):
        change(image, how)
    for empty in (data for data in asl.glob("mav0/cam*/data") if not any(data.iterdir())):
        empty.rmdir()
    assert stamps(asl) == expected


def test_what_kalibrs_bag_extractor_writes_is_a_recording(asl: Path) -> None:
    expected, motion = stamps(asl), load_sequence(str(asl)).motion
    extracted = asl / "mav0"
    rows = (extracted / "imu0/data.csv").read_text().splitlines()[1:]
    heading = "timestamp,omega_x,omega_y,omega_z,alpha_x,alpha_y,alpha_z"
    (extracted / "imu0.csv").write_text("\n".join([heading, *rows]) + "\n")
    (extracted / "imu0/data.csv").unlink()
    extracted.rename(asl / "extracted")
    assert stamps(asl / "extracted") == expected
    assert (load_sequence(str(asl / "extracted")).motion.values == motion.values).all()


def test_a_recording_without_its_imu_is_told_what_to_do(asl: Path) -> None:
    (asl / "mav0/imu0/data.csv").unlink()
    with pytest.raises(DataError, match=r"no imu0\.csv of Kalibr's: name the folder that has mav0, or rectify"):
        load_sequence(str(asl))


def test_recordings_are_named_some_levels_below(asl: Path, tmp_path: Path) -> None:
    above = tmp_path / "downloads"
    (above / "dataset/sequences").mkdir(parents=True)
    shutil.move(asl, above / "dataset/sequences/00")
    with pytest.raises(DataError, match=r"is not a recording, but contains some: name dataset/sequences/00 in it"):
        load_sequence(str(above))
