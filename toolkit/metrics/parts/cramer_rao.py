"""The Cramér-Rao bound of a recording, and the estimate that attains it, at every frame.

No unbiased estimator has a smaller covariance than the inverse of Fisher's information (Van Trees, "Detection,
estimation and modulation theory", part I, 1968, section 2.4). For Gaussian measurements that is the information of all
factors linearised at the truth: the factors, the noise, the prior and the tracks are those the estimators have. No
estimator is used to compute it: the causal bound comes from a forward information filter over the state and the
landmarks that are still to be seen (Tichavsky, Muravchik & Nehorai 1998, "Posterior Cramér-Rao bounds for discrete-time
nonlinear filtering"), the final one by eliminating the whole graph.

The efficient estimate attains the bound: it is one linear step from the truth on the same measurements. The error of
any unbiased estimator is that of the efficient one plus an uncorrelated part. The difference of both errors is
therefore the estimator's own loss, without the noise that both share.

This needs an exact truth with every state: the motion measured between its states must differ from them by as much as
the stated noise. Where a recording has no such truth, the bound that the model claims is computed at an estimate of the
states.
"""

from dataclasses import dataclass, replace
from functools import lru_cache

import gtsam
import numpy as np

from toolkit.answers import Output
from toolkit.arrays import rows_of
from toolkit.estimate import Trajectory
from toolkit.geometry import Array, BoolArray, IntArray
from toolkit.initialization import start_from_measurements
from toolkit.measurements import Packet, Prior, StereoFrame, StereoRig, is_left_only
from toolkit.metrics.parts.against_truth import place_first
from toolkit.metrics.parts.consistency import starts_in_the_truths_world
from toolkit.metrics.parts.scores import Unavailable
from toolkit.models import stereo
from toolkit.models.factors import L, StereoFactors
from toolkit.models.gating import chi2_bound
from toolkit.models.graph_state import MotionModel
from toolkit.models.motion import motion_model
from toolkit.models.state import Belief, Layout
from toolkit.models.state_covariances import state_covs
from toolkit.sequence import Sequence

# A sighting whose residual at the truth is this improbable is a mismatch and adds no information.
_MISMATCH_PROBABILITY = 1e-6
_POINT_ITERATIONS = 5
# The chi-square of motion and of sightings at an exact truth, over its degrees of freedom: 1. That of motion is 0.85 to
# 1.15 for 20 steps of an IMU.
_EXACT = (0.8, 1.25)


@dataclass(frozen=True, eq=False)
class Efficient:
    """The bound at every frame (K, d, d), and the errors (K, d) of the efficient estimate.

    Both have the order and the side of an Estimate's covariance; an error is the difference from the estimate to the
    truth.
    """

    layout: Layout
    covs: Array
    errors: Array


@lru_cache(maxsize=2)
def efficient(sequence: Sequence, output: Output) -> Efficient:
    """Return the efficient estimate of a sequence: from the measurements up to each frame, or from all of them.

    It starts as the estimators do: with the prior that was drawn for a simulation, or with the start from another
    sequence's measurements, placed at the first pose. Raises Unavailable if the truth lacks a part of the state, or is
    not exact.
    """
    return _efficient(_problem_at_truth(sequence), output)


@lru_cache(maxsize=2)
def claimed_bound(sequence: Sequence, at: Trajectory, output: Output) -> Array:
    """Return the bound (K, d, d) that the model claims, linearised at estimated states.

    Raises Unavailable where a frame has no estimate of the whole state.
    """
    return _efficient(_problem_at_estimate(sequence, at), output).covs


def _efficient(problem: "_Problem", output: Output) -> Efficient:
    try:
        return _causal(problem) if output == "causal" else _final(problem)
    except (np.linalg.LinAlgError, RuntimeError) as error:  # GTSAM's
        raise Unavailable("the measurements do not determine every state, as it is linearised") from error


