"""Image files: every kind of damage has its reason, deep and coloured ones become grey, reading ahead keeps order."""

import threading
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from toolkit.frontend.images import Unusable, bit_depth, read_ahead, read_image

GREY = np.random.default_rng(0).integers(0, 256, (24, 32)).astype(np.uint8)


@pytest.mark.parametrize(
    ("spoil", "complaint"),
    [
        (lambda p: p.unlink(), "missing"),
        (lambda p: p.write_bytes(b""), "empty"),
        (lambda p: p.write_bytes(p.read_bytes()[:300]), "damaged or truncated"),
        (lambda p: p.write_bytes(p.read_bytes()[:-2]), "damaged or truncated"),
        (lambda p: p.write_bytes(p.read_bytes()[:200] + b"\0\1" + p.read_bytes()[202:]), "damaged or truncated"),
        (lambda p: p.write_bytes(b"hello, this is no image"), "no image"),
        (lambda p: cv2.imwrite(str(p), GREY[:20]), "32x20 px, expected 32x24"),
        (".pgm", "damaged or truncated"),
        (".bmp", "damaged or truncated"),
        (".tiff", "damaged or truncated"),
    ],
)
def test_what_cannot_be_used_says_why_and_the_decoder_nothing(
    tmp_path: Path, spoil: Any, complaint: str, capfd: pytest.CaptureFixture[str]
) -> None:
    """A suffix stands for half of an image of that kind."""
    path = tmp_path / f"1{spoil if isinstance(spoil, str) else '.png'}"
    cv2.imwrite(str(path), GREY)
    np.testing.assert_array_equal(read_image(path, 8, (32, 24)), GREY)
    if isinstance(spoil, str):
        path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    else:
        spoil(path)
    read = read_image(path, 8, (32, 24))
    assert isinstance(read, Unusable)
    assert complaint in str(read)
    if complaint != "no image":
        assert capfd.readouterr().err == ""


@pytest.mark.parametrize(("shift", "bits"), [(2, 10), (4, 12), (8, 16)])
def test_deep_images_keep_the_eight_bits_their_values_fill(tmp_path: Path, shift: int, bits: int) -> None:
    path = tmp_path / "deep.png"
    cv2.imwrite(str(path), GREY.astype(np.uint16) << shift)
    assert bit_depth([path]) == bits
    np.testing.assert_array_equal(read_image(path, bits), GREY)


def test_reading_ahead_keeps_the_order_and_is_a_few_ahead_only() -> None:
    begun: list[int] = []

    def read(i: int) -> int:
        assert threading.current_thread() is not threading.main_thread()
        begun.append(i)
        return i * i

    ahead = read_ahead(range(50), read)
    assert next(ahead) == 0
    time.sleep(0.02)
    assert len(begun) <= 5
    assert list(ahead) == [i * i for i in range(1, 50)]
