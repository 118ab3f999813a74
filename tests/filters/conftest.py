"""The oracle of the filters' proofs: every state and every landmark of a recording in one graph, solved by GTSAM.

The graph is made of the smoothers' own factors and linearised at the truth. A recording whose realised errors are
a tiny share of the stated ones is linear in effect: what a filter linearises at is the truth to that share.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache

import gtsam
import numpy as np

from filters.kalman.joint import AtLatestEstimates, JointBelief, propagate
from toolkit import runner
from toolkit.estimate import Estimate
from toolkit.estimator import Setup
from toolkit.geometry import Array, IntArray, se3_inverse, se3_log, skew
from toolkit.measurements import Prior
from toolkit.models.factors import B, L, StereoFactors, V, X
from toolkit.models.graph_state import GraphIncrement
from toolkit.models.motion import motion_model
from toolkit.models.state import IMU_LAYOUT, Belief
from toolkit.models.stereo import project, triangulate_world
from toolkit.sequence import Observations, Sequence
from toolkit.settings import DEFAULTS, Settings
from toolkit.simulation import Scenario, simulate
from toolkit.simulation.sensors import Imu

SEED = 11


@dataclass(frozen=True, eq=False)
class Recording:
    """A simulated sequence with its truth at every frame, and the exact points (M, 3) of its tracks (M,)."""

    sequence: Sequence
    track_ids: IntArray
    points: Array

    @property
    def setup(self) -> Setup:
        return setup_of(self.sequence)

    def truth_at(self, k: int) -> Estimate:
        truth = self.sequence.truth
        return Estimate(int(truth.t_ns[k]), truth.T_world_imu[k], v_world=truth.v_world[k], bias=truth.bias[k])

    def error_of(self, estimate: Estimate, k: int) -> Array:
        """Return the error (d,) of an estimate of state k, in the order of its covariance."""
        truth = self.truth_at(k)
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
        camera, sightings = StereoFactors(recording.sequence.rig), gtsam.NonlinearFactorGraph()
        for k, frame in enumerate(frames):
            for factor in camera.of(frame, k):
                sightings.add(factor)
        linear.push_back(sightings.linearize(values))
        self._delta = linear.optimize()
        self._marginals = gtsam.Marginals(linear, self._delta)

    def _motion(self) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
        recording, values = self._recording, gtsam.Values()
        maker = motion_model(recording.setup.noise, recording.setup.gravity_world)
        graph = maker.hold(maker.initial_belief(recording.setup.prior), 0)
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


def assert_covariances_agree(one: Array, other: Array, relative: float) -> None:
    """Compare covariances (..., d, d) in units of the standard deviations: their entries span many orders."""
    sigma = np.sqrt(np.diagonal(other, axis1=-2, axis2=-1))
    assert np.abs((one - other) / (sigma[..., :, None] * sigma[..., None, :])).max() < relative


def with_clones(
    scenario: Scenario, seed: int, count: int, belief: Callable[..., JointBelief] = JointBelief
) -> tuple[Sequence, JointBelief]:
    """Return a recording and the joint belief after its first frames, of which it has a clone each, without vision."""
    sequence = simulate(scenario, seed)
    model = motion_model(sequence.noise, sequence.gravity_world)
    joint = belief(model.initial_belief(sequence.prior))
    for packet in list(sequence.packets())[:count]:
        propagate(joint, model, AtLatestEstimates(), packet.motion)
        joint.clone()
    return sequence, joint


def update_by_rows(joint: JointBelief, H: Array, residuals: Array, columns: slice) -> None:
    """Correct a belief by whitened residuals (m,) with their Jacobian (m, k) to some columns of its error."""
    cross = H @ joint.cov[columns]
    joint.update(cross, cross[:, columns] @ H.T + np.eye(len(H)), residuals)


def recording_with_a_fleck(scenario: Scenario, tracks: int, seed: int, depth_m: float) -> Sequence:
    """Return a recording of few tracks, with a point that moves with the car tracked throughout."""
    sequence = short(scenario, scenario.duration_s, tracks, seed)
    count, seen, rig = sequence.frame_count, sequence.observations, sequence.rig
    noise = np.random.default_rng(seed).standard_normal((count, 3)) * np.sqrt(np.diag(rig.cov_uv_px2))
    observations = Observations.sorted(
        np.r_[seen.frame, np.arange(count)],
        np.r_[seen.track_id, np.full(count, 10**6)],
        np.r_[seen.uv_px, project(depth_m * np.array([0.1, 0.05, 1.0]), rig) + noise],
    )
    return replace(sequence, observations=observations)


def short(scenario: Scenario, duration_s: float, tracks: int | None = None, seed: int = 0) -> Sequence:
    """Simulate so many seconds of a scenario with at most so many tracks in view."""
    camera = replace(scenario.camera, max_tracks=tracks or scenario.camera.max_tracks)
    return simulate(replace(scenario, duration_s=duration_s, camera=camera), seed)


def linear(scenario: Scenario, duration_s: float) -> Scenario:
    """Return a scenario that is linear in effect where its errors are drawn small: short, of few tracks.

    Exact IMU samples integrate to the truth only in the limit of their rate: 1 kHz errs by 1e-8 m a frame.
    """
    motion = replace(scenario.motion, rate_hz=1000.0) if isinstance(scenario.motion, Imu) else scenario.motion
    return replace(scenario, duration_s=duration_s, motion=motion, camera=replace(scenario.camera, max_tracks=30))


def setup_of(sequence: Sequence, settings: Settings = DEFAULTS) -> Setup:
    return runner.setup_of(sequence, sequence.prior, settings)


def off_at_the_end_m(sequence: Sequence, estimate: Estimate) -> float:
    """Return how far the estimate of the last frame is from the truth."""
    return float(np.linalg.norm(estimate.T_world_imu[:3, 3] - sequence.truth.T_world_imu[-1, :3, 3]))


# Half a metre and six degrees: beside them, the prior of a centimetre and a tenth of a degree is nothing.
LOOSENESS = np.array([0.5, 0.5, 0.5, 0.1, 0.1, 0.1])


def gauge(joint: JointBelief, turns: Array) -> Array:
    """Return the plain errors (n, 3 + t) when the world shifts along x, y, z and turns about axes (3, t)."""

    def of_pose(T: Array) -> Array:
        to_body = T[:3, :3].T
        return np.block([[np.zeros((3, 3)), to_body @ turns], [to_body, -to_body @ skew(T[:3, 3]) @ turns]])

    core, still = joint.core, np.zeros((3, 3))
    rows = [of_pose(core.T_world_imu)]
    if core.layout.velocity is not None:
        rows.append(np.hstack([still, -core.T_world_imu[:3, :3].T @ skew(core.v_world) @ turns]))
    rows.append(np.zeros((core.layout.size - sum(map(len, rows)), 3 + turns.shape[1])))
    rows += [np.hstack([np.eye(3), -skew(point) @ turns]) for point in joint.points]
    rows += [of_pose(T) for T in joint.clones]
    return np.vstack(rows)


def loosened(prior: Prior, core: Belief, turns: Array) -> Prior:
    """Return the prior with independent errors along the gauge added: the prior alone knew of it."""
    directions = np.zeros((15, 3 + turns.shape[1]))
    rows = np.arange(15) if core.layout is IMU_LAYOUT else np.r_[0:6, 12:15]
    directions[rows] = gauge(JointBelief(core), turns)
    return replace(prior, cov=prior.cov + (directions * LOOSENESS[: 3 + turns.shape[1]] ** 2) @ directions.T)


class Problem:
    """A simulated recording as a graph, started from disturbed truth."""

    def __init__(self, sequence: Sequence) -> None:
        self.rig, self.packets = sequence.rig, list(sequence.packets())
        self.frames = [packet.frame for packet in self.packets]
        self.motion = motion = motion_model(sequence.noise, sequence.gravity_world)
        maker = StereoFactors(sequence.rig)
        self.graph, self.start = motion.hold(motion.initial_belief(sequence.prior), 0), gtsam.Values()
        self.increments: dict[int, GraphIncrement] = {}
        truth, rng = sequence.truth, np.random.default_rng(5)
        for k, packet in enumerate(self.packets):
            disturbed = gtsam.Pose3(truth.T_world_imu[k]).retract(0.02 * rng.standard_normal(6)).matrix()
            estimate = Estimate(packet.frame.t_ns, disturbed, v_world=truth.v_world[k], bias=np.zeros(6))
            motion.insert(self.start, estimate, k)
            if packet.motion is not None:
                self.increments[k] = motion.integrate(packet.motion, np.zeros(6))
                self.graph.push_back(self.increments[k].factors(k))
            for factor in maker.of(packet.frame, k):
                self.graph.add(factor)
            points = triangulate_world(packet.frame.uvs_px, disturbed, sequence.rig)
            for track_id, point in zip(packet.frame.track_ids.tolist(), points, strict=True):
                if not self.start.exists(L(track_id)):
                    self.start.insert(L(track_id), point)
