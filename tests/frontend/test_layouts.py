"""Folders laid out as people download, extract and convert them: recognised, or told in a line what to name."""

import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import pytest

from toolkit.datasets import load_images, load_sequence
from toolkit.errors import DataError
from toolkit.frontend.tracking import ImageRecording


def recording(root: Path) -> ImageRecording:
    found = load_images(str(root))
    assert all(pair.left.is_file() and pair.right.is_file() for pair in found.pairs)
    return found


def stamps(root: Path) -> list[int]:
    return [pair.t_ns for pair in recording(root).pairs]


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


def test_recordings_are_named_some_levels_below(asl: Path, tmp_path: Path) -> None:
    above = tmp_path / "downloads"
    (above / "dataset/sequences").mkdir(parents=True)
    shutil.move(asl, above / "dataset/sequences/00")
    with pytest.raises(DataError, match=r"is not a recording, but contains some: name dataset/sequences/00 in it"):
        load_sequence(str(above))
