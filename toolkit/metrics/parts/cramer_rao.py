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

from dataclasses import dataclass
from functools import lru_cache

import gtsam
import numpy as np

from toolkit.arrays import rows_of
from toolkit.estimate import Output, Trajectory
from toolkit.geometry import Array
from toolkit.initialization import start_from_measurements
from toolkit.metrics.parts.alignment import place_first
from toolkit.metrics.parts.consistency import starts_in_the_truths_world
from toolkit.metrics.parts.information_filter import InformationFilter, LinearisedProblem
from toolkit.metrics.parts.scores import Unavailable
from toolkit.metrics.parts.sound_sightings import SightingNoise, without_mismatches
from toolkit.models import left_only
from toolkit.models.factors import L, StereoFactors, X, linear_factor
from toolkit.models.motion import motion_model
from toolkit.models.state import Belief, Layout
from toolkit.models.state_covariances import state_covs
from toolkit.sequence import Prior, Sequence

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


def _efficient(problem: LinearisedProblem, output: Output) -> Efficient:
    try:
        return _causal(problem) if output == "causal" else _final(problem)
    except (np.linalg.LinAlgError, RuntimeError) as error:  # GTSAM's
        raise Unavailable("the measurements do not determine every state, as it is linearised") from error


@lru_cache(maxsize=1)
def _problem_at_truth(sequence: Sequence) -> LinearisedProblem:
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
def _problem_at_estimate(sequence: Sequence, at: Trajectory) -> LinearisedProblem:
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


def _problem(sequence: Sequence, prior: Prior | None, poses: Array, v_world: Array, bias: Array) -> LinearisedProblem:
    """Return the problem about states (K, 4, 4), (K, 3), (K, 6), from the given prior or the measured start."""
    model = motion_model(sequence.noise, sequence.gravity_world)
    start = model.initial_belief(_measured_start(sequence, poses[0]) if prior is None else prior)
    states = tuple(Belief(start.layout, *state, start.cov) for state in zip(poses, v_world, bias, strict=True))
    sound = without_mismatches(tuple(sequence.packets()), poses, SightingNoise.of(sequence.rig))
    return LinearisedProblem(model, start, states, *sound)


def _measured_start(sequence: Sequence, first_pose: Array) -> Prior:
    """Return the state that estimators start from by default, placed at the first pose (4, 4) as their outputs are.

    With an IMU its tilt is measured and stays; without one it is the whole pose.
    """
    start = start_from_measurements(sequence)
    placement = place_first(first_pose, start.T_world_imu, sequence.motion_kind == "imu")
    T_world_imu = placement.apply(start.T_world_imu[None])[0]
    v_world = T_world_imu[:3, :3] @ start.T_world_imu[:3, :3].T @ start.v_world
    return Prior(T_world_imu, v_world, start.bias, start.cov, start.source)


def _motion_chi_square(problem: LinearisedProblem) -> float:
    """Return the mean squared distance of the true steps from the measured motion, over its degrees of freedom."""
    distances = []
    for before, packet in zip(problem.states, problem.packets[1:], strict=False):
        assert packet.motion is not None
        prediction = problem.model.integrate(packet.motion, before.bias).predict(before)
        error = before.predicted(prediction).error_to(problem.states[packet.index])
        distances.append(float(error @ np.linalg.solve(prediction.noise, error)) / error.size)
    return float(np.mean(distances)) if distances else 1.0


def _sighting_chi_square(problem: LinearisedProblem) -> tuple[float, float]:
    """Return the mean squared residual of sightings at true poses, and five standard deviations of it by chance.

    It is over the degrees of freedom that the landmarks, fitted to them, leave; 1 where there are none.
    """
    sightings = problem.sightings
    residuals = sightings.residuals(sightings.predict(problem.points, problem.poses).uv_px)
    squared = float(np.square(sightings.all_decorrelated(residuals[..., None])).sum())
    measured = np.broadcast_to(left_only.degrees_of_freedom(sightings.uvs_px), len(residuals))
    dof = int(measured.sum()) - 3 * sightings.track_ids.size
    return (squared / dof, 5.0 * float(np.sqrt(2.0 / dof))) if dof > 0 else (1.0, 0.0)


def _causal(problem: LinearisedProblem) -> Efficient:
    """Propagate the information of state and landmarks; a landmark is marginalised after its last sighting."""
    last_seen = np.zeros(problem.sightings.track_ids.size, dtype=np.int64)
    for packet in problem.packets:
        last_seen[problem.rows(packet.frame)] = packet.index
    known = InformationFilter(problem)
    covs, errors = [], []
    for packet in problem.packets:
        known.step(packet)
        cov, mean = known.state()
        covs.append(cov)
        errors.append(-mean)
        known.forget(np.asarray(last_seen <= packet.index))
    return Efficient(problem.prior.layout, np.array(covs), np.array(errors))


def _final(problem: LinearisedProblem) -> Efficient:
    """Solve the whole graph linearised at the truth."""
    model, values = problem.model, gtsam.Values()
    graph = model.hold(problem.prior, 0)
    for packet, state in zip(problem.packets, problem.states, strict=True):
        model.insert(values, state.estimate(packet.frame.t_ns), packet.index)
        if packet.motion is not None:
            bias = problem.states[packet.index - 1].bias
            graph.push_back(model.integrate(packet.motion, bias).factors(packet.index))
    for track_id, point in zip(problem.sightings.track_ids.tolist(), problem.points, strict=True):
        values.insert(L(track_id), point)
    correlated = problem.sightings.noise.of_tracks is not None
    if not correlated:
        _add_sightings(graph, problem)
    linear = graph.linearize(values)
    if correlated:
        _add_tracks(linear, problem)
    covs = state_covs(linear, model, problem.poses)
    moved = values.retract(linear.optimize())
    errors = [state.at(model.read(moved, k, 0)).error_to(state) for k, state in enumerate(problem.states)]
    return Efficient(problem.prior.layout, covs, np.array(errors))


def _add_sightings(graph: gtsam.NonlinearFactorGraph, problem: LinearisedProblem) -> None:
    """Add a factor of each sighting, whose errors are independent."""
    maker = StereoFactors(problem.sightings.noise.rig)
    for packet in problem.packets:
        for factor in maker.of(packet.frame, packet.index):
            graph.add(factor)


def _add_tracks(linear: gtsam.GaussianFactorGraph, problem: LinearisedProblem) -> None:
    """Add a factor of each track, whose errors are correlated, on its landmark and all poses that see it."""
    sightings = problem.sightings
    seen = sightings.predict(problem.points, problem.poses)
    by_pose, by_point = sightings.jacobian(seen.d_uv_d_pose), sightings.jacobian(seen.d_uv_d_point)
    residuals = sightings.residuals(seen.uv_px)
    for track, rows in enumerate(sightings.of_each_track):
        root = sightings.decorrelated(track, np.eye(residuals[rows].size))
        poses = zip(sightings.frame[rows].tolist(), np.hsplit(root, len(residuals[rows])), by_pose[rows], strict=True)
        terms = [(X(k), own @ jacobian) for k, own, jacobian in poses]
        landmark = L(int(sightings.track_ids[track])), root @ by_point[rows].reshape(-1, 3)
        linear.add(linear_factor([landmark, *terms], root @ residuals[rows].ravel()))
