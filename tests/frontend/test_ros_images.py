"""Images as ROS messages hold them: every encoding gives the grey values of the scene."""

from typing import NamedTuple

import numpy as np
import pytest

from toolkit.datasets.io.bag_reader import grey
from toolkit.errors import DataError


@pytest.mark.parametrize("big_endian", [0, 1])
def test_rows_longer_than_the_image_and_both_byte_orders_are_read(big_endian: int) -> None:
    values = np.arange(12, dtype=np.uint16).reshape(3, 4) * 1000
    rows = values.astype(">u2" if big_endian else "<u2").view(np.uint8).reshape(3, 8)
    padded = np.hstack([rows, np.full((3, 5), 7, np.uint8)]).ravel()
    message = Pixels(3, 4, "mono16", big_endian, 13, padded)
    np.testing.assert_array_equal(grey(message, "here"), values)


@pytest.mark.parametrize(
    ("encoding", "channels"),
    [("rgb8", 3), ("bgr8", 3), ("rgba8", 4), ("bgra8", 4), ("8UC3", 3), ("rgb16", 3), ("bgr16", 3)],
)
def test_a_grey_scene_is_grey_in_every_encoding_of_colour(encoding: str, channels: int) -> None:
    kind = np.uint16 if "16" in encoding else np.uint8
    scene = np.random.default_rng(0).integers(0, np.iinfo(kind).max + 1, (6, 8), dtype=kind)
    data = np.repeat(scene[..., None], channels, axis=2).view(np.uint8)
    found = grey(Pixels(6, 8, encoding, 0, data[0].size, data.ravel()), "here")
    assert found.dtype == kind
    np.testing.assert_allclose(found.astype(int), scene, atol=2)


@pytest.mark.parametrize(
    ("encoding", "place"), [("uyvy", 1), ("yuyv", 0), ("yuv422", 1), ("yuv422_yuy2", 0), ("nv12", None)]
)
def test_of_brightness_and_colour_apart_the_brightness_is_taken(encoding: str, place: int | None) -> None:
    scene = np.random.default_rng(0).integers(0, 256, (6, 8), dtype=np.uint8)
    if place is None:
        data, step = np.concatenate([scene.ravel(), np.full(24, 128, np.uint8)]), 8
    else:
        pixels = np.full((6, 8, 2), 128, np.uint8)
        pixels[..., place] = scene
        data, step = pixels.ravel(), 16
    np.testing.assert_array_equal(grey(Pixels(6, 8, encoding, 0, step, data), "here"), scene)


@pytest.mark.parametrize("pattern", ["rggb", "bggr", "gbrg", "grbg"])
def test_a_bayer_pattern_has_its_red_where_it_says(pattern: str) -> None:
    """Of a red scene the brightness is that of red, 0.3 of the sensor's, and of a blue one 0.11."""
    for colour, share in (("r", 0.299), ("b", 0.114)):
        tile = np.array([200 if letter == colour else 0 for letter in pattern], dtype=np.uint8).reshape(2, 2)
        raw_image = np.tile(tile, (6, 6))
        found = grey(Pixels(12, 12, f"bayer_{pattern}8", 0, 12, raw_image.ravel()), "here")
        assert found[4:8, 4:8].mean() == pytest.approx(200 * share, abs=2.0)


@pytest.mark.parametrize(
    ("encoding", "step", "pattern"), [("32FC1", 16, "encoded as 32FC1; there are mono8"), ("mono8", 3, "it is cut off")]
)
def test_an_image_that_cannot_be_used_is_named(encoding: str, step: int, pattern: str) -> None:
    with pytest.raises(DataError, match=rf"bag: /left: .*{pattern}"):
        grey(Pixels(4, 4, encoding, 0, step, np.zeros(16, np.uint8)), "bag: /left")


class Pixels(NamedTuple):
    """An image as rosbags gives it."""

    height: int
    width: int
    encoding: str
    is_bigendian: int
    step: int
    data: np.ndarray
