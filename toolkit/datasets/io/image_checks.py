"""What images must have before any is read: both cameras, stamps that differ, and the time of the motion samples."""

from pathlib import Path

from toolkit.datasets.io.fields import check_frame_count, probable_unit_of_ns
from toolkit.datasets.io.image_pairs import Listed, images_in
from toolkit.errors import DataError
from toolkit.geometry import IntArray


def check_both_cameras(root: Path, left: Path, right: Path) -> None:
    """Raise DataError where one of two folders of a recording, its cameras' images, has none."""
    there, lacking = (left, right) if images_in(left) else (right, left)
    if not images_in(lacking):
        names = [str(folder.relative_to(root)) for folder in (there, lacking)]
        raise DataError(
            f"{root}: {names[0]} has images and {names[1]} has none, and stereo needs both cameras; add those of "
            f"{names[1]}"
        )


def check_one_trigger(mav0: Path, listed: Listed) -> None:
    """Raise DataError where no image of cam0 has one of cam1 of the same instant."""
    if listed.apart_ms is not None:
        raise DataError(
            f"{mav0}: no image of cam0 has one of cam1 within 1 ms, the nearest is {listed.apart_ms:.4g} ms away "
            "(median): a stereo pair has one trigger; where only the cameras' clocks differ, mend the stamps of cam1"
        )


def check_several_stamps(path: Path, listed: Listed) -> None:
    """Raise DataError, naming the file of the stamps, where there are not two pairs of two instants."""
    if len(listed.pairs) == 1 < listed.stamps:
        raise DataError(f"{path}: all {listed.stamps} images have one and the same stamp; write the time of each")
    check_frame_count(path, len(listed.pairs))


def check_one_clock(root: Path, images_t_ns: IntArray, motion_t_ns: IntArray, motion: str) -> None:
    """Raise DataError where no image (N,) lies in the time of the motion samples (S,), which ``motion`` names."""
    first, last = int(motion_t_ns.min()), int(motion_t_ns.max())
    if first == last:
        raise DataError(f"{root}: {motion} are all of one instant, {first} ns; copy the whole recording again")
    if not ((images_t_ns >= first) & (images_t_ns <= last)).any():
        unit = probable_unit_of_ns(images_t_ns)
        why = "they are of two clocks or two recordings" if unit is None else f"the images' look like {unit}"
        raise DataError(
            f"{root}: none of the {images_t_ns.size} image pairs, {images_t_ns.min()} to {images_t_ns.max()} ns, lies "
            f"in the time of {motion}, {first} to {last} ns; {why}"
        )
