"""The bridge over gaps: where it stands, how sure it is, and that it has the derivatives of its residual."""

from itertools import pairwise

import gtsam
import numpy as np
import pytest

from toolkit.geometry import se3_exp
from toolkit.measured_motion import TwistChangeNoise, TwistMotion, TwistNoise
from toolkit.models.factors import X
from toolkit.models.gap_bridge import GapBridge, KeptTwist, TwistChange, bridged, bridges, gaps, kept_twist
from toolkit.sequence import StereoFrame

NOISE = TwistChangeNoise(np.array([1.0, 2.0, 3.0]), np.array([0.3, 0.5, 0.7]))
MEASURED = TwistNoise(np.full(3, 0.2), np.full(3, 0.02), np.full(3, 1e-5))
STEP = 1e-6


def frames_of(*track_ids):
    return [
        StereoFrame(k * 100_000_000, np.array(ids, dtype=np.int64), np.zeros((len(ids), 3)), np.zeros(len(ids), int))
        for k, ids in enumerate(track_ids)
    ]


def values_of(poses):
    values = gtsam.Values()
    for k, pose in enumerate(poses):
        values.insert(X(k), gtsam.Pose3(pose))
    return values


def test_a_gap_is_where_no_track_leads_on():
    frames = frames_of([1, 2], [2, 3], [4], [4, 5], [], [6])
    np.testing.assert_array_equal(gaps(frames), [2, 4, 5])


def test_a_bridge_stands_at_a_gap_and_its_neighbours_alone():
    frames = frames_of([1], [1], [1], [1], [2], [2], [2], [2])
    graph = bridged(bridges(frames, NOISE))
    assert [tuple(graph.at(i).keys()) for i in range(graph.size())] == [(X(2), X(3), X(4)), (X(3), X(4), X(5))]
    assert bridged(bridges(frames_of([1], [1], [1]), NOISE)).size() == 0
    # At the ends there is a neighbour on one side, or none.
    assert bridged(bridges(frames_of([1], [2]), NOISE)).size() == 0
    assert bridged(bridges(frames_of([1], [2], [2]), NOISE)).size() == 1


def test_a_body_that_keeps_its_twist_costs_nothing():
    twist = np.array([0.1, -0.2, 0.3, 8.0, 0.5, -0.2])
    poses = [np.eye(4)]
    for dt_s in (0.1, 0.25):
        poses.append(poses[-1] @ se3_exp(dt_s * twist))
    assert kept_twist(KeptTwist(0.1, 0.25, NOISE), 2).error(values_of(poses)) == pytest.approx(0.0, abs=1e-18)


def test_a_change_of_the_twist_is_whitened_by_the_noise_over_the_time_between():
    twists = np.array([[0.1, -0.2, 0.3, 8.0, 0.5, -0.2], [0.1, -0.2, 0.5, 8.0, 0.5, -0.2]])
    poses = [np.eye(4)]
    for dt_s, twist in zip((0.1, 0.2), twists, strict=True):
        poses.append(poses[-1] @ se3_exp(dt_s * twist))
    expected = 0.5 * (0.2 / 0.7) ** 2 / 0.15
    assert kept_twist(KeptTwist(0.1, 0.2, NOISE), 2).error(values_of(poses)) == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("seed", range(3))
def test_the_factor_has_the_derivatives_of_its_residual(seed):
    rng = np.random.default_rng(seed)
    steps = [se3_exp(rng.normal(0.0, 0.8, 6)), *(se3_exp(rng.normal(0.0, 0.3, 6)) for _ in range(2))]
    poses = [steps[0], steps[0] @ steps[1], steps[0] @ steps[1] @ steps[2]]
    factor = kept_twist(KeptTwist(0.1, 0.15, NOISE), 2)

    def whitened(at):
        return -factor.linearize(values_of(at)).jacobian()[1]

    derivatives, _ = factor.linearize(values_of(poses)).jacobian()
    for which in range(3):
        for i, direction in enumerate(STEP * np.eye(6)):
            ends = [
                [pose @ se3_exp(sign * direction) if k == which else pose for k, pose in enumerate(poses)]
                for sign in (1.0, -1.0)
            ]
            numeric = (whitened(ends[0]) - whitened(ends[1])) / (2.0 * STEP)
            # Whitened derivatives are up to 1e2: a central difference of 1e-6 is good to 1e-6 of that.
            np.testing.assert_allclose(derivatives[:, 6 * which + i], numeric, atol=1e-4, rtol=1e-6)


