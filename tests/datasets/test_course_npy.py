"""The course's pickled recordings: which way the extrinsic goes, how little memory it takes, that nothing is run."""

import io
import pickle
import pickletools
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from tests.datasets.conftest import assert_refused
from toolkit.audit import audit
from toolkit.datasets import load_images, load_sequence
from toolkit.datasets.io.numpy_files import read_dict
from toolkit.geometry import se3, se3_inverse
from toolkit.measurements import NS_PER_S
from toolkit.sequence import NO_FEATURES, Sequence
from toolkit.settings import Frontend
from toolkit.simulation import DRIVE, simulate

T_REGULAR_OPTICAL = se3(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]), np.zeros(3))
CONVENTIONS = {
    "as given, camera axes optical": se3_inverse,
    "as given, camera axes regular": lambda T_imu_cam: se3_inverse(T_imu_cam @ se3_inverse(T_REGULAR_OPTICAL)),
    "inverted, camera axes optical": lambda T_imu_cam: T_imu_cam,
    "inverted, camera axes regular": lambda T_imu_cam: T_imu_cam @ se3_inverse(T_REGULAR_OPTICAL),
}


@cache
def drive() -> Sequence:
    """Return a drive at 30 Hz, as the course records them, with 0.5 px and 0.05 m/s of noise."""
    return simulate(replace(DRIVE, duration_s=4.0, camera=replace(DRIVE.camera, rate_hz=30.0, max_tracks=40)), 0)


def course_dict(sequence: Sequence, convention: str, mismatched: float = 0.05) -> dict[str, Any]:
    """Return a sequence as the course pickles it; a share of the sightings in the right image are mismatches."""
    rig, seen, count = sequence.rig, sequence.observations, sequence.frame_count
    rng = np.random.default_rng(0)
    corners_px = seen.uv_px[:, [0, 2, 1, 2]]
    wrong = rng.random(len(corners_px)) < mismatched
    corners_px[wrong, 2] = rng.uniform(0.0, 2.0 * rig.cx_px, wrong.sum())
    tracks, row = np.unique(seen.track_id, return_inverse=True)
    features = np.full((4, tracks.size, count), -1.0)
    features[:, row, seen.frame] = corners_px.T
    T_imu_right = rig.T_imu_cam @ se3(np.eye(3), np.array([rig.baseline_m, 0.0, 0.0]))
    K = np.array([[rig.fx_px, 0.0, rig.cx_px], [0.0, rig.fy_px, rig.cy_px], [0.0, 0.0, 1.0]])
    return {
        "v_t": sequence.motion.values[:count, :3],
        "w_t": sequence.motion.values[:count, 3:],
        "timestamps": sequence.frames_t_ns / NS_PER_S,
        "features": features,
        **{"K_l": K, "K_r": K},
        "extL_T_imu": CONVENTIONS[convention](rig.T_imu_cam),
        "extR_T_imu": CONVENTIONS[convention](T_imu_right),
    }


def saved(folder: Path, content: Any, name: str = "dataset00.npy") -> Path:
    np.save(folder / name, content, allow_pickle=True)
    return folder / name


@pytest.fixture
def small() -> dict[str, Any]:
    return course_dict(drive().truncated(6), next(iter(CONVENTIONS)))


@pytest.mark.parametrize("convention", CONVENTIONS)
def test_each_convention_of_the_extrinsic_is_found_with_noise_and_mismatches(tmp_path: Path, convention: str) -> None:
    given = saved(tmp_path, course_dict(drive(), convention))
    audited = audit(load_sequence(str(given)))
    # The stereo tracks decide among four candidates; the right one is the simulation's to rounding.
    np.testing.assert_allclose(audited.sequence.rig.T_imu_cam, drive().rig.T_imu_cam, atol=1e-12)
    (reported,) = [finding.detail for finding in audited.findings if finding.fault == "extrinsic-convention"]
    assert reported.endswith(f"the extrinsic is read {convention}")
    assert f"the extrinsic is read {convention}" in audited.sequence.provenance.facts


