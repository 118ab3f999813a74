"""The course's npz files: what is read, how much memory it takes, and what is said of malformed ones."""

import tracemalloc
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.datasets.test_course_npy import save_npy
from toolkit.datasets import course_npz, load_sequence
from toolkit.geometry import se3, se3_inverse
from toolkit.measurements import is_left_only

Course = dict[str, Any]


def written(folder: Path, arrays: Course) -> Path:
    path = folder / "small.npz"
    np.savez(path, **arrays)
    return path


def test_sightings_are_those_not_missing_in_all_four_coordinates(course: Course, tmp_path: Path) -> None:
    observations = course_npz.load(written(tmp_path, course)).observations
    np.testing.assert_array_equal(observations.frame, [0, 1, 1, 2, 2, 3, 4])
    np.testing.assert_array_equal(observations.track_id, [0, 0, 2, 0, 2, 2, 2])
    np.testing.assert_array_equal(observations.uv_px[:2], [[400.0, 380.0, 201.0]] * 2)


def test_features_of_zeros_are_unseen_and_counted(course: Course, tmp_path: Path) -> None:
    """As of np.zeros that were never filled, in tracks that are never used too."""
    unseen = (course["features"] == -1.0).all(axis=0)
    features = np.where(unseen, 0.0, course["features"])
    features = np.concatenate([features, np.zeros((4, 3, features.shape[2]))], axis=1)
    zeros = load_sequence(str(written(tmp_path, {**course, "features": features})))
    np.testing.assert_array_equal(
        zeros.observations.uv_px, load_sequence(str(written(tmp_path, course))).observations.uv_px
    )
    count = int(unseen.sum()) + 3 * features.shape[2]
    assert zeros.provenance.facts == (f"{count} features are 0 in every coordinate: unseen, as those that are -1",)


def test_a_sighting_that_lacks_the_right_image_has_the_row_of_the_left_one(course: Course, tmp_path: Path) -> None:
    course["features"][2:, 0, 0] = -1.0
    course["features"][1, 0, 0] = 207.0
    uv_px = course_npz.load(written(tmp_path, course)).observations.uv_px
    np.testing.assert_array_equal(uv_px[0], [400.0, np.nan, 207.0])
    np.testing.assert_array_equal(is_left_only(uv_px[:-1]), [True] + [False] * 5)


def test_nan_of_the_file_is_kept_for_the_audit(course: Course, tmp_path: Path) -> None:
    course["features"][0, 0, 0] = course["linear_velocity"][1, 2] = np.nan
    sequence = course_npz.load(written(tmp_path, course))
    assert np.isnan(sequence.observations.uv_px[0, 0])
    assert np.isnan(sequence.motion.values[2, 1])


@pytest.mark.parametrize("order", ["C", "F"])
@pytest.mark.parametrize(
    ("dtype", "missing"), [("<f8", -1), (">f8", -1), ("<f4", -1), ("<i4", -1), ("<f8", np.nan)], ids=str
)
def test_memory_order_number_type_and_nan_where_nothing_is_minus_one_do_not_matter(
    course: Course, tmp_path: Path, order: Any, dtype: str, missing: float
) -> None:
    expected = course_npz.load(written(tmp_path, course)).observations
    features = np.where(course["features"] == -1.0, missing, course["features"])
    course["features"] = np.asarray(features, dtype=dtype, order=order)
    read = course_npz.load(written(tmp_path, course)).observations
    np.testing.assert_array_equal(read.uv_px, expected.uv_px)
    np.testing.assert_array_equal(read.frame, expected.frame)
    np.testing.assert_array_equal(read.track_id, expected.track_id)


@pytest.mark.parametrize("version", [(1, 0), (2, 0), (3, 0)])
def test_every_version_of_the_header_is_read(course: Course, tmp_path: Path, version: tuple[int, int]) -> None:
    path = tmp_path / "version.npz"
    with zipfile.ZipFile(path, "w") as archive:
        for key, array in course.items():
            with archive.open(f"{key}.npy", "w") as stream:
                np.lib.format.write_array(stream, array, version=version)
    assert len(course_npz.load(path).observations) == 7


def test_both_generations_of_keys_mean_the_same(course: Course, tmp_path: Path) -> None:
    older = course_npz.load(written(tmp_path, course))
    course["cam_T_imu"] = se3_inverse(course.pop("imu_T_cam"))
    course["rotational_velocity"] = course.pop("angular_velocity")
    both = course | {"imu_T_cam": older.rig.T_imu_cam}
    for newer in (course_npz.load(written(tmp_path, arrays)) for arrays in (course, both)):
        np.testing.assert_allclose(newer.rig.T_imu_cam, older.rig.T_imu_cam, atol=1e-15)
        np.testing.assert_array_equal(newer.motion.values, older.motion.values)


def compressed(path: Path, arrays: Course) -> None:
    with path.open("wb") as file:
        np.savez_compressed(file, **arrays)


def pickled(path: Path, arrays: Course) -> None:
    """Write them as the course has since 2025."""
    K, T = arrays["K"], arrays["imu_T_cam"]
    now = {"timestamps": arrays["time_stamps"], "features": arrays["features"], **{"K_l": K, "K_r": K}}
    now |= {"v_t": arrays["linear_velocity"].T, "w_t": arrays["angular_velocity"].T, "extL_T_imu": T}
    save_npy(path, now | {"extR_T_imu": T @ se3(np.eye(3), np.array([0.5, 0.0, 0.0]))})


@pytest.mark.parametrize("write", [compressed, pickled])
def test_a_large_recording_takes_hardly_any_memory(course: Course, tmp_path: Path, write: Callable[..., None]) -> None:
    frames = 600
    features = np.full((4, 2500, frames), -1.0)  # 48 MB
    features[:, ::10, ::20] = 100.0
    course |= {"features": features, "time_stamps": 0.1 * np.arange(frames)[None]}
    course |= {key: np.zeros((3, frames)) for key in ("linear_velocity", "angular_velocity")}
    write(tmp_path / "large.npy", course)
    course.clear()
    del features
    tracemalloc.start()
    observations = load_sequence(str(tmp_path / "large.npy")).observations
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert len(observations) == 250 * 30
    # The sightings take some.
    assert peak < 8e6


def test_features_without_a_sighting_are_not_taken_for_a_file_that_has_none(course: Course, tmp_path: Path) -> None:
    blind = course_npz.load(written(tmp_path, course | {"features": np.full((4, 3, 5), -1.0)}))
    assert not blind.provenance.facts
    del course["features"]
    assert course_npz.load(written(tmp_path, course)).provenance.facts
