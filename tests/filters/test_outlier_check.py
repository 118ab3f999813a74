"""What a smoother leaves out before it solves: sightings of another point, and nothing else."""

from dataclasses import replace

import msgspec
import numpy as np
import pytest

from filters.fixed_lag import FixedLag
from filters.isam2 import Isam2
from filters.smoothing.outlier_check import FEWEST_REFUSED, KnownLandmarks, KnownSightings, OutlierCheck, RefusedTracks
from tests.filters.conftest import setup_of, short
from toolkit.geometry import se3, se3_exp, transform
from toolkit.measurements import StereoFrame
from toolkit.models import stereo
from toolkit.models.motion import motion_model
from toolkit.models.state import Belief
from toolkit.sequence import Sequence
from toolkit.settings import POLICIES, Settings
from toolkit.simulation import DRIVE, FLIGHT, simulate

RIG, COUNT = DRIVE.rig, 4000
IDS = np.arange(COUNT)
AHEAD = np.array([1.0, 0.0, 0.0])
ROOT = np.linalg.cholesky(RIG.cov_uv_px2)


def outliers(frame, landmarks, expected, policy=POLICIES["robust"]):
    return OutlierCheck(RIG, policy).outliers(KnownSightings.of(frame, landmarks), expected)


def landmarks_ahead() -> np.ndarray:
    """Return points (N, 3) at 20 to 30 m in front of the camera at the origin, so near that their errors are small."""
    rng = np.random.default_rng(0)
    places = np.column_stack([rng.uniform(-5.0, 5.0, (COUNT, 2)), rng.uniform(20.0, 30.0, COUNT)])
    return transform(RIG.T_imu_cam, places)


def pose_after(way_m: float) -> np.ndarray:
    return se3(np.eye(3), way_m * AHEAD)


def frame_from(T_world_imu: np.ndarray, points: np.ndarray, seed: int) -> StereoFrame:
    """Return what a camera sees of points, with the noise that is stated."""
    noise = np.random.default_rng(seed).standard_normal((COUNT, 3)) @ ROOT.T
    return StereoFrame(0, IDS, stereo.predict(points, T_world_imu, RIG).uv_px + noise)


def estimated(frames: list[tuple[StereoFrame, np.ndarray]], true: np.ndarray) -> np.ndarray:
    """Return the least-squares points (N, 3) of sightings from known poses, one Gauss-Newton step from the truth."""
    information, vector = np.zeros((COUNT, 3, 3)), np.zeros((COUNT, 3, 1))
    whitener = np.linalg.inv(ROOT)
    for frame, pose in frames:
        at = stereo.predict(true, pose, RIG)
        H = whitener @ at.d_uv_d_point
        information += np.swapaxes(H, 1, 2) @ H
        vector += np.swapaxes(H, 1, 2) @ (whitener @ (frame.uvs_px - at.uv_px)[..., None])
    return true + np.linalg.solve(information, vector)[..., 0]


@pytest.mark.parametrize("seen_from_m", [(0.0,), (0.0, 1.0), tuple(np.arange(0.0, 8.0))])
@pytest.mark.parametrize("way_m", [0.5, 12.0])
def test_the_gate_refuses_of_sound_sightings_what_it_says_however_often_a_landmark_was_seen(seen_from_m, way_m):
    """One in a hundred: of 4000 that is 40, with a standard deviation of 6."""
    true, landmarks = landmarks_ahead(), KnownLandmarks(RIG)
    frames = [(frame_from(pose_after(m), true, seed), pose_after(m)) for seed, m in enumerate(seen_from_m)]
    points = dict(zip(IDS.tolist(), estimated(frames, true), strict=True))
    for frame, pose in frames:
        landmarks.see(frame, points, pose)
    policy = msgspec.structs.replace(POLICIES["robust"], gate_probability=0.99)
    pose = pose_after(seen_from_m[-1] + way_m)
    refused = OutlierCheck(RIG, policy).outliers(
        KnownSightings.of(frame_from(pose, true, 99), landmarks), state_at(pose)
    )
    assert 20 <= refused.sum() <= 62


def state_at(T_world_imu: np.ndarray, sigma: float = 0.0) -> Belief:
    """Return a state whose pose is uncertain by so much (rad, m)."""
    sequence = simulate(replace(DRIVE, duration_s=1.0), 0)
    belief = motion_model(sequence.noise, sequence.gravity_world).initial_belief(sequence.prior)
    return replace(belief, T_world_imu=T_world_imu, cov=sigma**2 * np.eye(9))


