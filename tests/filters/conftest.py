"""The oracle of the filters' proofs: every state and every landmark of a recording in one graph, solved by GTSAM.

The graph is made of the smoothers' own factors and linearised at the truth. A recording whose realised errors are
a tiny share of the stated ones is linear in effect: what a filter linearises at is the truth to that share.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from types import SimpleNamespace

import gtsam
import numpy as np
import pytest

from filters.kalman.joint import AtLatestEstimates, JointBelief, propagate
from toolkit import runner
from toolkit.estimate import Estimate
from toolkit.estimator import Setup
from toolkit.geometry import Array, IntArray, se3_inverse, se3_log
from toolkit.measurements import StereoFrame, StereoRig
from toolkit.models.factors import B, L, StereoFactors, V, X
from toolkit.models.motion import motion_model
from toolkit.models.state import Belief
from toolkit.models.stereo import project, triangulate_world
from toolkit.sequence import Observations, Sequence
from toolkit.simulation import Scenario, simulate

SEED = 11


@dataclass(frozen=True, eq=False)
class Recording:
    """A simulated sequence with its truth at every frame, and the exact points (M, 3) of its tracks (M,)."""

    sequence: Sequence
    track_ids: IntArray
    points: Array

    @property
    def setup(self) -> Setup:
        s = self.sequence
        assert s.prior is not None
        return runner.setup_of(s, s.prior)

    def truth_at(self, k: int) -> Estimate:
        truth = self.sequence.truth
        assert truth is not None and truth.v_world is not None and truth.bias is not None
        return Estimate(int(truth.t_ns[k]), truth.T_world_imu[k], v_world=truth.v_world[k], bias=truth.bias[k])

    def error_of(self, estimate: Estimate, k: int) -> Array:
        """Return the error (d,) of an estimate of state k, in the order of its covariance."""
        truth = self.truth_at(k)
        assert estimate.bias is not None and truth.bias is not None
        pose = se3_log(se3_inverse(truth.T_world_imu) @ estimate.T_world_imu)
        bias = estimate.bias - truth.bias
        if self.sequence.motion_kind == "twist":
            return np.concatenate([pose, bias[3:]])
        return np.concatenate([pose, truth.T_world_imu[:3, :3].T @ (estimate.v_world - truth.v_world), bias])


@cache
def recorded(scenario: Scenario, noise_scale: float, seed: int = SEED) -> Recording:
    """Record a scenario with its errors scaled and its stated noise as it is."""
    unrounded = replace(scenario, camera=replace(scenario.camera, step_px=0.0))
    sequence = simulate(replace(unrounded, noise_scale=noise_scale), seed)
    exact = simulate(replace(unrounded, noise_scale=0.0), seed)
    np.testing.assert_array_equal(exact.visible.track_id, sequence.visible.track_id)
    track_ids, first = np.unique(exact.visible.track_id, return_index=True)
    assert exact.truth is not None
    poses = exact.truth.T_world_imu[exact.visible.frame[first]]
    return Recording(sequence, track_ids, triangulate_world(exact.visible.uv_px[first], poses, exact.rig))


class BatchAtTruth:
    """One Gauss-Newton step from the truth over everything, and its marginals."""

    def __init__(self, recording: Recording, used: IntArray) -> None:
        """Take in the prior, every motion, and every sighting of the tracks used (M,)."""
        self._recording = recording
        graph, values = self._motion()
        frames = [p.frame.select(np.isin(p.frame.track_ids, used)) for p in recording.sequence.packets()]
        seen = set[int](np.concatenate([frame.track_ids for frame in frames]).tolist())
        for track_id, point in zip(recording.track_ids.tolist(), recording.points, strict=True):
            if track_id in seen:
                values.insert(L(track_id), point)
        linear = graph.linearize(values)
        linear.push_back(_seen(frames, values, recording.sequence.rig))
        self._delta = linear.optimize()
        self._marginals = gtsam.Marginals(linear, self._delta)

    def _motion(self) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
        recording, values = self._recording, gtsam.Values()
        maker = motion_model(recording.setup.noise, recording.setup.gravity_world)
        graph = maker.hold(first_belief(recording), 0)
        for packet in recording.sequence.packets():
            maker.insert(values, recording.truth_at(packet.index), packet.index)
            if packet.motion is not None:
                bias = recording.truth_at(packet.index - 1).bias
                graph.push_back(maker.integrate(packet.motion, bias).factors(packet.index))
        return graph, values

    def state(self, k: int) -> tuple[Array, Array]:
        """Return the error (d,) of state k and its covariance (d, d), in the filters' order and frames."""
        keys = [X(k), B(k)] if self._recording.sequence.motion_kind == "twist" else [X(k), V(k), B(k)]
        joint = self._marginals.jointMarginalCovariance(keys)
        error = np.concatenate([self._delta.at(key) for key in keys])
        cov = np.block([[joint.at(one, other) for other in keys] for one in keys])
        to_body = np.eye(len(error))
        if len(keys) == 3:
            to_body[6:9, 6:9] = self._recording.truth_at(k).T_world_imu[:3, :3].T
        return to_body @ error, to_body @ cov @ to_body.T


