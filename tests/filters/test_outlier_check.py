"""What a smoother leaves out before it solves: sightings of another point, and nothing else."""

from dataclasses import replace

import numpy as np
import pytest

from filters.smoothing.outlier_check import KnownLandmarks, OutlierCheck, relative_to_its_map
from toolkit.geometry import se3, se3_inverse
from toolkit.measurements import Packet, StereoFrame
from toolkit.models import stereo
from toolkit.models.motion import motion_model, predicted
from toolkit.models.state import Belief
from toolkit.sequence import Sequence
from toolkit.settings import POLICIES
from toolkit.simulation import DRIVE, FLIGHT, Scenario, noise_free, simulate

POLICY = POLICIES["robust"]
CLEAN = replace(DRIVE, duration_s=20.0)
MISMATCHED = replace(CLEAN, camera=replace(CLEAN.camera, outlier_rate=0.05, outlier_px=(20.0, 30.0)))


def expected_states(sequence: Sequence) -> list[tuple[Packet, Belief]]:
    """Return each packet but the first with the state its motion predicts from the truth one frame earlier."""
    model = motion_model(sequence.noise, sequence.gravity_world)
    prior, truth, result = model.initial_belief(sequence.prior), sequence.truth, []
    for packet in list(sequence.packets())[1:]:
        k = packet.index - 1
        v_world = np.zeros(3) if truth.v_world is None else truth.v_world[k]
        before = replace(prior, T_world_imu=truth.T_world_imu[k], v_world=v_world, bias=truth.bias[k])
        before = relative_to_its_map(before)
        result.append((packet, predicted(before, model, packet.motion)))
    return result


def landmarks_of(scenario: Scenario, seed: int) -> dict[int, np.ndarray]:
    """Return the landmark (3,) of every track: where its first sighting puts it when nothing has noise."""
    sequence, points = simulate(noise_free(scenario), seed), {}
    for packet in sequence.packets():
        frame, pose = packet.frame, sequence.truth.T_world_imu[packet.index]
        for i, point in zip(frame.track_ids, stereo.triangulate_world(frame.uvs_px, pose, sequence.rig), strict=True):
            points.setdefault(int(i), point)
    return points


def known(frame: StereoFrame, points: dict[int, np.ndarray], at: Belief, sequence: Sequence) -> KnownLandmarks:
    """Return landmarks as well known as one sighting in a frame, from a state, would tell."""
    landmarks, seen = KnownLandmarks(sequence.rig), frame.select(np.isin(frame.track_ids, list(points)))
    landmarks.see(seen, points, at.T_world_imu)
    return landmarks


def test_errors_of_twenty_pixels_are_distinguished_from_sound_sightings():
    """Which sightings are wrong is known because their stream of randomness moves no other."""
    sequence = simulate(MISMATCHED, 3)
    struck = (sequence.visible.uv_px != simulate(CLEAN, 3).visible.uv_px).any(axis=1)
    wrong = set(zip(sequence.visible.frame[struck].tolist(), sequence.visible.track_id[struck].tolist(), strict=True))
    points, before = landmarks_of(CLEAN, 3), set[int]()
    caught = missed = accused = sound = 0
    for packet, expected in expected_states(sequence):
        ids = packet.frame.track_ids.tolist()
        landmarks = known(packet.frame, {i: points[i] for i in before & set(ids)}, expected, sequence)
        found = OutlierCheck(sequence.rig, POLICY).outliers(packet.frame, landmarks, expected)
        for i, is_outlier in zip(ids, found.tolist(), strict=True):
            if i in before and (packet.index, i) in wrong:
                caught, missed = caught + is_outlier, missed + (not is_outlier)
            elif i in before:
                accused, sound = accused + is_outlier, sound + (not is_outlier)
        before = set(ids)
    assert caught + missed > 200
    # Twenty pixels are ten standard deviations and more.
    assert caught / (caught + missed) > 0.95
    assert accused / sound < 0.002


@pytest.mark.parametrize("scenario", [DRIVE, FLIGHT], ids=["drive", "flight"])
def test_a_wrong_state_blames_no_track(scenario):
    """A metre beside the truth every sighting disagrees: then the state is wrong."""
    scenario = replace(scenario, duration_s=5.0)
    sequence, points = simulate(scenario, 0), landmarks_of(scenario, 0)
    packet, expected = expected_states(sequence)[2]
    beside = replace(expected, T_world_imu=expected.T_world_imu @ se3(np.eye(3), np.array([0.0, 1.0, 1.0])))
    landmarks = known(packet.frame, points, expected, sequence)
    assert not OutlierCheck(sequence.rig, POLICY).outliers(packet.frame, landmarks, beside).any()


def test_where_the_world_is_does_not_matter():
    """However little is known of the pose in the world, an outlier against the map stays one."""
    sequence = simulate(MISMATCHED, 3)
    points = landmarks_of(CLEAN, 3)
    vague = replace(sequence.prior, cov=sequence.prior.cov + 1e6 * np.eye(15))
    found = []
    for start in (sequence, replace(sequence, prior=vague)):
        packet, expected = expected_states(start)[20]
        landmarks, expected = known(packet.frame, points, expected, sequence), relative_to_its_map(expected)
        found.append(OutlierCheck(sequence.rig, POLICY).outliers(packet.frame, landmarks, expected))
    np.testing.assert_array_equal(found[0], found[1])


def test_a_sighting_of_an_unknown_landmark_is_no_outlier():
    sequence = simulate(MISMATCHED, 3)
    packet, expected = expected_states(sequence)[0]
    check, none = OutlierCheck(sequence.rig, POLICY), KnownLandmarks(sequence.rig)
    assert not check.outliers(packet.frame, none, expected).any()
    moved = replace(expected, T_world_imu=se3_inverse(expected.T_world_imu))
    assert not check.outliers(packet.frame, none, moved).any()


def test_landmarks_that_began_with_an_outlier_do_not_put_the_state_in_doubt():
    """A third of the landmarks is wrong, and a third of what is seen of the others: far are more than half."""
    sequence, rng = simulate(CLEAN, 3), np.random.default_rng(0)
    packet, expected = expected_states(sequence)[20]
    points, frame = landmarks_of(CLEAN, 3), packet.frame
    before, pose = expected_states(sequence)[19][0].frame, sequence.truth.T_world_imu[packet.index]
    both = np.intersect1d(before.track_ids, frame.track_ids)
    seen = before.select(np.isin(before.track_ids, both))
    began_wrong, seen_wrong = rng.permutation(both)[: both.size // 3], rng.permutation(both)[: both.size // 3]
    moved = {i: points[i] + (2.0 if i in began_wrong else 0.0) for i in both.tolist()}
    landmarks = KnownLandmarks(sequence.rig)
    landmarks.see(seen, moved, sequence.truth.T_world_imu[packet.index - 1])
    struck = frame.select(np.isin(frame.track_ids, both))
    off = np.where(np.isin(struck.track_ids, seen_wrong)[:, None], 40.0, 0.0) * np.array([1.0, 1.0, -1.0])
    struck = replace(struck, uvs_px=struck.uvs_px + off)
    found = OutlierCheck(sequence.rig, POLICY).outliers(struck, landmarks, replace(expected, T_world_imu=pose))
    wrong = np.isin(struck.track_ids, np.union1d(began_wrong, seen_wrong))
    assert wrong.mean() > 0.5
    assert found[wrong].mean() > 0.9
    assert found[~wrong].mean() < 0.1
