"""Tracks that count for a share of their information in smoothers, and the residuals along them that tell it.

What is an outlier stays a matter of the stated noise, so a loss has its threshold in pixels where it was. Which share,
and why: :mod:`filters.kalman.residual_correlation`.
"""

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import NamedTuple

import gtsam
import numpy as np

from filters.kalman.residual_correlation import ResidualCorrelation
from filters.kalman.track_scores import FEWEST_SIGHTINGS, SOUND
from filters.smoothing.smart_factors import Sightings
from toolkit.estimator import Setup
from toolkit.geometry import Array, BoolArray, IntArray, se3_inverse, transform
from toolkit.models import left_only, stereo
from toolkit.models.factors import kind_of, linear_factor
from toolkit.models.gating import chi2_bound
from toolkit.sequence import StereoFrame, StereoRig


class Discounted(NamedTuple):
    """A rig whose sightings count for a share of their information, and the threshold of Huber's loss beside it."""

    rig: StereoRig
    huber: float | None


def discounted(rig: StereoRig, huber: float | None, share: float) -> Discounted:
    """Return the rig and the threshold (in sigma, None for no loss) with which sightings count for a share in (0, 1].

    The loss is of residuals in sigma, which become smaller by the root of the share: so does its threshold.
    """
    if share == 1.0:
        return Discounted(rig, huber)
    threshold = None if huber is None else huber * float(np.sqrt(share))
    return Discounted(replace(rig, cov_uv_px2=rig.cov_uv_px2 / share), threshold)


def discounted_past(
    graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, share: float
) -> gtsam.NonlinearFactorGraph:
    """Return the graph of a window whose landmarks owe what has left it a share in (0, 1] of its information.

    The marginals of what has left are densities of states times those of landmarks given these states. The second come
    of sightings alone: their information is what is multiplied. What is known of states stays, for motion tells most of
    it or part. ``values`` are of all variables of the graph.
    """
    made = gtsam.NonlinearFactorGraph()
    for factor in (graph.at(i) for i in range(graph.size())):
        is_linear = isinstance(factor, gtsam.LinearContainerFactor)
        made.add(_discounted_marginal(factor, values, share) if is_linear else factor)
    return made


def _discounted_marginal(
    factor: gtsam.NonlinearFactor, values: gtsam.Values, share: float
) -> gtsam.LinearContainerFactor:
    """Eliminate the landmarks first: their rows are the conditional density, and all below concern states alone."""
    jacobian, residual = factor.linearize(values).jacobian()
    sizes = {key: values.extract([key]).dim() for key in factor.keys()}  # noqa: SIM118 - not a mapping
    blocks = dict(zip(sizes, np.split(jacobian, np.cumsum(list(sizes.values()))[:-1], axis=1), strict=True))
    keys = sorted(sizes, key=lambda key: kind_of(key) != "l")
    stacked = np.column_stack([*(blocks[key] for key in keys), residual])
    rows = np.linalg.qr(stacked).R[: sum(sizes.values())]
    rows[: sum(sizes[key] for key in keys if kind_of(key) == "l")] *= np.sqrt(share)
    *columns, residual = np.split(rows, np.cumsum([sizes[key] for key in keys]), axis=1)
    return gtsam.LinearContainerFactor(linear_factor(list(zip(keys, columns, strict=True)), residual[:, 0]), values)