def test_a_landmark_that_was_dropped_starts_anew():
    landmarks, point = KnownLandmarks(RIG), landmarks_ahead()[:1]
    frame = StereoFrame(0, IDS[:1], stereo.predict(point, np.eye(4), RIG).uv_px)
    told = []
    for _ in range(3):
        landmarks.see(frame, {0: point[0]}, np.eye(4))
        told.append(landmarks.of([0])[1][0])
    landmarks.keep({})
    assert 0 not in landmarks
    landmarks.move({0: point[0]})
    assert 0 not in landmarks, "only what is seen is known"
    landmarks.see(frame, {0: point[0]}, np.eye(4))
    np.testing.assert_allclose(landmarks.of([0])[1][0], told[0], rtol=1e-9)
    assert np.linalg.det(told[2]) < 0.1 * np.linalg.det(told[0])


FORTY = np.arange(40)
# What the motion is off by moves the images by eight pixels: states are uncertain by as much.
OFF = se3_exp(np.array([0.008, -0.01, 0.01, 0.05, 0.05, -0.05]))


def frame_and_points(off_px: np.ndarray) -> tuple[StereoFrame, dict[int, np.ndarray]]:
    """Return a frame from the origin with noise of half a pixel and the first tracks off (n, 3), and all landmarks."""
    rng = np.random.default_rng(1)
    places = np.column_stack([rng.uniform(-4.0, 4.0, (40, 2)), rng.uniform(8.0, 25.0, 40)])
    points = transform(RIG.T_imu_cam, places)
    uvs_px = stereo.predict(points, np.eye(4), RIG).uv_px + 0.5 * rng.standard_normal((40, 3))
    uvs_px[: len(off_px)] += off_px
    return StereoFrame(0, FORTY, uvs_px), dict(zip(FORTY.tolist(), points, strict=True))


def known_from_origin(points: dict[int, np.ndarray]) -> KnownLandmarks:
    """Return landmarks as well known_from_origin as one sighting from the origin tells."""
    landmarks, ids = KnownLandmarks(RIG), np.array(list(points), dtype=np.int64)
    uvs_px = stereo.predict(np.array(list(points.values())).reshape(-1, 3), np.eye(4), RIG).uv_px
    landmarks.see(StereoFrame(0, ids, uvs_px), points, np.eye(4))
    return landmarks


def placed(before: Belief, frame: StereoFrame, landmarks: KnownLandmarks) -> Belief:
    """Return where the frame puts the state."""
    return OutlierCheck(RIG, POLICIES["robust"]).placed(before, frame, landmarks)[0]


def moved_px(T_world_imu: np.ndarray, points: dict[int, np.ndarray]) -> float:
    """Return how far the images from a pose are from those from the origin, the root of the mean square."""
    places = np.array(list(points.values()))
    moved = stereo.predict(places, T_world_imu, RIG).uv_px - stereo.predict(places, np.eye(4), RIG).uv_px
    return float(np.sqrt(np.square(moved).mean()))


def test_a_state_begins_where_its_sightings_put_it_though_the_motion_is_off_and_some_are_mismatched():
    """Noise of half a pixel on 40 points: a tenth of a pixel of the pose, where the motion is off by eight."""
    frame, points = frame_and_points(np.random.default_rng(2).uniform(20.0, 60.0, (10, 3)))
    assert moved_px(placed(state_at(OFF, 0.02), frame, known_from_origin(points)).T_world_imu, points) < 0.3
    alone = state_at(OFF, 0.02)
    assert placed(alone, frame, known_from_origin({})) is alone


def test_what_moves_by_itself_is_an_outlier_though_the_motion_might_explain_it():
    """Eight tracks are off by twelve pixels, as on a car: within the gate of a motion that is uncertain by as many."""
    frame, points = frame_and_points(np.tile([12.0, 12.0, 0.0], (8, 1)))
    check = OutlierCheck(RIG, POLICIES["robust"])
    assert not outliers(frame, known_from_origin(points), state_at(OFF, 0.02)).any()
    there, sound = check.placed(state_at(OFF, 0.02), frame, known_from_origin(points))
    assert moved_px(there.T_world_imu, points) < 0.5
    np.testing.assert_array_equal(sound.track_ids, FORTY[8:])


