"""iSAM2: the incremental answer is that of the whole problem, and the tree survives what would end GTSAM's."""

from collections.abc import Iterator
from dataclasses import replace
from itertools import groupby

import gtsam
import numpy as np
import pytest

from filters.isam2 import Isam2
from filters.smoothing import isam2_tree
from filters.smoothing.isam2_tree import FROZEN_AFTER_FRAMES, MOST_RECOVERIES, QR_FRAMES, CachedLinearisation, Isam2Tree
from tests.filters.conftest import off_at_the_end_m, setup_of, short
from toolkit.errors import EstimatorError
from toolkit.estimate import Estimate
from toolkit.geometry import se3_inverse, se3_log, transform
from toolkit.measurements import TwistNoise
from toolkit.models import stereo
from toolkit.models.factors import B, L, V, X, kind_of
from toolkit.models.motion import motion_model
from toolkit.sequence import Sequence
from toolkit.settings import POLICIES, Outliers, Settings
from toolkit.simulation import DRIVE, DRIVE_IMU, FLIGHT, simulate
from toolkit.simulation.faults import cut_tracks, moving_vehicles

MOTION = motion_model(FLIGHT.motion.noise, FLIGHT.gravity_world)
# What a pose is from itself, in its tangent space.
ROUNDING = 1e-12


def test_landmarks_that_make_the_system_indeterminate_are_dropped_and_named_and_the_tree_goes_on():
    """Two of the four that are seen from a pose that is held are behind it."""
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    MOTION.insert(values, Estimate(0, np.eye(4), v_world=np.zeros(3), bias=np.zeros(6)), 0)
    graph.addPriorPose3(X(0), gtsam.Pose3(), gtsam.noiseModel.Isotropic.Sigma(6, 0.1))
    graph.addPriorVector(V(0), np.zeros(3), gtsam.noiseModel.Isotropic.Sigma(3, 0.1))
    graph.addPriorConstantBias(B(0), gtsam.imuBias.ConstantBias(), gtsam.noiseModel.Isotropic.Sigma(6, 0.1))
    calibration = gtsam.Cal3_S2Stereo(400.0, 400.0, 0.0, 300.0, 200.0, 0.1)
    for i, depth_m in enumerate((4.0, 4.0, -4.0, -4.0)):
        values.insert(L(i), np.array([0.1 * i, 0.0, depth_m]))
        measured = gtsam.StereoPoint2(300.0 + 10.0 * i, 290.0 + 10.0 * i, 200.0)
        graph.add(gtsam.GenericStereoFactor3D(measured, gtsam.noiseModel.Unit.Create(3), X(0), L(i), calibration))
    tree = Isam2Tree(MOTION, baseline_m=0.1)
    log, dropped = tree.add(graph, values, [X(0), V(0), B(0)])
    assert len(log) == 2
    assert dropped == {2, 3}
    assert all("indeterminate and was dropped" in line for line in log)
    assert sorted(tree.landmarks()) == [L(0), L(1)]
    assert np.isfinite(tree.points([L(0), L(1)])).all()
    assert tree.drop([L(1)]) == ([], set())
    assert not tree.has(L(1))
    assert tree.landmarks() == [L(0)]


def pairs_on_nothing(count: int) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values, list[int]]:
    """Return pairs of states that nothing determines, of which one gets a prior in each recovery."""
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for k in range(2 * count):
        values.insert(X(k), gtsam.Pose3())
        if k % 2:
            graph.add(gtsam.BetweenFactorPose3(X(k - 1), X(k), gtsam.Pose3(), gtsam.noiseModel.Unit.Create(6)))
    return graph, values, [X(2 * count - 1)]


def test_a_state_that_nothing_determines_gets_a_weak_prior_and_is_named_and_too_many_end_with_an_error():
    tree = Isam2Tree(MOTION, baseline_m=0.1)
    log, _ = tree.add(*pairs_on_nothing(1))
    assert "solved by QR" in log[0]
    assert "has a weak prior at its value" in log[-1]
    assert tree.read([X(0), X(1)]).size() == 2
    with pytest.raises(EstimatorError, match="stays indeterminate"):
        Isam2Tree(MOTION, baseline_m=0.1).add(*pairs_on_nothing(MOST_RECOVERIES))