@pytest.mark.parametrize("convention", [name for name in CONVENTIONS if name.endswith("regular")])
def test_where_the_camera_is_decides_between_readings_that_look_the_same_way(tmp_path: Path, convention: str) -> None:
    """A camera that looks straight ahead: only its lever arm tells an extrinsic in regular axes from its inverse."""
    ahead = replace(DRIVE.rig, T_imu_cam=se3(T_REGULAR_OPTICAL[:3, :3], DRIVE.rig.T_imu_cam[:3, 3]))
    camera = replace(DRIVE.camera, rate_hz=30.0, max_tracks=40)
    sequence = simulate(replace(DRIVE, duration_s=16.0, camera=camera, rig=ahead), 0)
    # As much noise as was added to the course's earlier files: the residuals follow it and not the reading.
    rng = np.random.default_rng(0)
    noise = rng.normal(0.0, np.repeat([0.5, 0.05], 3), sequence.motion.values.shape)
    given = course_dict(sequence, convention)
    given["v_t"], given["w_t"] = np.split(sequence.motion.values + noise, 2, axis=1)
    given["v_t"], given["w_t"] = given["v_t"][: sequence.frame_count], given["w_t"][: sequence.frame_count]
    audited = audit(load_sequence(str(saved(tmp_path, given))))
    assert f"the extrinsic is read {convention}" in audited.sequence.provenance.facts
    (reported,) = [finding.detail for finding in audited.findings if finding.fault == "extrinsic-convention"]
    assert "during rotation the camera's velocity is" in reported


def test_without_sightings_the_convention_is_not_decidable(tmp_path: Path, small: dict[str, Any]) -> None:
    del small["features"]
    sequence = load_sequence(str(saved(tmp_path, small)))
    assert NO_FEATURES in sequence.provenance.facts
    assert "extrinsic-convention" in audit(sequence).undecided


def test_a_recording_is_what_was_saved(tmp_path: Path, small: dict[str, Any]) -> None:
    sequence, original = load_sequence(str(saved(tmp_path, small))), drive().truncated(6)
    assert sequence.rig.baseline_m == pytest.approx(original.rig.baseline_m, rel=1e-12)
    np.testing.assert_array_equal(sequence.motion.values, original.motion.values[:6])
    assert len(sequence.observations) == len(original.observations)
    # Seconds of today as doubles are exact to 0.2 us.
    np.testing.assert_allclose(sequence.frames_t_ns, original.frames_t_ns, atol=500)


def test_cameras_that_differ_in_their_matrices_become_one(tmp_path: Path, small: dict[str, Any]) -> None:
    expected = load_sequence(str(saved(tmp_path, small))).observations
    K, factor, shift = small["K_l"], 1.25, 7.0
    seen = small["features"][2:] != -1.0
    small["K_r"] = np.diag([factor, factor, 1.0]) @ K + np.array([[0, 0, shift], [0, 0, -shift], [0, 0, 0.0]])
    moved = factor * small["features"][2:] + np.array([shift, -shift])[:, None, None]
    small["features"][2:] = np.where(seen, moved, -1.0)
    read = load_sequence(str(saved(tmp_path, small))).observations
    np.testing.assert_allclose(read.uv_px, expected.uv_px, atol=1e-9)