def test_what_the_motion_leaves_open_is_no_outlier_where_no_other_track_denies_it():
    """One track, off by as many pixels as the motion may be: it may be the motion."""
    frame, points = frame_and_points(np.array([[12.0, 12.0, 0.0]]))
    alone = known_from_origin({0: points[0]})
    _, sound = OutlierCheck(RIG, POLICIES["robust"]).placed(state_at(OFF, 0.02), frame, alone)
    np.testing.assert_array_equal(sound.track_ids, FORTY)


def test_a_state_that_is_certain_stays_where_it_is():
    """Sightings have nothing to say where the motion leaves no doubt."""
    frame, points = frame_and_points(np.empty((0, 3)))
    np.testing.assert_array_equal(placed(state_at(OFF), frame, known_from_origin(points)).T_world_imu, OFF)


def test_landmarks_that_began_with_an_outlier_do_not_put_the_state_in_doubt():
    """A third of the landmarks is wrong, and a third of what is seen of the others: far are more than half."""
    frame, points = frame_and_points(np.tile([40.0, 40.0, -40.0], (13, 1)))
    began_wrong = {i: point + 2.0 if 10 <= i < 23 else point for i, point in points.items()}
    found = outliers(frame, known_from_origin(began_wrong), state_at(np.eye(4)))
    assert found[:23].mean() > 0.9
    assert found[23:].mean() < 0.1


@pytest.mark.parametrize(("share", "believed"), [(0.4, True), (0.6, False)])
def test_where_most_confirmed_tracks_disagree_the_state_is_wrong_and_none_is_an_outlier(share, believed):
    frame, points = frame_and_points(np.tile([15.0, 15.0, -15.0], (round(share * 40), 1)))
    landmarks = known_from_origin(points)
    landmarks.see(frame, points, np.eye(4))  # a second time
    assert outliers(frame, landmarks, state_at(np.eye(4))).any() == believed


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


def begun_far(sequence: Sequence) -> Sequence:
    """Return the recording with the first sighting of a track at a disparity of 1.5 px, where it has several."""
    seen, uv_px = sequence.observations, sequence.observations.uv_px.copy()
    first = np.flatnonzero(seen.track_id == TRACK)[0]
    assert uv_px[first, 0] - uv_px[first, 1] > 8.0
    uv_px[first, 1] = uv_px[first, 0] - 1.5
    return replace(sequence, observations=replace(seen, uv_px=uv_px))


def point_and_log(build, sequence, policy):
    """Return the track's landmark (3,) m and the log."""
    estimator = build(setup_of(sequence, Settings(outliers=POLICIES[policy])))
    for packet in sequence.packets():
        estimator.step(packet)
    finished = estimator.finish()
    return finished.landmarks.points_world[finished.landmarks.track_ids == TRACK][0], finished.log


@pytest.mark.parametrize("build", [lambda setup: FixedLag(setup, 0.6), Isam2], ids=["fixed-lag", "isam2"])
def test_a_landmark_that_begins_far_too_far_away_begins_anew(build):
    clean = short(DRIVE, 1.0, 25)
    right, _ = point_and_log(build, clean, "robust")
    point, log = point_and_log(build, begun_far(clean), "robust")
    assert [line.split(": ")[1] for line in log] == [
        f"landmark {TRACK} was inconsistent with its next sightings and was dropped"
    ]
    # A few of ten sightings fewer, of a pixel each, at thirty metres.
    assert np.linalg.norm(point - right) < 1.0


def test_where_nothing_is_an_outlier_it_begins_anew_before_it_is_linearised_behind_the_camera():
    """The step from a small disparity to the right one passes the camera; the next sighting is as good a start."""
    clean = short(FLIGHT, 1.0)
    point, log = point_and_log(lambda setup: FixedLag(setup, 0.6), begun_far(clean), "none")
    assert log == (f"frame 1: landmark {TRACK} fell behind the camera and was dropped",)
    seen = clean.observations
    later = replace(clean, observations=seen.select((seen.track_id != TRACK) | (seen.frame > 1)))
    # The poses of the first two frames still differ by what the dropped sightings did to them before.
    np.testing.assert_allclose(point, point_and_log(lambda setup: FixedLag(setup, 0.6), later, "none")[0], atol=1e-3)