class Refusing:
    """A tree that takes in what is new and refuses to solve it, as GTSAM does where rounding spoils its factors."""

    def __init__(self, whole: gtsam.ISAM2, named: int) -> None:
        self._whole, self._named = whole, named

    def update(self, *added: object) -> None:
        self._whole.update(*added)
        raise RuntimeError(f"Indeterminate linear system detected while working near variable {self._named}")

    def __getattr__(self, name: str) -> object:
        return getattr(self._whole, name)


def test_after_a_refusal_for_rounding_it_solves_by_qr_and_returns_to_cholesky_with_vision():
    few_tracks = replace(FLIGHT, duration_s=1.5, camera=replace(FLIGHT.camera, max_tracks=50))
    sequence, by = simulate(few_tracks, 1), []
    estimator = Isam2(setup_of(sequence))
    for packet in sequence.packets():
        if packet.index == 3:
            estimator._tree.isam = Refusing(estimator._tree.isam, X(2))
        estimator.step(packet)
        by.append(estimator._tree._factorization)
    # A frame counts where it has new landmarks, and with this many tracks a few have none.
    assert [how for how, _ in groupby(by)] == ["CHOLESKY", "QR", "CHOLESKY"]
    assert by.index("QR") == 3
    assert by.count("QR") > QR_FRAMES
    assert estimator._log == ["frame 3: x2 was indeterminate to rounding: solved by QR for some frames"]


def test_a_tree_built_anew_has_all_landmarks_before_its_states_however_long_they_were_seen(monkeypatch):
    """Behind the states of a whole run they are one dense system: 24 GB for 1100 frames of a real drive."""
    monkeypatch.setattr(isam2_tree, "LONG_LIVED_SIGHTINGS", 0)
    placed = dict[str, gtsam.KeyGroupMap]()
    order = Isam2Tree._order

    def watched(tree: Isam2Tree, new: list[int], in_view: list[int]) -> gtsam.KeyGroupMap:
        return placed.setdefault("anew" if not in_view else "grown", order(tree, new, in_view))

    monkeypatch.setattr(Isam2Tree, "_order", watched)
    sequence = simulate(replace(DRIVE, duration_s=1.0), 0)
    estimator = Isam2(setup_of(sequence))
    for packet in sequence.packets():
        estimator.step(packet)
    tree = estimator._tree
    states = sum(map(len, tree._recent)) + 1  # and the last variable
    assert placed["grown"].size() > states
    tree._rebuild(gtsam.NonlinearFactorGraph(tree.isam.getFactorsUnsafe()), tree.isam.getLinearizationPoint())
    assert placed["anew"].size() == states


def test_seconds_of_an_accurate_imu_alone_are_solved_by_cholesky(run_estimator):
    """Two states of neighbouring frames in one clique would be beyond the condition that GTSAM allows."""
    sequence = simulate(replace(FLIGHT, duration_s=3.0), 1)
    hidden = sequence.observations.frame < 50
    blind = replace(sequence, observations=sequence.observations.select(~hidden))
    run = run_estimator("isam2", blind, settings=Settings(outliers=POLICIES["none"]))
    assert (run.status, run.log) == ("ok", ())


def places_and_renewals(sequence: Sequence) -> Iterator[tuple[set[int], set[tuple[int, ...]], set[tuple[int, ...]]]]:
    """Yield frame by frame which old states moved where they are linearised, and the old Python factors' keys.

    Those of the factors that are as they were, and of those that are linearised anew.
    """
    estimator, before, at = Isam2(setup_of(sequence)), dict[tuple[int, ...], CachedLinearisation](), gtsam.Values()
    for packet in sequence.packets():
        estimator.step(packet)
        now = {held.keys: held for held in estimator._tree._cached.values()}
        places = gtsam.Values(estimator._tree.isam.getLinearizationPoint())
        old = [key for key in places.keys() if at.exists(key) and kind_of(key) in "xb"]  # noqa: SIM118
        steps = places.extract(old).localCoordinates(at.extract(old))
        kept = {keys for keys, held in before.items() if now[keys] is held}
        yield {key for key in old if np.abs(steps.at(key)).max() > ROUNDING}, kept, before.keys() - kept
        before, at = now, places