@dataclass(frozen=True, eq=False)
class _Problem:
    """The true states, the packets without mismatches, and the landmarks (M, 3) of tracks (M,), by ascending id."""

    rig: StereoRig
    model: MotionModel
    prior: Belief
    states: tuple[Belief, ...]
    packets: tuple[Packet, ...]
    track_ids: IntArray
    points: Array

    def rows(self, frame: StereoFrame) -> IntArray:
        """Return the rows (N,) of the landmarks that a frame shows."""
        return np.searchsorted(self.track_ids, frame.track_ids)


@lru_cache(maxsize=1)
def _problem_at_truth(sequence: Sequence) -> _Problem:
    truth = sequence.truth
    if truth is None:
        raise Unavailable("the sequence has no ground truth")
    lacking = [name for name in ("v_world", "bias") if getattr(truth, name) is None]
    if lacking:
        raise Unavailable(f"the ground truth lacks {' and '.join(lacking)}")
    assert truth.v_world is not None and truth.bias is not None
    rows, there = rows_of(sequence.frames_t_ns, truth.t_ns)
    if not there.all():
        raise Unavailable("the bound needs a truth at every frame's stamp")
    states = truth.T_world_imu[rows], truth.v_world[rows], truth.bias[rows]
    drawn = sequence.prior is not None and starts_in_the_truths_world(sequence)
    problem = _problem(sequence, sequence.prior if drawn else None, *states)
    ratio = _motion_chi_square(problem)
    if not _EXACT[0] < ratio < _EXACT[1]:
        raise Unavailable(
            f"the truth is not exact: the measured motion is off it by {ratio:.2g} times the stated noise, squared"
        )
    ratio, by_chance = _sighting_chi_square(problem)
    if not _EXACT[0] - by_chance < ratio < _EXACT[1] + by_chance:
        raise Unavailable(
            f"the noise is not as stated: at the truth the tracks err by {ratio:.2g} times the stated noise, squared"
        )
    return problem


@lru_cache(maxsize=1)
def _problem_at_estimate(sequence: Sequence, at: Trajectory) -> _Problem:
    rows, there = rows_of(sequence.frames_t_ns, at.t_ns)
    if not there.all():
        raise Unavailable("the estimate lacks the state of a frame")
    imu = sequence.motion_kind == "imu"
    if at.bias is None or (imu and at.v_world is None):
        raise Unavailable("the estimate lacks velocity or biases")
    v_world = np.zeros((rows.size, 3)) if at.v_world is None else at.v_world[rows]
    states = at.T_world_imu[rows], v_world, at.bias[rows]
    if not all(np.isfinite(part).all() for part in states):
        raise Unavailable("the estimate is not finite")
    return _problem(sequence, None, *states)


def _problem(sequence: Sequence, prior: Prior | None, poses: Array, v_world: Array, bias: Array) -> _Problem:
    """Return the problem about states (K, 4, 4), (K, 3), (K, 6), from the given prior or the measured start."""
    model = motion_model(sequence.noise, sequence.gravity_world)
    start = model.initial_belief(_measured_start(sequence, poses[0]) if prior is None else prior)
    states = tuple(Belief(start.layout, *state, start.cov) for state in zip(poses, v_world, bias, strict=True))
    packets, track_ids, points = _without_mismatches(tuple(sequence.packets()), poses, sequence.rig)
    return _Problem(sequence.rig, model, start, states, packets, track_ids, points)


def _measured_start(sequence: Sequence, first_pose: Array) -> Prior:
    """Return the state that estimators start from by default, placed at the first pose (4, 4) as their outputs are.

    With an IMU its tilt is measured and stays; without one it is the whole pose.
    """
    start = start_from_measurements(sequence)
    placement = place_first(first_pose, start.T_world_imu, sequence.motion_kind == "imu")
    T_world_imu = placement.apply(start.T_world_imu[None])[0]
    v_world = T_world_imu[:3, :3] @ start.T_world_imu[:3, :3].T @ start.v_world
    return Prior(T_world_imu, v_world, start.bias, start.cov, start.source)


