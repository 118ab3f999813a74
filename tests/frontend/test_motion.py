"""Tracks held against where they were some pairs ago: a slow slide is seen, noise and what is new are let be."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import pytest

from toolkit.frontend import RectifiedPair, already_rectified
from toolkit.frontend.motion import Rigidity
from toolkit.geometry import Array, BoolArray, se3, so3_exp

PAIRS, TRACKS, NOISE_PX = 12, 80, 0.1
SLIDING = 7


class Shown(NamedTuple):
    """Where tracks are in both images, (N, 2) px each."""

    left_px: Array
    right_px: Array


@pytest.fixture(scope="module")
def rig() -> RectifiedPair:
    return already_rectified((450.0, 450.0, 370.0, 240.0), 0.11, (752, 480))


def flown(rig: RectifiedPair, noise_px: float, slide_px: float, speed_m: float = 0.05) -> Iterator[Shown]:
    """Yield the tracks of points 2 to 5 m away under a motion forward, to the side and around; one track slides."""
    rng = np.random.default_rng(8)
    depth = rng.uniform(2.0, 5.0, TRACKS)
    points = np.stack([rng.uniform(-0.6, 0.6, TRACKS), rng.uniform(-0.4, 0.4, TRACKS), np.ones(TRACKS)], 1)
    points *= depth[:, None]
    for k in range(PAIRS):
        T_cam_world = se3(so3_exp(np.array([0.002, 0.01, -0.004]) * k), -speed_m * k * np.array([0.7, 0.1, 0.7]))
        seen = points @ T_cam_world[:3, :3].T + T_cam_world[:3, 3]
        left = rig.fx_px * seen[:, :2] / seen[:, 2:] + np.array([rig.cx_px, rig.cy_px])
        right = left - np.array([1.0, 0.0]) * (rig.fx_px * rig.baseline_m / seen[:, 2:])
        left[SLIDING] += slide_px * k
        right[SLIDING] += slide_px * k
        yield Shown(*(side + rng.normal(0.0, noise_px, side.shape) for side in (left, right)))


def verdicts(rig: RectifiedPair, tracks: Iterator[Shown]) -> list[BoolArray]:
    """Return for each pair which tracks are said to be at their points."""
    rigidity, found = Rigidity(rig.stereo_rig, 2.0), []
    for shown in tracks:
        found.append(rigidity.agrees(*shown, np.arange(TRACKS)))
        rigidity = rigidity.after(*shown, np.arange(TRACKS))
    return found


def test_a_track_that_slides_by_a_third_of_a_pixel_a_pair_is_found_and_no_other(rig: RectifiedPair) -> None:
    found = verdicts(rig, flown(rig, NOISE_PX, 0.35))
    assert all(sound.all() for sound in found[:5])  # nothing is far enough back yet
    assert not found[-1][SLIDING]
    assert all(np.delete(sound, SLIDING).all() for sound in found)


# The last: a hundred medians at a standstill, but within the noise that tracks are said to have.
@pytest.mark.parametrize(
    ("noise_px", "slide_px", "speed_m"), [(0.02, 0.0, 0.05), (0.1, 0.0, 0.05), (0.4, 0.0, 0.05), (0.002, 0.025, 0.0)]
)
def test_noise_of_any_size_ends_no_track(rig: RectifiedPair, noise_px: float, slide_px: float, speed_m: float) -> None:
    assert all(sound.all() for sound in verdicts(rig, flown(rig, noise_px, slide_px, speed_m)))


def test_a_far_point_may_be_off_by_what_its_disparity_leaves_open(rig: RectifiedPair) -> None:
    """An error of the disparity then moves a point along its ray: seen from the side that is many pixels, and no slide.

    Half a pixel of disparity at 5 m, of ten, is 0.25 m: half a metre to the side it is 2.5 px off in the image.
    """
    tracks = [Shown(*(side.copy() for side in shown)) for shown in flown(rig, NOISE_PX, 0.0, speed_m=0.1)]
    off = tracks[0].right_px.copy()
    off[SLIDING, 0] += 0.5
    tracks[0] = Shown(tracks[0].left_px, off)
    # The pair compared with the first one that has it: the others would be compared with sound pairs.
    rigidity = Rigidity(rig.stereo_rig, 2.0).after(*tracks[0], np.arange(TRACKS))
    for shown in tracks[1:5]:
        rigidity = rigidity.after(*shown, np.arange(TRACKS))
    assert rigidity.agrees(*tracks[5], np.arange(TRACKS)).all()
    elsewhere = tracks[5].left_px.copy(), tracks[5].right_px.copy()
    for side in elsewhere:
        side[SLIDING, 1] += 2.5  # across the rays, which no disparity explains
    assert not rigidity.agrees(*elsewhere, np.arange(TRACKS))[SLIDING]


def test_new_tracks_and_too_few_are_not_checked(rig: RectifiedPair) -> None:
    rigidity = Rigidity(rig.stereo_rig, 2.0)
    *before, last = flown(rig, NOISE_PX, 0.35)
    for shown in before:
        rigidity = rigidity.after(*shown, np.arange(TRACKS))
    as_new = np.arange(TRACKS)
    as_new[SLIDING:] += TRACKS
    assert rigidity.agrees(*last, as_new).all()
    assert not rigidity.agrees(*last, np.arange(TRACKS))[SLIDING]
    assert rigidity.agrees(*(side[:19] for side in last), np.arange(19)).all()