def _seen(frames: list[StereoFrame], values: gtsam.Values, rig: StereoRig) -> gtsam.GaussianFactorGraph:
    graph, camera = gtsam.NonlinearFactorGraph(), StereoFactors(rig)
    for k, frame in enumerate(frames):
        for factor in camera.of(frame, k):
            graph.add(factor)
    return graph.linearize(values)


def first_belief(recording: Recording) -> Belief:
    return motion_model(recording.setup.noise, recording.setup.gravity_world).initial_belief(recording.setup.prior)


def assert_covariances_agree(one: Array, other: Array, relative: float) -> None:
    """Compare two covariances (d, d) in units of the standard deviations: their entries span many orders."""
    sigma = np.sqrt(np.diag(other))
    assert np.abs((one - other) / np.outer(sigma, sigma)).max() < relative


@pytest.fixture(scope="session")
def oracle() -> SimpleNamespace:
    """Return the tools of this file: what is not a fixture cannot be imported from here."""
    return SimpleNamespace(
        recorded=recorded,
        batch=BatchAtTruth,
        assert_covariances_agree=assert_covariances_agree,
    )


def with_clones(scenario: Scenario, seed: int, count: int) -> tuple[Sequence, JointBelief]:
    """Return a recording and the joint belief after its first frames, of which it has a clone each, without vision."""
    sequence = simulate(scenario, seed)
    model = motion_model(sequence.noise, sequence.gravity_world)
    joint = JointBelief(model.initial_belief(sequence.prior))
    for packet in list(sequence.packets())[:count]:
        propagate(joint, model, AtLatestEstimates(), packet.motion)
        joint.clone()
    return sequence, joint


@pytest.fixture(scope="session")
def window_of_clones() -> Callable[[Scenario, int, int], tuple[Sequence, JointBelief]]:
    """Return a maker of windows of exact clones, of a scenario under a seed."""
    return with_clones


@pytest.fixture
def recording_with_a_fleck() -> Callable[[Scenario, int, int, float], Sequence]:
    """Return a maker of recordings of few tracks, with a point that moves with the car tracked throughout."""

    def record(scenario: Scenario, tracks: int, seed: int, depth_m: float) -> Sequence:
        sequence = simulate(replace(scenario, camera=replace(scenario.camera, max_tracks=tracks)), seed)
        count, seen, rig = sequence.frame_count, sequence.observations, sequence.rig
        noise = np.random.default_rng(seed).standard_normal((count, 3)) * np.sqrt(np.diag(rig.cov_uv_px2))
        observations = Observations.sorted(
            np.r_[seen.frame, np.arange(count)],
            np.r_[seen.track_id, np.full(count, 10**6)],
            np.r_[seen.uv_px, project(depth_m * np.array([0.1, 0.05, 1.0]), rig) + noise],
        )
        return replace(sequence, observations=observations)

    return record