def _motion_chi_square(problem: _Problem) -> float:
    """Return the mean squared distance of the true steps from the measured motion, over its degrees of freedom."""
    distances = []
    for before, packet in zip(problem.states, problem.packets[1:], strict=False):
        assert packet.motion is not None
        prediction = problem.model.integrate(packet.motion, before.bias).predict(before)
        error = before.predicted(prediction).error_to(problem.states[packet.index])
        distances.append(float(error @ np.linalg.solve(prediction.noise, error)) / error.size)
    return float(np.mean(distances)) if distances else 1.0


def _sighting_chi_square(problem: _Problem) -> tuple[float, float]:
    """Return the mean squared residual of sightings at true poses, and five standard deviations of it by chance.

    It is over the degrees of freedom that the landmarks, fitted to them, leave; 1 where there are none.
    """
    squared, dof = 0.0, -3 * problem.track_ids.size
    for packet, state in zip(problem.packets, problem.states, strict=True):
        uvs_px = packet.frame.uvs_px
        seen = stereo.predict(problem.points[problem.rows(packet.frame)], state.T_world_imu, problem.rig)
        squared += float(np.square(stereo.whitened_residuals(uvs_px, seen.uv_px, problem.rig)).sum())
        dof += int(np.broadcast_to(stereo.degrees_of_freedom(uvs_px), len(uvs_px)).sum())
    return (squared / dof, 5.0 * float(np.sqrt(2.0 / dof))) if dof > 0 else (1.0, 0.0)


def _without_mismatches(
    packets: tuple[Packet, ...], poses: Array, rig: StereoRig
) -> tuple[tuple[Packet, ...], IntArray, Array]:
    """Return the packets without mismatched sightings, and the landmarks (M,), (M, 3) of the rest."""
    kept = _placed_by_stereo(packets)
    for _ in range(2):
        track_ids, points = _landmarks(kept, poses, rig)
        sound = [_explained(p.frame, track_ids, points, pose, rig) for p, pose in zip(kept, poses, strict=True)]
        kept = _placed_by_stereo(tuple(Packet(p.index, p.motion, f) for p, f in zip(kept, sound, strict=True)))
    return kept, *_landmarks(kept, poses, rig)


def _placed_by_stereo(packets: tuple[Packet, ...]) -> tuple[Packet, ...]:
    """Return the packets without left-only sightings of tracks that both images have not shown before."""
    if not any(is_left_only(packet.frame.uvs_px).any() for packet in packets):
        return packets
    placed, kept = np.empty(0, dtype=np.int64), []
    for packet in packets:
        frame, left = packet.frame, is_left_only(packet.frame.uvs_px)
        placed = np.union1d(placed, frame.track_ids[~left])
        kept.append(replace(packet, frame=frame.select(np.isin(frame.track_ids, placed))))
    return tuple(kept)


def _explained(frame: StereoFrame, track_ids: IntArray, points: Array, pose: Array, rig: StereoRig) -> StereoFrame:
    seen = stereo.predict(points[np.searchsorted(track_ids, frame.track_ids)], pose, rig)
    whitened = stereo.whitened_residuals(frame.uvs_px, seen.uv_px, rig)
    bound = chi2_bound(stereo.degrees_of_freedom(frame.uvs_px), 1.0 - _MISMATCH_PROBABILITY)
    likely = np.square(whitened).sum(axis=1) < bound
    return frame.select(likely & (seen.depth_m > 0.0))