@pytest.mark.parametrize("size", [0.0, 1e-9, 1e-4, 1e-2, 0.3, 2.0])
def test_the_factor_says_what_the_filters_correct_by(size):
    """Its arithmetic is GTSAM's, theirs NumPy's; the numbers are of the order of 1 / 0.1 s."""
    rng = np.random.default_rng(4)
    first, *steps = (se3_exp(scale * rng.normal(size=6)) for scale in (1.0, size, size))
    poses = np.array([first, first @ steps[0], first @ steps[0] @ steps[1]])
    kept = KeptTwist(0.1, 0.15, NOISE)
    derivatives, right_side = kept_twist(kept, 2).linearize(values_of(poses)).jacobian()
    np.testing.assert_allclose(derivatives * kept.sigmas[:, None], kept.derivatives(poses), atol=1e-12)
    np.testing.assert_allclose(-right_side * kept.sigmas, kept.change(poses), atol=1e-12)


def test_intervals_are_as_long_as_their_stamps_say():
    frames = frames_of([1], [2], [2])
    twist = np.array([0.0, 0.0, 0.3, 8.0, 0.0, 0.0])
    poses = [np.eye(4), se3_exp(0.1 * twist), se3_exp(0.2 * twist)]
    assert all(later.t_ns - sooner.t_ns == 100_000_000 for sooner, later in pairwise(frames))
    assert bridged(bridges(frames, NOISE)).error(values_of(poses)) == pytest.approx(0.0, abs=1e-18)


def driven(bridge, ids_of_frames, sigma, error, seed=0):
    """Drive on with a twist that changes by white noise of this size and is measured with errors of another.

    Return what the bridge says at each frame.
    """
    rng, reported, pose, motion = np.random.default_rng(seed), [], np.eye(4), None
    twist = np.array([0.0, 0.0, 0.1, 8.0, 0.0, 0.0])
    for frame in frames_of(*ids_of_frames):
        reported.append(bridge.added(frame, motion))
        bridge.learn(pose)
        twist = twist + sigma * rng.normal(size=6)
        pose = pose @ se3_exp(0.1 * twist)
        measured = (twist + error * rng.normal(size=6))[None]
        motion = TwistMotion(np.array([0.1]), measured[:, 3:], measured[:, :3])
    return reported


SIGMA = np.array([0.03, 0.02, 0.01, 0.1, 0.2, 0.3])
LONG = [[1]] * 600 + [[2]] * 3


def test_a_bridge_is_as_sure_as_the_twist_was_seen_to_stay():
    reported = driven(GapBridge(1.0, MEASURED), LONG, SIGMA, 3.0 * SIGMA)
    assert [kept is not None for kept in reported] == [False] * 600 + [True, True, False]
    stated = np.sqrt(2.0 / 0.1) * np.array([0.02] * 3 + [0.2] * 3)
    expected = np.sqrt((598.0 * np.square(SIGMA) + 10.0 * np.square(stated)) / 608.0)
    # Of so many changes the standard deviation is known to three percent.
    np.testing.assert_allclose(reported[600].sigmas, expected, rtol=0.09)


def test_at_first_a_bridge_adds_no_more_than_the_twists_that_are_measured():
    """Two of them, of intervals of a tenth of a second, differ by their white noise."""
    change = TwistChange(MEASURED)
    assert change.noise is None
    change.learn(100_000_000 * np.arange(3), np.tile(np.eye(4), (3, 1, 1)), np.zeros((2, 6)))
    expected = np.sqrt(2.0 * 10.0 / 11.0) * np.array([0.02] * 3 + [0.2] * 3) / 0.1
    np.testing.assert_allclose(change.noise.turn_change_density, expected[:3])
    np.testing.assert_allclose(change.noise.velocity_change_density, expected[3:])


def test_twists_that_are_measured_as_they_are_need_no_bridge():
    assert driven(GapBridge(1.0, MEASURED), LONG, SIGMA, 0.0) == [None] * 603


def test_the_change_is_not_learnt_over_gaps_nor_from_one_pose_that_is_far_off():
    one, other = TwistChange(MEASURED), TwistChange(MEASURED)
    poses = [np.eye(4)]
    for _ in range(300):
        poses.append(poses[-1] @ se3_exp(0.1 * SIGMA))
    for k in range(298):
        for change, off in ((one, 0.0), (other, 50.0 if k == 200 else 0.0)):
            three = np.array(poses[k : k + 3])
            three[2, 0, 3] += off
            change.learn(100_000_000 * np.arange(k, k + 3), three, np.zeros((2, 6)))
    np.testing.assert_allclose(other.noise.velocity_change_density, one.noise.velocity_change_density, rtol=0.05)
    bridge = GapBridge(1.0, MEASURED)
    driven(bridge, [[k] for k in range(50)], SIGMA, 3.0 * SIGMA)
    assert bridge.noise is None
