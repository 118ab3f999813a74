"""fixed-lag and isam2 on sightings correlated along their tracks: against batch, the bound, and themselves."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest

from filters.batch import Batch
from filters.fixed_lag import FixedLag
from filters.isam2 import Isam2
from toolkit.estimator import Setup
from toolkit.geometry import se3_exp, se3_inverse, se3_log
from toolkit.models.factors import L, X, kind_of
from toolkit.settings import POLICIES, Settings
from toolkit.simulation import DRIVE, FLIGHT
from toolkit.track_noise import TrackNoise

NOISE = TrackNoise(np.full(3, 0.02), np.array([0.09, 0.13, 0.11]), np.array([0.0, 0.9, 0.0]))
NO_LOSS = Settings(outliers=POLICIES["none"])
SHORT_DRIVE = replace(DRIVE, duration_s=2.0, camera=replace(DRIVE.camera, max_tracks=25))
SHORT_FLIGHT = replace(FLIGHT, duration_s=0.8, camera=replace(FLIGHT.camera, max_tracks=25))
LONGER_FLIGHT = replace(SHORT_FLIGHT, duration_s=2.0)


def setup_of(sequence, settings=NO_LOSS):
    s = sequence
    return Setup(s.rig, s.noise, s.prior, s.gravity_world, s.motion_kind, settings=settings)


def endless(setup):
    return FixedLag(setup, 100.0)


def windowed(setup):
    return FixedLag(setup, 0.4)


def finished(estimator, sequence):
    for packet in sequence.packets():
        estimator.step(packet)
    return estimator.finish()


@pytest.mark.parametrize("scenario", [SHORT_DRIVE, SHORT_FLIGHT], ids=lambda s: s.name)
def test_with_everything_in_the_window_they_are_the_batch(scenario, oracle):
    """Held equal: everything but the solver. fixed-lag takes one Gauss-Newton step a frame, which leaves the newest
    landmarks a step short; isam2 solves in the end as batch does.
    """
    sequence = oracle.with_track_errors(scenario, NOISE, 3)
    best = finished(Batch(setup_of(sequence)), sequence).trajectory
    sigma = np.sqrt(np.diagonal(best.cov, axis1=1, axis2=2))[:, :6]
    for build, sigmas in ((endless, 0.25), (Isam2, 0.01)):
        answer = finished(build(setup_of(sequence)), sequence).trajectory
        off = se3_log(se3_inverse(best.T_world_imu) @ answer.T_world_imu)
        assert (np.abs(off) < sigmas * sigma).all()
        for one, other in zip(answer.cov, best.cov, strict=True):
            oracle.assert_covariances_agree(one, other, 0.05)


@pytest.mark.parametrize("scenario", [SHORT_DRIVE, SHORT_FLIGHT], ids=lambda s: s.name)
def test_what_leaves_the_window_is_neither_counted_twice_nor_forgotten(scenario, oracle):
    """The newest state against the step from the truth with the whole covariance of every track, and its marginal.

    What has left stays linearised where it was, and the chain forgets (0.02 / 0.9)^2 of an offset at every step.
    """
    sequence = oracle.with_track_errors(scenario, NOISE, 5)
    last = sequence.frame_count - 1
    truth = replace(oracle.recorded(scenario, 0.0, 5), sequence=sequence)
    best, cov = oracle.batch(truth, truth.track_ids).state(last)
    for seen, efficient in ((sequence, True), (replace(sequence, rig=replace(sequence.rig, track_noise=None)), False)):
        estimator = FixedLag(setup_of(seen), 0.3)
        newest = [estimator.step(packet) for packet in seen.packets()][-1]
        claimed = np.trace(np.linalg.solve(cov, newest.cov)) / len(cov)
        beyond = truth.error_of(newest, last) - best
        excess = beyond @ np.linalg.solve(cov, beyond) / len(cov)
        assert ((abs(claimed - 1.0) < 0.03) and excess < 0.05) == efficient, (claimed, excess)


def test_what_fixed_lag_claims_of_the_tilt_does_not_depend_on_where_it_starts(oracle):
    """A start half a degree off is less than GTSAM lets stand unlinearised: where sightings were linearised anew and
    the motion was not, the two told the tilt to a sixth of the deviation it had. Held to the claim from the true start,
    and that to batch's, which has the same measurements in the end.
    """
    sequence = oracle.with_track_errors(LONGER_FLIGHT, NOISE, 7)
    assert sequence.prior is not None
    # Tilt, velocity and the accelerometer's bias are what only motion tells apart.
    sigmas = np.repeat([0.02, 3e-4, 0.05, 0.2, 2e-3], 3)
    claims = []
    for tilted, build in ((0.0, windowed), (0.009, windowed), (0.0, Batch)):
        pose = sequence.prior.T_world_imu @ se3_exp(np.array([tilted, -tilted, 0.0, 0.0, 0.0, 0.0]))
        prior = replace(sequence.prior, T_world_imu=pose, cov=np.diag(np.square(sigmas)))
        started = replace(sequence, prior=prior)
        claims.append(finished(build(setup_of(started)), started).trajectory.cov[-1])
    true, off, batch = claims
    oracle.assert_covariances_agree(off, true, 0.05)
    oracle.assert_covariances_agree(true, batch, 0.1)


def test_what_isam2_claims_of_the_newest_state_is_what_batch_claims(oracle):
    """Over an IMU, from a start half a degree off: with the Jacobians of chains at the estimates and not where the tree
    linearises, the newest tilt had a seventh of the deviation that batch has for it, the position half.
    """
    sequence = oracle.with_track_errors(LONGER_FLIGHT, NOISE, 7)
    tilted = se3_exp(np.array([0.009, -0.009, 0.0, 0.0, 0.0, 0.0]))
    sigmas = np.repeat([0.02, 3e-4, 0.05, 0.2, 2e-3], 3)
    start = replace(sequence.prior, T_world_imu=sequence.prior.T_world_imu @ tilted, cov=np.diag(np.square(sigmas)))
    started = replace(sequence, prior=start)
    isam2 = Isam2(setup_of(started))
    claims = [isam2.step(packet) for packet in started.packets()][-1].cov
    batch = finished(Batch(setup_of(started)), started).trajectory.cov[-1]
    # Of what is frozen after 1.5 s the linearisation stays: the sigmas are within 3 %.
    oracle.assert_covariances_agree(claims, batch, 0.1)


def test_a_tree_built_anew_in_mid_run_leaves_every_later_answer_as_it_was(oracle):
    """To rounding, and to the second order of what a frame still moves what it holds."""
    sequence, runs = oracle.with_track_errors(SHORT_DRIVE, NOISE, 1), []
    for rebuilt_at in (None, sequence.frame_count // 2):
        estimator, estimates = FixedLag(setup_of(sequence), 0.5), []
        for packet in sequence.packets():
            if packet.index == rebuilt_at:
                assert estimator._tree.rebuild().log == []
            estimates.append(estimator.step(packet))
        runs.append(estimates)
    for one, other in zip(*runs, strict=True):
        off = se3_log(se3_inverse(one.T_world_imu) @ other.T_world_imu)
        assert (np.abs(off) < 1e-3 * np.sqrt(np.diagonal(one.cov)[:6])).all()


class RefusesOnce:
    """A tree of GTSAM that takes an update in and then says that a variable is indeterminate."""

    def __init__(self, isam, key):
        self._isam, self._key = isam, key

    def __getattr__(self, name):
        return getattr(self._isam, name)

    def update(self, *arguments):
        self._isam.update(*arguments)
        raise RuntimeError(f"Indeterminant linear system detected while working near variable {self._key}")


def test_an_update_that_gtsam_refuses_counts_no_sighting_twice(oracle):
    """The sightings of the refused update are in the tree by then, in slots that are to be found.

    They stayed beside those of the tree built anew: with them sigmas were a tenth of what they are.
    """
    sequence, runs = oracle.with_track_errors(SHORT_DRIVE, NOISE, 1), []
    for refused_at in (None, sequence.frame_count // 2):
        estimator, estimates, graphs = FixedLag(setup_of(sequence), 0.5), [], []
        tree = estimator._tree
        for packet in sequence.packets():
            if packet.index == refused_at:
                tree._isam = RefusesOnce(tree._isam, X(packet.index))
            estimates.append(estimator.step(packet))
            graphs.append(tree._isam.getFactorsUnsafe().nrFactors())
        assert len(estimator.finish().log) == (refused_at is not None)
        runs.append((estimates, graphs))
    (usual, sizes), (recovered, sizes_again) = runs
    assert sizes == sizes_again
    for one, other in zip(usual, recovered, strict=True):
        sigmas = np.sqrt(np.diagonal(one.cov))
        off = se3_log(se3_inverse(one.T_world_imu) @ other.T_world_imu)
        # The second tree linearises the frame's sightings where the first one did: 0.8 % of a sigma, measured.
        assert (np.abs(off) < 0.02 * sigmas[:6]).all()
        np.testing.assert_allclose(np.sqrt(np.diagonal(other.cov)), sigmas, rtol=2e-3)


def test_the_slots_of_isam2_are_those_of_its_chained_sightings_whatever_was_dropped_or_built_anew(oracle):
    sequence = oracle.with_track_errors(SHORT_DRIVE, NOISE, 2)
    estimator, dropped = Isam2(setup_of(sequence, Settings())), None
    for packet in sequence.packets():
        estimator.step(packet)
        tree = estimator._tree
        if packet.index == 8:
            dropped = int(packet.frame.track_ids[0])
            assert tree.drop([L(dropped)]).log == []
            estimator._builder.forget({dropped})
            tree._rebuild(gtsam.NonlinearFactorGraph(tree.isam.getFactorsUnsafe()), tree.isam.calculateBestEstimate())
        factors = tree.isam.getFactorsUnsafe()
        slots = {slot for slot in range(factors.size()) if factors.exists(slot) and any_landmark(factors.at(slot))}
        assert set(estimator._chained.slots()) == slots
    rows = estimator._chained.whole().sightings
    assert (rows.pose[rows.track_ids[rows.point] == dropped] > 8).all()


@pytest.mark.parametrize("offset_px", [10.0, 30.0, 100.0])
def test_landmarks_whose_stated_offset_leaves_no_depth_do_not_end_fixed_lag(offset_px, oracle):
    """GTSAM refuses nearly every landmark of the first frame; what it refused is in the next tree once, not twice."""
    track_noise = TrackNoise(np.full(3, 0.03), np.full(3, 0.13), np.array([0.0, offset_px, 0.0]))
    sequence = oracle.with_track_errors(SHORT_FLIGHT, NOISE, 3)
    stated = replace(sequence, rig=replace(sequence.rig, track_noise=track_noise))
    estimator = endless(setup_of(stated, Settings()))
    for packet in stated.packets():
        estimator.step(packet)
        factors = estimator._tree._isam.getFactorsUnsafe()
        slots = {slot for slot in range(factors.size()) if factors.exists(slot) and is_sighting(factors.at(slot))}
        assert set(estimator._tree._chained.slots) == slots
    assert any("has a weak prior" in line for line in estimator.finish().log)


def is_sighting(factor):
    keys = factor.keys()
    return len(keys) > 1 and any_landmark(factor)


def any_landmark(factor):
    keys = factor.keys()
    return any(kind_of(key) == "l" for key in keys)


def test_a_landmark_behind_every_camera_that_saw_it_does_not_come_into_a_tree_built_anew(oracle):
    """None of its sightings counts there; GTSAM has no place for a variable without a factor, and said ``map::at``."""
    sequence = oracle.with_track_errors(SHORT_DRIVE, NOISE, 3)
    estimator, packets = FixedLag(setup_of(sequence), 100.0), list(sequence.packets())
    for packet in packets[:6]:
        estimator.step(packet)
    lost = int(packets[5].frame.track_ids[0])
    values = estimator._tree.values()
    values.update(L(lost), values.atPose3(X(0)).matrix()[:3] @ np.array([-1e4, 0.0, 0.0, 1.0]))
    recovery = estimator._tree.rebuild()
    assert recovery.dropped == {lost}
    assert recovery.log == [f"l{lost} was behind every camera that saw it and was dropped"]
    assert not estimator._tree.values().exists(L(lost))
    estimator._note(recovery)
    for packet in packets[6:9]:
        estimator.step(packet)
    assert estimator._tree.values().exists(L(lost)) == (lost in packets[8].frame.track_ids)
