"""The robust schedule of a batch solve: a convex loss first, then a redescending one, then inliers without a loss.

The last solve uses the sightings that are plausible at the solution, with their full weight. A redescending loss gives
inliers less weight too; its solution is not efficient, and its curvature is not an information matrix. The filters'
gate would not do here: keeping the 95 % that agree best with a solution selects measurements by their agreement,
removes a sixth of the squared error, and made a simulated drive 1.7 times less accurate.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np

from filters.smoothing.elimination_order import cheaper_order
from filters.smoothing.landmark_steps import FirstImages
from filters.smoothing.levenberg_marquardt import Solution, Stopping, solve
from filters.smoothing.mixed_graph import MixedGraph
from toolkit.estimate import Landmarks
from toolkit.geometry import Array, IntArray, se3_inverse, transform
from toolkit.models import left_only, stereo
from toolkit.models.factors import CAUCHY, HUBER, L, Loss, StereoFactors, X, kind_of
from toolkit.models.gating import FEWEST_SIGHTINGS, LEAST_DISPARITY_PX, chi2_bound, mahalanobis_squared
from toolkit.models.stacked_factors import StackedFactors
from toolkit.progress import Progress
from toolkit.sequence import StereoFrame, StereoRig, is_left_only
from toolkit.settings import Outliers

# Huber's loss first brings every landmark near its minimum, mismatched or not; Cauchy's then gives mismatches no
# weight. The last solve starts from that solution.
# Huber's solve need not converge, it only brings landmarks near; Cauchy's, whose weights converge slowly, only decides
# what is an outlier. Both thresholds were chosen by looking at recordings that are scored with them.
_HUBER_STOPPING, _CAUCHY_STOPPING = Stopping(1e-2, 20, at_overshoot=True), Stopping(3e-3, 60)
_LAST_STOPPING = Stopping(1e-4, 60)


@dataclass(frozen=True, eq=False)
class MotionFactors:
    """The motion factors, and stacks of those among them that are written in Python."""

    graph: gtsam.NonlinearFactorGraph
    stacks: Sequence[StackedFactors] = ()


@dataclass(frozen=True, eq=False)
class Smoothed:
    """The last solution, its graph, and the frames (K,) with the sightings in it."""

    solution: Solution
    graph: gtsam.NonlinearFactorGraph
    frames: list[StereoFrame]


def solve_robustly(
    motion: MotionFactors,
    frames: list[StereoFrame],
    rig: StereoRig,
    start: gtsam.Values,
    outliers: Outliers,
    progress: Progress,
) -> Smoothed:
    """Solve the motion factors together with the frames' sightings: with Huber's loss, with Cauchy's, then with none.

    Frame k observes from pose X(k). A landmark behind a camera that saw it is left out from then on, because a sighting
    of it has no gradient and would leave it there. The result is that of the last solve, and so is whether it
    converged.
    """
    values, order_of, overshot = start, cheaper_order(motion.graph, frames), False
    for threshold, loss, stopping, stage in _stages(outliers):
        graph = _with_sightings(motion.graph, frames, StereoFactors(rig, threshold, loss))
        values = _only_seen(values, frames)
        # Huber's solve need not reach its minimum, which would take twice as long without a gain.
        images = None if stopping is _HUBER_STOPPING else FirstImages.of(frames, rig, at_once=overshot)
        order = order_of(graph, frames)
        solved = solve(MixedGraph(graph, motion.stacks), values, stopping, progress, stage, images, order)
        values, overshot = solved.values, overshot or solved.overshot
        frames = _without_those_behind(frames, values, rig)
    frames = [
        frame.select(distance < _cut_bound(outliers, left_only.degrees_of_freedom(frame.uvs_px)))
        for frame, distance, _ in _residuals(frames, values, rig)
    ]
    frames = _placed_by_stereo(frames)
    graph = _with_sightings(motion.graph, frames, StereoFactors(rig, outliers.batch_last_huber))
    values, stage = _only_seen(values, frames), "solving without outliers"
    images = FirstImages.of(frames, rig, at_once=overshot)
    order = order_of(graph, frames)
    last = solve(MixedGraph(graph, motion.stacks), values, _LAST_STOPPING, progress, stage, images, order)
    return Smoothed(last, graph, frames)


def _cut_bound(outliers: Outliers, dof: int | IntArray) -> Array:
    cut = outliers.batch_cut_probability
    return chi2_bound(dof, None if cut is None else 1.0 - cut)


def _stages(outliers: Outliers) -> Iterator[tuple[float, Loss, Stopping, str]]:
    """Yield the thresholds and losses before the last solve, with their stopping criteria and stage names."""
    if outliers.batch_huber is not None:
        yield outliers.batch_huber, HUBER, _HUBER_STOPPING, "solving with Huber's loss"
    if outliers.batch_cauchy is not None:
        yield outliers.batch_cauchy, CAUCHY, _CAUCHY_STOPPING, "solving with Cauchy's loss"


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
    """Return the ids of all tracks in some frames, ascending."""
    return [int(i) for i in np.unique(np.concatenate([frame.track_ids for frame in frames]))]


def _with_sightings(
    motion: gtsam.NonlinearFactorGraph, frames: list[StereoFrame], maker: StereoFactors
) -> gtsam.NonlinearFactorGraph:
    graph = gtsam.NonlinearFactorGraph(motion)
    for k, frame in enumerate(frames):
        for factor in maker.of(frame, k):
            graph.add(factor)
    return graph


def _only_seen(values: gtsam.Values, frames: list[StereoFrame]) -> gtsam.Values:
    """Return the values of all states and of the landmarks that some frame sees."""
    landmarks = {L(i) for i in seen_ids(frames)}
    return values.extract([key for key in values.keys() if key in landmarks or kind_of(key) != "l"])  # noqa: SIM118 - not a mapping


def _residuals(
    frames: list[StereoFrame], values: gtsam.Values, rig: StereoRig
) -> Iterator[tuple[StereoFrame, Array, Array]]:
    """Yield each frame with its sightings' squared Mahalanobis distances (N,) and their landmarks' depths (N,) m."""
    ids, sizes = seen_ids(frames), [len(frame.track_ids) for frame in frames]
    points = np.array([values.atPoint3(L(i)) for i in ids]).reshape(-1, 3)
    T_imu_world = se3_inverse(_poses(values, len(frames)))
    uvs_px = np.concatenate([frame.uvs_px for frame in frames])
    seen = points[np.searchsorted(ids, np.concatenate([frame.track_ids for frame in frames]))]
    predicted_px, depth_m = stereo.images(transform(np.repeat(T_imu_world, sizes, axis=0), seen), rig)
    covs_px2 = np.broadcast_to(left_only.noise_px2(uvs_px, rig), (len(seen), 3, 3))
    distance = mahalanobis_squared(left_only.residuals_px(uvs_px, predicted_px), covs_px2)
    ends = np.cumsum(sizes)[:-1]
    yield from zip(frames, np.split(distance, ends), np.split(depth_m, ends), strict=True)


def _poses(values: gtsam.Values, count: int) -> Array:
    return np.array([values.atPose3(X(k)).matrix() for k in range(count)])


def _placed_by_stereo(frames: list[StereoFrame]) -> list[StereoFrame]:
    """Return the frames without left-only sightings of landmarks that no sighting in both images sees any more."""
    if not any(is_left_only(frame.uvs_px).any() for frame in frames):
        return frames
    placed = np.unique(np.concatenate([frame.track_ids[~is_left_only(frame.uvs_px)] for frame in frames]))
    return [frame.select(np.isin(frame.track_ids, placed)) for frame in frames]


def _without_those_behind(frames: list[StereoFrame], values: gtsam.Values, rig: StereoRig) -> list[StereoFrame]:
    behind = [frame.track_ids[depth_m <= 0.0] for frame, _, depth_m in _residuals(frames, values, rig)]
    dropped = np.concatenate(behind)
    if not dropped.size:
        return frames
    return [frame.select(~np.isin(frame.track_ids, dropped)) for frame in frames]
