"""A landmark that begins far too far away is given up once its track has shown often enough that it is elsewhere."""

from dataclasses import replace

import numpy as np
import pytest

from filters.fixed_lag import FixedLag
from filters.isam2 import Isam2
from filters.smoothing import outlier_check
from filters.smoothing.outlier_check import FEWEST_REFUSED, RefusedTracks
from toolkit.estimator import Setup
from toolkit.geometry import se3_exp, transform
from toolkit.measurements import StereoFrame
from toolkit.models import stereo
from toolkit.simulation import DRIVE, simulate

RIG = DRIVE.rig
POSES = [se3_exp(np.array([0.0, 0.01 * k, 0.0, 0.3 * k, 0.0, 0.0])) for k in range(12)]


def sightings(points, k):
    uvs_px = stereo.predict(transform(RIG.T_imu_cam, points), POSES[k], RIG).uv_px
    ids = np.arange(len(points))
    return StereoFrame(k, ids, uvs_px + 0.5 * np.random.default_rng(k).standard_normal(uvs_px.shape))


@pytest.mark.parametrize("taken", [1, 5])
def test_as_many_must_agree_as_were_taken_and_one_more(taken):
    """The first point stays where it is; the second is elsewhere in each frame, as mismatches are."""
    tracks, rng = RefusedTracks(RIG, 0.95), np.random.default_rng(0)
    for k in range(taken):
        frame = sightings(np.array([[0.0, 0.0, 9.0], [1.0, 0.0, 9.0]]), k)
        assert tracks.contradicted(frame, np.zeros(2, dtype=bool), POSES[k]) == set()
    found = []
    for k in range(taken, 12):
        points = np.array([[2.0, 1.0, 12.0], [*rng.uniform(-3.0, 3.0, 2), rng.uniform(6.0, 15.0)]])
        found.append(tracks.contradicted(sightings(points, k), np.ones(2, dtype=bool), POSES[k]))
    least = max(FEWEST_REFUSED, taken + 1)
    assert found == [set()] * (least - 1) + [{0}] * (len(found) - least + 1)


TRACK = 7


@pytest.fixture(scope="module")
def clean():
    return simulate(replace(DRIVE, duration_s=1.0, camera=replace(DRIVE.camera, max_tracks=25)), 0)


@pytest.fixture(scope="module")
def begun_far(clean):
    """Return the recording with the first sighting of a track at a disparity of 1.5 px, where it has some ten."""
    seen, uv_px = clean.observations, clean.observations.uv_px.copy()
    first = np.flatnonzero(seen.track_id == TRACK)[0]
    assert uv_px[first, 0] - uv_px[first, 1] > 8.0
    uv_px[first, 1] = uv_px[first, 0] - 1.5
    return replace(clean, observations=replace(seen, uv_px=uv_px))


def point_and_log(build, sequence):
    estimator = build(Setup(sequence.rig, sequence.noise, sequence.prior, sequence.gravity_world, sequence.motion_kind))
    for packet in sequence.packets():
        estimator.step(packet)
    finished = estimator.finish()
    return finished.landmarks.points_world[finished.landmarks.track_ids == TRACK], finished.log


@pytest.mark.parametrize("build", [lambda setup: FixedLag(setup, 0.6), Isam2], ids=["fixed-lag", "isam2"])
def test_a_landmark_that_begins_far_too_far_away_begins_anew(build, clean, begun_far):
    (right,), _ = point_and_log(build, clean)
    (point,), log = point_and_log(build, begun_far)
    assert [line.split(": ")[1] for line in log] == [
        f"landmark {TRACK} was inconsistent with its next sightings and was dropped"
    ]
    # A few of ten sightings fewer, of a pixel each, at thirty metres.
    assert np.linalg.norm(point - right) < 1.0


def test_but_for_that_it_would_refuse_all_that_its_track_shows(clean, begun_far, monkeypatch):
    monkeypatch.setattr(outlier_check, "FEWEST_REFUSED", 1000)
    (right,), _ = point_and_log(Isam2, clean)
    (point,), log = point_and_log(Isam2, begun_far)
    assert log == ()
    assert np.linalg.norm(point - right) > 10.0