def _landmarks(packets: tuple[Packet, ...], poses: Array, rig: StereoRig) -> tuple[IntArray, Array]:
    """Return the tracks (M,) and the points (M, 3) that best explain their sightings from the true poses."""
    frames = [packet.frame for packet in packets]
    ids, uvs_px = np.concatenate([f.track_ids for f in frames]), np.concatenate([f.uvs_px for f in frames])
    pose = np.repeat(np.arange(len(frames)), [f.track_ids.size for f in frames])
    # By track, the sighting with the largest disparity first: it has the most accurate depth.
    order = np.lexsort((-stereo.disparity_px(uvs_px), ids))
    uvs_px, seen_from = uvs_px[order], poses[pose[order]]
    track_ids, first, track = np.unique(ids[order], return_index=True, return_inverse=True)
    points = stereo.triangulate_world(uvs_px[first], seen_from[first], rig)
    whitener = stereo.whitener(uvs_px, rig)
    for _ in range(_POINT_ITERATIONS):
        seen = stereo.predict(points[track], seen_from, rig)
        H, residuals = whitener @ seen.d_uv_d_point, stereo.whitened_residuals(uvs_px, seen.uv_px, rig)
        H_transposed = np.swapaxes(H, 1, 2)
        information = np.add.reduceat(H_transposed @ H, first)
        score = np.add.reduceat((H_transposed @ residuals[..., None])[..., 0], first)
        points = points + np.linalg.solve(information, score[..., None])[..., 0]
    return track_ids, points


def _causal(problem: _Problem) -> Efficient:
    """Propagate the information of state and landmarks; a landmark is marginalised after its last sighting."""
    last_seen = np.zeros(problem.track_ids.size, dtype=np.int64)
    for packet in problem.packets:
        last_seen[problem.rows(packet.frame)] = packet.index
    known = _Information(problem)
    covs, errors = [], []
    for packet in problem.packets:
        if packet.motion is not None:
            known.predict(packet)
        known.update(packet.frame, problem.states[packet.index].T_world_imu)
        cov, mean = known.state()
        covs.append(cov)
        errors.append(-mean)
        known.forget(np.asarray(last_seen <= packet.index))
    return Efficient(problem.prior.layout, np.array(covs), np.array(errors))