# What must not be run --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "instructions",
    [
        b"cposix\nsystem\n(S'touch touched'\ntR.",
        b"(S'touch touched'\niposix\nsystem\n.",
        b"cnumpy\nndarray\n}X\x01\x00\x00\x00aK\x01sb.",
        b"cnumpy\ndtype\n)\x81.",
        b"\x82\x01.",
        b"Ptext\n.",
        b"\x96" + (1 << 40).to_bytes(8, "little") + b".",
        b"\xff.",
        b"\x8a\xff",
        b"\x80\x04\x8e" + (1 << 50).to_bytes(8, "little") + b"x",  # no memory is taken for what is not there
        b"]r\xff\xff\xff\xff.",
    ],
)
def test_no_instruction_runs_anything(tmp_path: Path, instructions: bytes, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    path = saved(tmp_path, {"v_t": 1})
    path.write_bytes(path.read_bytes()[:128] + instructions)
    assert_refused(lambda: load_sequence(str(path)), path, r"names posix\.system|damaged or truncated|holds no dict")
    assert [entry.name for entry in tmp_path.iterdir()] == [path.name]


def test_the_reader_agrees_with_pickle_on_plain_data(tmp_path: Path) -> None:
    values = {
        "numbers": [0, 1, -1, 255, 256, 65536, -(2**40), 2**70, 1.5, float("inf"), True, False, None],
        "texts": ["", "a" * 300, "é"],
        "nested": {"list": [[], [1, [2]], ()], "pair": (1, 2), "triple": (1, 2, 3), "more": (1, 2, 3, 4)},
        "scalar": np.float64(2.5),
        "bytes": b"abc",
    }
    arrays = {"swapped": np.arange(6.0).reshape(2, 3).astype(">f4", order="F"), "whole": np.arange(3, dtype="<i2")}
    arrays["again"] = arrays["swapped"]  # by reference in the pickle
    for key, read in read_dict(saved(tmp_path, arrays)).items():
        np.testing.assert_array_equal(read, arrays[key])
    for protocol in (3, 4):  # those of numpy.save in Python 3
        path, stream = tmp_path / "plain.npy", io.BytesIO()
        np.save(stream, np.array(None, dtype=object), allow_pickle=True)
        pickled = pickle.dumps(np.array(values, dtype=object), protocol=protocol)
        path.write_bytes(stream.getvalue()[:128] + pickletools.optimize(pickled))
        assert read_dict(path) == values


# Images beside it ------------------------------------------------------------------------------------------------


def as_course(images: Path) -> dict[str, Any]:
    """Return a folder of KITTI's odometry as the course pickles a recording and its images."""
    sides = [sorted((images / f"image_{side}").iterdir()) for side in (0, 1)]
    left, right = ([cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) for path in paths] for paths in sides)
    K, T_left_right = np.array([[250.0, 0.0, 160.0], [0.0, 250.0, 100.0], [0.0, 0.0, 1.0]]), np.eye(4)
    T_left_right[0, 3] = 0.4
    extrinsics = {"extL_T_imu": T_REGULAR_OPTICAL, "extR_T_imu": T_REGULAR_OPTICAL @ T_left_right}
    motion = {"v_t": np.tile([1.5, 0.0, 0.0], (len(left), 1)), "w_t": np.zeros((len(left), 3))}
    calibration = {"timestamps": 1.7e9 + np.arange(len(left)) / 30.0, "K_l": K, "K_r": K}
    return {**motion, **calibration, **extrinsics, "cam_imgs_L": left, "cam_imgs_R": right}


def save_npy(path: Path, content: dict[str, Any]) -> Path:
    """Write a recording, and its images beside it."""
    images = {key: value for key, value in content.items() if key.startswith("cam")}
    np.save(path.with_stem(f"{path.stem}_imgs"), images, allow_pickle=True)
    np.save(path, {key: value for key, value in content.items() if key not in images}, allow_pickle=True)
    return path


@pytest.fixture
def with_images(kitti_drive: Path, tmp_path: Path) -> Path:
    """Return a recording without features, and the images of a drive towards a wall beside it."""
    return save_npy(tmp_path / "dataset02.npy", as_course(kitti_drive))


def test_tracks_are_those_of_the_images_as_files(with_images: Path, kitti_drive: Path) -> None:
    sequence, expected = load_sequence(str(with_images)), load_sequence(str(kitti_drive)).observations
    np.testing.assert_array_equal(sequence.observations.uv_px, expected.uv_px)
    np.testing.assert_array_equal(sequence.observations.track_id, expected.track_id)
    assert sequence.provenance.facts[0].startswith("stereo tracks made of 8 image pairs")


def test_unpacked_images_go_when_they_are_no_longer_used(with_images: Path) -> None:
    recording = load_images(str(with_images))
    image = recording.pairs[0].left
    assert image.is_file()
    del recording
    assert not image.parent.parent.exists()


def test_features_are_taken_before_images_unless_requested(with_images: Path) -> None:
    content = read_dict(with_images)
    with_images = saved(with_images.parent, {**content, "features": np.full((4, 2, 8), -1.0)}, with_images.name)
    assert len(load_sequence(str(with_images)).observations) == 0
    assert len(load_sequence(str(with_images), 0, Frontend(tracks="images")).observations) > 0