def test_recent_states_are_linearised_anew_together_and_python_factors_with_them(monkeypatch):
    """One that moves alone would leave the others' factors with Jacobians of elsewhere; frozen ones stay to the end."""
    monkeypatch.setattr(isam2_tree, "POSITION_THRESHOLD_BASELINES", 0.015)
    events = 0
    for frame, (moved, kept, renewed) in enumerate(places_and_renewals(short(DRIVE, 6.0))):
        assert all(not moved.isdisjoint(keys) for keys in renewed)
        assert all(moved.isdisjoint(keys) for keys in kept)
        poses = sorted(gtsam.Symbol(key).index() for key in moved if kind_of(key) == "x")
        assert poses == list(range(poses[0], poses[-1] + 1)) if poses else not moved
        # The step to the next frame concerns a state, too, and its last turn comes in the frame it is frozen in.
        assert not poses or poses[0] >= frame - FROZEN_AFTER_FRAMES - 1
        events += bool(renewed) and bool(kept)
    assert events > 2, "so that some are frozen by then"


@pytest.fixture
def nothing_linearised_anew(monkeypatch):
    """Then what leaves the tree is linearised as what stays, and answers may differ by rounding alone."""
    for name in ("ROTATION_THRESHOLD_RAD", "POSITION_THRESHOLD_BASELINES", "VELOCITY_THRESHOLD"):
        monkeypatch.setattr(isam2_tree, name, 1e9)
    monkeypatch.setattr(isam2_tree, "BIAS_THRESHOLD", (1e9, 1e9))
    monkeypatch.setattr(isam2_tree, "LANDMARK_BEYOND_SIGMA", np.inf)


def stepped(sequence: Sequence, monkeypatch, retired_after: int) -> tuple[Isam2, list[Estimate]]:
    monkeypatch.setattr(isam2_tree, "FROZEN_AFTER_FRAMES", 5)
    monkeypatch.setattr(isam2_tree, "RETIRED_AFTER_FRAMES", retired_after)
    monkeypatch.setattr(isam2_tree, "RETIRING_EVERY_FRAMES", 4)
    estimator = Isam2(setup_of(sequence))
    return estimator, [estimator.step(packet) for packet in sequence.packets()]


def without_returns(sequence: Sequence) -> Sequence:
    """Return the sequence without sightings of tracks that were not seen in the frame before, but for their first."""
    rows, seen, before = sequence.observations, set[int](), set[int]()
    kept = np.zeros(rows.frame.size, dtype=bool)
    for k in range(sequence.frame_count):
        here = np.flatnonzero(rows.frame == k)
        kept[here] = [i in before or i not in seen for i in rows.track_id[here].tolist()]
        before = set(rows.track_id[here[kept[here]]].tolist())
        seen |= before
    return replace(sequence, observations=rows.select(kept))


def assert_same_answers(ours: list[Estimate], theirs: list[Estimate]) -> None:
    """Poses to a hundred thousandth of a sigma: a marginal is solved for in another order."""
    for one, other in zip(ours, theirs, strict=True):
        off = se3_log(se3_inverse(other.T_world_imu) @ one.T_world_imu)
        assert (np.abs(off) < 1e-5 * np.sqrt(np.diagonal(other.cov)[:6])).all()
        np.testing.assert_allclose(np.diagonal(one.cov), np.diagonal(other.cov), rtol=1e-5)


def bridged() -> Sequence:
    """Return a drive with a gap in its tracks, over which a bridge still ties a pose whose bias no frame uses."""
    noisy = TwistNoise(np.full(3, 0.16), np.full(3, 0.016), np.full(3, 1e-5))
    return cut_tracks(short(replace(DRIVE, motion=replace(DRIVE.motion, noise=noisy)), 2.5, 30, 1), 0.4, 1)