class DiscountedTracks:
    """What the sightings of a smoother count for, by those of earlier frames, or by all.

    Beside odometry that is what the correlation along tracks and among neighbours leaves, beside an IMU also what they
    tell of a drift. Odometry's noise is stated, or found in its scatter, as white, which says nothing of errors that
    last, such as a wrong radius of the wheels: tracks that count for no more than they tell of a drift leave the drift
    to it.
    """

    def __init__(self, setup: Setup) -> None:
        self._rig, self._huber = setup.rig, setup.settings.outliers.smoother_huber
        self._correlation = ResidualCorrelation.of(setup)
        self._beside_imu = setup.motion_kind == "imu"

    @property
    def share(self) -> float:
        """Return the share of its information that a sighting counts for now."""
        return self._correlation.share

    @property
    def now(self) -> Discounted:
        """Return the rig and the loss that give sightings this share."""
        return discounted(self._rig, self._huber, self.share)

    @property
    def messages(self) -> tuple[str, ...]:
        """Return what a user should know, a line, where tracks do not count in full."""
        return self._correlation.messages

    def learn(self, frames: list[StereoFrame], T_world_imu: Array, points: Mapping[int, Array]) -> None:
        """Take in what the first of two frames saw of points (3,) m, beside the second one, from poses (2, 4, 4)."""
        if self._correlation.matches:
            left = residuals_of(frames, T_world_imu, points, self._rig)
            self._learn(left, left.select(left.frames == 0))
            self.settle(frames[0], T_world_imu[0])

    def learn_from_all(self, frames: list[StereoFrame], T_world_imu: Array, points: Mapping[int, Array]) -> None:
        """Take in what all frames saw of points (3,) m, at the answer for their poses (K, 4, 4)."""
        if not self._correlation.matches:
            return
        left = residuals_of(frames, T_world_imu, points, self._rig)
        self._learn(left, left)
        for frame, pose in zip(frames, T_world_imu, strict=True):
            self.settle(frame, pose)
        self._correlation.settle_last()

    def settle(self, frame: StereoFrame, T_world_imu: Array) -> None:
        """Take in the next frame whose pose (4, 4) will hardly change any more."""
        if self._beside_imu:
            self._correlation.settle(frame, T_world_imu)

    def learn_from(self, sightings: Sightings, T_world_imu: Array, points: Array) -> None:
        """Take in sightings, each by the rows of its pose of (K, 4, 4) and of its point of (M, 3) m."""
        if not self._correlation.matches:
            return
        often = np.bincount(sightings.point, minlength=len(points)) >= FEWEST_SIGHTINGS
        seen = sightings.of_points(np.flatnonzero(often))
        T, uvs_px = T_world_imu[seen.pose], seen.uv_px
        left = Residuals(seen.point, seen.pose, uvs_px, *_whitened(uvs_px, T, points[seen.point], self._rig))
        self._learn(left.sound, left.sound)

    def _learn(self, along_tracks: "Residuals", in_images: "Residuals") -> None:
        self._correlation.add(*along_tracks.successive())
        self._correlation.add_images(in_images.frames, in_images.uvs_px, in_images.whitened, in_images.H_pose)


def seen_often(frames: Iterable[StereoFrame]) -> set[int]:
    """Return the ids of the tracks with sightings enough that their landmarks do not take up all there is."""
    count = Counter[int]()
    for frame in frames:
        count.update(frame.track_ids.tolist())
    return {track_id for track_id, sightings in count.items() if sightings >= FEWEST_SIGHTINGS}


class Residuals(NamedTuple):
    """Whitened residuals (N, 3) of sightings (N, 3) px of tracks (N,) in frames (N,), Jacobians (N, 3, 6) to poses."""

    tracks: IntArray
    frames: IntArray
    uvs_px: Array
    whitened: Array
    H_pose: Array

    def select(self, rows: BoolArray) -> "Residuals":
        """Return some of them (N,)."""
        tracks, frames, uvs_px, whitened, H_pose = self
        return Residuals(tracks[rows], frames[rows], uvs_px[rows], whitened[rows], H_pose[rows])

    @property
    def sound(self) -> "Residuals":
        """Return those that are no outliers by the stated noise."""
        return self.select(np.square(self.whitened).sum(axis=1) < chi2_bound(3, SOUND))

    def successive(self) -> tuple[Array, Array]:
        """Return those (n, 3) of tracks that have one a frame later, and that one (n, 3)."""
        order = np.lexsort((self.frames, self.tracks))
        before, after = order[:-1], order[1:]
        pairs = (self.tracks[before] == self.tracks[after]) & (self.frames[after] == self.frames[before] + 1)
        return self.whitened[before[pairs]], self.whitened[after[pairs]]


def residuals_of(
    frames: list[StereoFrame], T_world_imu: Array, points: Mapping[int, Array], rig: StereoRig
) -> Residuals:
    """Return the residuals of what frames saw of points (3,) m from poses (K, 4, 4), but for outliers."""
    frames = [frame.select(np.array([i in points for i in frame.track_ids.tolist()], dtype=bool)) for frame in frames]
    index = np.repeat(np.arange(len(frames)), [len(frame.track_ids) for frame in frames])
    track_ids = np.concatenate([frame.track_ids for frame in frames])
    uvs_px = np.concatenate([frame.uvs_px for frame in frames])
    seen = np.array([points[i] for i in track_ids.tolist()]).reshape(-1, 3)
    return Residuals(track_ids, index, uvs_px, *_whitened(uvs_px, T_world_imu[index], seen, rig)).sound


def _whitened(uvs_px: Array, T_world_imu: Array, points: Array, rig: StereoRig) -> tuple[Array, Array]:
    """Return the whitened residuals (N, 3) of sightings (N, 3) px of points (N, 3) m, and Jacobians (N, 3, 6) to poses.

    The poses are (N, 4, 4).
    """
    expected = stereo.linearise(transform(se3_inverse(T_world_imu), points), T_world_imu[:, :3, :3], rig)
    jacobians = left_only.whitener(uvs_px, rig) @ left_only.seen_rows(uvs_px, expected.d_uv_d_pose)
    return left_only.whitened_residuals(uvs_px, expected.uv_px, rig), jacobians
