"""Where the sightings of a new frame put it, and what is an outlier there."""

from dataclasses import replace

import numpy as np

from filters.smoothing.outlier_check import KnownLandmarks, OutlierCheck
from toolkit.geometry import se3_exp, transform
from toolkit.measurements import StereoFrame
from toolkit.models import stereo
from toolkit.models.motion import motion_model
from toolkit.models.state import Belief
from toolkit.settings import POLICIES
from toolkit.simulation import DRIVE, simulate

RIG, IDS = DRIVE.rig, np.arange(40)
# What the motion is off by moves the images by eight pixels.
OFF = se3_exp(np.array([0.008, -0.01, 0.01, 0.05, 0.05, -0.05]))


def expected() -> Belief:
    """Return what the motion predicts, uncertain by what it is off by."""
    sequence = simulate(replace(DRIVE, duration_s=1.0), 0)
    belief = motion_model(sequence.noise, sequence.gravity_world).initial_belief(sequence.prior)
    return replace(belief, T_world_imu=OFF, cov=np.eye(9) * 0.02**2)


def frame_and_points(off_px: np.ndarray) -> tuple[StereoFrame, dict[int, np.ndarray]]:
    """Return a frame from the origin with noise of half a pixel and the first tracks off (n, 3), and all landmarks."""
    rng = np.random.default_rng(1)
    places = np.column_stack([rng.uniform(-4.0, 4.0, (40, 2)), rng.uniform(8.0, 25.0, 40)])
    points = transform(RIG.T_imu_cam, places)
    uvs_px = stereo.predict(points, np.eye(4), RIG).uv_px + 0.5 * rng.standard_normal((40, 3))
    uvs_px[: len(off_px)] += off_px
    return StereoFrame(0, IDS, uvs_px), dict(zip(IDS.tolist(), points, strict=True))


def known(points: dict[int, np.ndarray]) -> KnownLandmarks:
    """Return landmarks as well known as one sighting from the origin tells."""
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
    assert moved_px(placed(expected(), frame, known(points)).T_world_imu, points) < 0.3
    alone = expected()
    assert placed(alone, frame, known({})) is alone


def test_what_moves_by_itself_is_an_outlier_though_the_motion_might_explain_it():
    """Eight tracks are off by twelve pixels, as on a car: within the gate of a motion that is uncertain by as many."""
    frame, points = frame_and_points(np.tile([12.0, 12.0, 0.0], (8, 1)))
    check = OutlierCheck(RIG, POLICIES["robust"])
    assert not check.outliers(frame, known(points), expected()).any()
    there, sound = check.placed(expected(), frame, known(points))
    assert moved_px(there.T_world_imu, points) < 0.5
    np.testing.assert_array_equal(sound.track_ids, IDS[8:])


def test_what_the_motion_leaves_open_is_no_outlier_where_no_other_track_denies_it():
    """One track, off by as many pixels as the motion may be: it may be the motion."""
    frame, points = frame_and_points(np.array([[12.0, 12.0, 0.0]]))
    alone = known({0: points[0]})
    _, sound = OutlierCheck(RIG, POLICIES["robust"]).placed(expected(), frame, alone)
    np.testing.assert_array_equal(sound.track_ids, IDS)


def test_a_state_that_is_certain_stays_where_it_is():
    """Sightings have nothing to say where the motion leaves no doubt."""
    frame, points = frame_and_points(np.empty((0, 3)))
    certain = replace(expected(), cov=np.zeros((9, 9)))
    np.testing.assert_array_equal(placed(certain, frame, known(points)).T_world_imu, OFF)