@pytest.mark.usefixtures("nothing_linearised_anew")
@pytest.mark.parametrize(
    "sequence",
    [*(lambda s=s: without_returns(short(s, 2.5, 30, 1)) for s in (DRIVE, DRIVE_IMU)), bridged],
    ids=["drive", "drive-imu", "bridged"],
)
def test_what_leaves_the_tree_leaves_whole_changes_no_later_answer_and_is_in_the_final_one(sequence, monkeypatch):
    """A bias that left alone would take all factors of its pose along, and the tree would have a pose on nothing."""
    whole, expected = stepped(sequence(), monkeypatch, retired_after=1000)
    ours, estimates = stepped(sequence(), monkeypatch, retired_after=8)
    assert_same_answers(estimates, expected)
    assert not ours._tree.has(X(3))
    assert whole._tree.has(X(3))
    assert ours._tree.isam.getLinearizationPoint().size() < 0.6 * whole._tree.isam.getLinearizationPoint().size()
    assert ours._tree.graph().size() == whole._tree.graph().size()
    assert set(ours._tree.values().keys()) == set(whole._tree.values().keys())
    finals = [estimator.finish().trajectory.T_world_imu for estimator in (ours, whole)]
    # Both stop where the error stalls, of which a hundredth of a sigma is the slack.
    np.testing.assert_allclose(finals[0], finals[1], atol=2e-3)


@pytest.mark.usefixtures("nothing_linearised_anew")
def test_a_track_that_returns_has_the_tree_whole_again(monkeypatch):
    sequence = without_returns(short(DRIVE_IMU, 2.5, 50, 1))
    rows = sequence.observations
    seen_first_and_late = np.intersect1d(rows.track_id[rows.frame < 4], rows.track_id[rows.frame >= 20])
    assert seen_first_and_late.size
    returning = np.isin(rows.track_id, seen_first_and_late) & (rows.frame >= 4) & (rows.frame < 20)
    sequence = replace(sequence, observations=rows.select(~returning))
    _, expected = stepped(sequence, monkeypatch, retired_after=1000)
    ours, estimates = stepped(sequence, monkeypatch, retired_after=8)
    assert_same_answers(estimates, expected)
    assert ours._tree.has(X(0))
    assert ours._tree.has(L(int(seen_first_and_late[0])))


def test_a_landmark_is_linearised_badly_where_its_linear_image_is_off_by_a_share_of_the_noise():
    rng = np.random.default_rng(0)
    sequence = simulate(replace(FLIGHT, duration_s=0.5), 0)
    pose, rig = sequence.prior.T_world_imu, sequence.rig
    camera = np.column_stack([rng.uniform(-1.0, 1.0, (200, 2)), rng.uniform(1.0, 20.0, 200)])
    before = transform(pose @ rig.T_imu_cam, camera)
    now = transform(pose @ rig.T_imu_cam, camera * np.exp(rng.normal(0.0, 0.1, (200, 1))) + rng.normal(0.0, 0.01, 3))
    linear, there = stereo.predict(before, pose, rig), stereo.predict(now, pose, rig)
    reported_px = linear.uv_px + (linear.d_uv_d_point @ (now - before)[..., None])[..., 0]
    off = np.linalg.norm((reported_px - there.uv_px) @ rig.whitener.T, axis=1)
    badly = isam2_tree.linearised_badly(now, before, pose, rig)
    np.testing.assert_array_equal(badly, off > isam2_tree.LANDMARK_BEYOND_SIGMA)
    assert 20 < badly.sum() < 180


def test_among_vehicles_landmarks_without_a_depth_are_dropped_and_may_begin_anew():
    """Their depths grow without end. One of which nothing was left but its value could not begin anew: it failed."""
    sequence = moving_vehicles(simulate(replace(DRIVE, duration_s=2.0), seed=0), dose=0.6, seed=0)
    ungated = Settings(outliers=Outliers(gate_probability=None))  # the gate refuses the vehicles
    estimator = Isam2(setup_of(sequence, ungated))
    newest = [estimator.step(packet) for packet in sequence.packets()][-1]
    log, tree = estimator.finish().log, estimator._tree
    assert any("indeterminate and was dropped" in line for line in log)
    assert set(tree.isam.getLinearizationPoint().keys()) == {*tree.isam.getFactorsUnsafe().keyVector()}
    # 20 m of odometry that is good to 0.1 m.
    assert off_at_the_end_m(sequence, newest) < 0.5