class _Information:
    """The information matrix and vector of the state's and the landmarks' offsets from the truth, the state first."""

    def __init__(self, problem: _Problem) -> None:
        self._problem, self._size = problem, problem.prior.layout.size
        self._matrix = np.asarray(np.linalg.inv(problem.prior.cov))
        self._vector: Array = self._matrix @ problem.states[0].error_to(problem.prior)
        self._landmarks = np.empty(0, dtype=np.int64)  # rows of the problem's landmarks

    def predict(self, packet: Packet) -> None:
        """Add the next state by the measured motion, and marginalise the one before it."""
        problem, d, k = self._problem, self._size, packet.index
        assert packet.motion is not None
        before, now = problem.states[k - 1], problem.states[k]
        increment = problem.model.integrate(packet.motion, before.bias)
        prediction = increment.predict(before)
        # Linearised at the true end, not at the predicted one, so that unobservable directions gain no information.
        at_truth = prediction._replace(T_world_imu=now.T_world_imu, v_world=now.v_world)
        transition, precision = increment.transition_between(before, at_truth), np.linalg.inv(prediction.noise)
        # By the measured motion the next state's offset is F x + r plus noise.
        r = now.error_to(before.predicted(prediction))
        weighted = transition.T @ precision
        to_next = np.concatenate([-weighted, self._matrix[:d, d:]], axis=1)
        score = self._vector[:d] - weighted @ r
        gain = np.linalg.solve(self._matrix[:d, :d] + weighted @ transition, np.column_stack([to_next, score]))
        self._matrix[:d], self._matrix[:, :d], self._matrix[:d, :d] = 0.0, 0.0, precision
        self._matrix -= to_next.T @ gain[:, :-1]
        self._vector = np.concatenate([precision @ r, self._vector[d:]]) - to_next.T @ gain[:, -1]

    def update(self, frame: StereoFrame, T_world_imu: Array) -> None:
        """Add the sightings of a frame; landmarks seen for the first time are added to the state."""
        problem, rows = self._problem, self._problem.rows(frame)
        self._join(rows[~np.isin(rows, self._landmarks)])
        seen = stereo.predict(problem.points[rows], T_world_imu, problem.rig)
        whitener = stereo.whitener(frame.uvs_px, problem.rig)
        root = float(np.sqrt(problem.rig.track_weight))
        H = root * np.concatenate([whitener @ seen.d_uv_d_pose, whitener @ seen.d_uv_d_point], axis=2)
        residuals = root * stereo.whitened_residuals(frame.uvs_px, seen.uv_px, problem.rig)
        place = np.argsort(self._landmarks)[np.searchsorted(np.sort(self._landmarks), rows)]
        own = self._size + 3 * place[:, None] + np.arange(3)
        columns = np.concatenate([np.broadcast_to(np.arange(6), (len(rows), 6)), own], axis=1)
        H_transposed = np.swapaxes(H, 1, 2)
        np.add.at(self._matrix, (columns[:, :, None], columns[:, None, :]), H_transposed @ H)
        np.add.at(self._vector, columns, (H_transposed @ residuals[..., None])[..., 0])

    def state(self) -> tuple[Array, Array]:
        """Return the covariance (d, d) and the mean (d,) of the state's offset."""
        d = self._size
        inner = np.linalg.solve(self._matrix[d:, d:], np.column_stack([self._matrix[d:, :d], self._vector[d:]]))
        cov = np.linalg.inv(self._matrix[:d, :d] - self._matrix[:d, d:] @ inner[:, :d])
        return 0.5 * (cov + cov.T), cov @ (self._vector[:d] - self._matrix[:d, d:] @ inner[:, d])

    def forget(self, gone: BoolArray) -> None:
        """Marginalise landmarks that are not seen again: ``gone`` (M,) masks the problem's landmarks."""
        leaving = gone[self._landmarks]
        if not leaving.any():
            return
        out = np.concatenate([np.zeros(self._size, dtype=bool), np.repeat(leaving, 3)])
        across = self._matrix[np.ix_(out, ~out)]
        gain = np.linalg.solve(self._matrix[np.ix_(out, out)], np.column_stack([across, self._vector[out]]))
        self._matrix = self._matrix[np.ix_(~out, ~out)] - across.T @ gain[:, :-1]
        self._vector = self._vector[~out] - across.T @ gain[:, -1]
        self._landmarks = self._landmarks[~leaving]

    def _join(self, rows: IntArray) -> None:
        full_size = len(self._matrix) + 3 * len(rows)
        matrix, vector = np.zeros((full_size, full_size)), np.zeros(full_size)
        matrix[: len(self._matrix), : len(self._matrix)], vector[: len(self._vector)] = self._matrix, self._vector
        self._matrix, self._vector = matrix, vector
        self._landmarks = np.concatenate([self._landmarks, rows])


def _final(problem: _Problem) -> Efficient:
    """Solve the whole graph linearised at the truth."""
    model, values = problem.model, gtsam.Values()
    graph = model.hold(problem.prior, 0)
    maker = StereoFactors(problem.rig)
    for packet, state in zip(problem.packets, problem.states, strict=True):
        model.insert(values, state.estimate(packet.frame.t_ns), packet.index)
        if packet.motion is not None:
            bias = problem.states[packet.index - 1].bias
            graph.push_back(model.integrate(packet.motion, bias).factors(packet.index))
        for factor in maker.of(packet.frame, packet.index):
            graph.add(factor)
    for track_id, point in zip(problem.track_ids.tolist(), problem.points, strict=True):
        values.insert(L(track_id), point)
    linear = graph.linearize(values)
    poses = np.stack([state.T_world_imu for state in problem.states])
    covs = state_covs(linear, model, poses)
    moved = values.retract(linear.optimize())
    errors = [state.at(model.read(moved, k, 0)).error_to(state) for k, state in enumerate(problem.states)]
    return Efficient(problem.prior.layout, covs, np.array(errors))
