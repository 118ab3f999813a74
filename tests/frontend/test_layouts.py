"""Folders laid out as people download, extract and convert them: recognised, or told in a line what to name."""

import re
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import pytest

from toolkit.datasets import load_images, load_sequence
from toolkit.errors import DataError
from toolkit.frontend.tracking import ImageRecording

FRAMES = 10
CAMERAS = ("cam0", "cam1")


def recording(root: Path) -> ImageRecording:
    found = load_images(str(root))
    assert all(pair.left.is_file() and pair.right.is_file() for pair in found.pairs)
    return found


def stamps(root: Path) -> list[int]:
    return [pair.t_ns for pair in recording(root).pairs]


@pytest.mark.parametrize("folder", ["images", "."])
def test_images_need_not_be_in_a_folder_called_data(asl: Path, folder: str) -> None:
    """TUM-VI's dso has them in ``images``, extractors of bags in the camera's own folder."""
    expected = stamps(asl)
    for camera in CAMERAS:
        data = asl / "mav0" / camera / "data"
        (asl / "mav0" / camera / folder).mkdir(exist_ok=True)
        for image in list(data.iterdir()):
            shutil.move(image, asl / "mav0" / camera / folder / image.name)
        data.rmdir()
    assert stamps(asl) == expected


@pytest.mark.parametrize("suffix", [".jpg", ".pgm", ".tiff"])
def test_images_that_were_converted_are_found_though_their_tables_name_png(asl: Path, suffix: str) -> None:
    expected = stamps(asl)
    for camera in CAMERAS:
        for image in list((asl / "mav0" / camera / "data").iterdir()):
            cv2.imwrite(str(image.with_suffix(suffix)), cv2.imread(str(image), cv2.IMREAD_GRAYSCALE))
            image.unlink()
    assert stamps(asl) == expected


def test_names_may_be_stamps_in_seconds_to_the_nanosecond(asl: Path) -> None:
    expected = stamps(asl)
    for camera in CAMERAS:
        (asl / "mav0" / camera / "data.csv").unlink()
        for image in list((asl / "mav0" / camera / "data").iterdir()):
            image.rename(image.with_name(f"{image.stem[:-9]}.{image.stem[-9:]}.png"))
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


@pytest.mark.parametrize(
    ("remove", "words"),
    [
        (lambda root: shutil.rmtree(root / "mav0/cam1"), "there is cam0 and no cam1; stereo needs both"),
        (
            lambda root: (root / "mav0/imu0/data.csv").unlink(),
            "no imu0.csv of Kalibr's: name the folder that has mav0, or rectify",
        ),
    ],
)
def test_what_lacks_of_a_recording_is_reported_with_what_to_do(
    asl: Path, remove: Callable[[Path], object], words: str
) -> None:
    remove(asl)
    with pytest.raises(DataError, match=words):
        load_sequence(str(asl))


@pytest.mark.parametrize("part", ["mav0/cam0/data", "mav0/cam0", "mav0/imu0/data.csv"])
def test_of_a_part_of_a_recording_the_whole_is_named(asl: Path, part: str) -> None:
    with pytest.raises(
        DataError, match=f"a part of a recording: name the whole recording, {re.escape(str(asl / 'mav0'))};"
    ):
        load_sequence(str(asl / part))


def test_recordings_are_named_some_levels_below(asl: Path, tmp_path: Path) -> None:
    above = tmp_path / "downloads"
    (above / "dataset/sequences").mkdir(parents=True)
    shutil.move(asl, above / "dataset/sequences/00")
    with pytest.raises(DataError, match=r"is not a recording, but contains some: name dataset/sequences/00 in it"):
        load_sequence(str(above))
