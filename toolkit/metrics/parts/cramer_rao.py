"""The Cramér-Rao bound of a recording, and the estimate that attains it, at every frame.

No unbiased estimator has a smaller covariance than the inverse of Fisher's information (Van Trees, "Detection,
estimation and modulation theory", part I, 1968, section 2.4). For Gaussian measurements that is the information of all
factors linearised at the truth: the factors, the noise, the prior and the tracks are those the estimators have. No
estimator is used to compute it: for the causal bound the factors are added frame by frame, and all but the state and
the landmarks that are still to be seen is marginalised (Tichavsky, Muravchik & Nehorai 1998, "Posterior Cramér-Rao
bounds for discrete-time nonlinear filtering"), for the final one the whole graph is eliminated.

The efficient estimate attains the bound: it is one linear step from the truth on the same measurements. The error of
any unbiased estimator is that of the efficient one plus an uncorrelated part. The difference of both errors is
therefore the estimator's own loss, without the noise that both share.

This needs an exact truth with every state: the motion measured between its states must differ from them by as much as
the stated noise. Where a recording has no such truth, the bound that the model claims is computed at an estimate of the
states.
"""

from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import gtsam
import numpy as np

from toolkit.answers import Output
from toolkit.arrays import rows_of
from toolkit.estimate import Trajectory
from toolkit.geometry import Array, IntArray
from toolkit.initialization import start_from_measurements
from toolkit.measurements import Packet, Prior, StereoFrame, StereoRig, is_left_only
from toolkit.metrics.parts.consistency import starts_in_the_truths_world
from toolkit.metrics.parts.evaluation import place_first
from toolkit.metrics.parts.scores import Unavailable
from toolkit.models import stereo
from toolkit.models.factors import StereoFactors, landmark_keys, ordering_of
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
    """Return the bound (K, d, d) that the model claims at estimated states; raise Unavailable if a frame has none."""
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

    @cached_property
    def values(self) -> gtsam.Values:
        values = gtsam.Values()
        for k, state in enumerate(self.states):
            self.model.insert(values, state.estimate(0), k)
        for key, point in zip(landmark_keys(self.track_ids.tolist()), self.points, strict=True):
            values.insert(key, point)
        return values

    @cached_property
    def frames(self) -> tuple[gtsam.GaussianFactorGraph, ...]:
        """What each frame adds, linearised: the prior or the motion since the frame before, and its sightings."""
        maker, frames = StereoFactors(self.rig), []
        for k, packet in enumerate(self.packets):
            if packet.motion is None:
                graph = self.model.hold(self.prior, 0)
            else:
                graph = self.model.integrate(packet.motion, self.states[k - 1].bias).factors(k)
            for factor in maker.of(packet.frame, k):
                graph.add(factor)
            frames.append(graph.linearize(self.values.extract(list(graph.keyVector()))))
        return tuple(frames)

    def error(self, k: int, moved: gtsam.Values) -> Array:
        """Return the error (d,) of state k of other values: its difference to the true one."""
        return self.states[k].at(self.model.read(moved, k, 0)).error_to(self.states[k])


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
    if prior is None:
        # As estimators start by default, placed at the first pose as their outputs are: with an IMU the tilt of the
        # start is measured and stays, without one the whole pose is free.
        measured = start_from_measurements(sequence)
        placement = place_first(poses[0], measured.T_world_imu, sequence.motion_kind == "imu")
        T_world_imu = placement.apply(measured.T_world_imu[None])[0]
        v_start = T_world_imu[:3, :3] @ measured.T_world_imu[:3, :3].T @ measured.v_world
        prior = replace(measured, T_world_imu=T_world_imu, v_world=v_start)
    start = model.initial_belief(prior)
    states = tuple(Belief(start.layout, *state, start.cov) for state in zip(poses, v_world, bias, strict=True))
    packets, track_ids, points = _without_mismatches(tuple(sequence.packets()), poses, sequence.rig)
    return _Problem(sequence.rig, model, start, states, packets, track_ids, points)


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
        points = problem.points[np.searchsorted(problem.track_ids, packet.frame.track_ids)]
        seen = stereo.predict(points, state.T_world_imu, problem.rig)
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
    """Add what each frame tells, and marginalise what no later frame concerns."""
    model, sizes = problem.model, problem.values.dims()
    last = {key: k for k, frame in enumerate(problem.frames) for key in frame.keyVector()}
    known, information, vector = list[int](), np.zeros((0, 0)), np.zeros(0)
    covs, errors = [], []
    for k, frame in enumerate(problem.frames):
        seen, own = list(frame.keyVector()), model.keys(k)
        known += sorted(set(seen).difference(known))
        rows = _rows(known, sizes)
        added = sum(sizes[key] for key in known) - len(vector)
        information, vector = np.pad(information, (0, added)), np.pad(vector, (0, added))
        of_frame, to_frame = frame.hessian(ordering_of(seen))
        here = np.concatenate([rows[key] for key in seen])
        information[np.ix_(here, here)] += of_frame
        vector[here] += to_frame
        of_state, to_state = _marginal(information, vector, np.concatenate([rows[key] for key in own]))
        cov, delta = np.asarray(np.linalg.inv(of_state)), gtsam.VectorValues()
        for key, at in _rows(own, sizes).items():
            delta.insert(key, cov[at] @ to_state)
        covs.append(model.estimate_cov(cov, problem.states[k].T_world_imu[:3, :3]))
        errors.append(problem.error(k, problem.values.extract(own).retract(delta)))
        known = [key for key in known if last[key] > k]
        if known:
            information, vector = _marginal(information, vector, np.concatenate([rows[key] for key in known]))
    return Efficient(problem.prior.layout, np.array(covs), np.array(errors))


def _rows(keys: list[int], sizes: dict[int, int]) -> dict[int, IntArray]:
    """Return the rows of each variable, stacked in the order of the keys."""
    ends = np.cumsum([sizes[key] for key in keys])
    return {key: np.arange(end - sizes[key], end) for key, end in zip(keys, ends, strict=True)}


def _marginal(information: Array, vector: Array, rows: IntArray) -> tuple[Array, Array]:
    """Return the information matrix and vector of some rows (m,), all others marginalised."""
    out = np.setdiff1d(np.arange(len(vector)), rows)
    across = information[np.ix_(out, rows)]
    gain = np.linalg.solve(information[np.ix_(out, out)], np.column_stack([across, vector[out]]))
    left = information[np.ix_(rows, rows)] - across.T @ gain[:, :-1]
    return 0.5 * (left + left.T), vector[rows] - across.T @ gain[:, -1]


def _final(problem: _Problem) -> Efficient:
    linear = gtsam.GaussianFactorGraph()
    for frame in problem.frames:
        linear.push_back(frame)
    covs = state_covs(linear, problem.model, np.stack([state.T_world_imu for state in problem.states]))
    moved = problem.values.retract(linear.optimize())
    errors = [problem.error(k, moved) for k in range(len(problem.states))]
    return Efficient(problem.prior.layout, covs, np.array(errors))
