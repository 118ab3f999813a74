"""Tracks with a reduced weight in smoothers, and the residuals along them from which the weight is estimated.

Outliers are still decided by the stated noise, so the threshold of a loss stays the same in pixels. How the weight is
estimated, and why: :mod:`filters.kalman.residual_correlation`.
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
    """A rig whose noise gives sightings a share of their information, and the threshold of Huber's loss for it."""

    rig: StereoRig
    huber: float | None


def discounted(rig: StereoRig, huber: float | None, share: float) -> Discounted:
    """Return the rig and the loss threshold that give sightings a share in (0, 1] of their information.

    Whitened residuals become smaller by the root of the share, and so must the loss's threshold (in sigma; None for no
    loss).
    """
    if share == 1.0:
        return Discounted(rig, huber)
    threshold = None if huber is None else huber * float(np.sqrt(share))
    return Discounted(replace(rig, cov_uv_px2=rig.cov_uv_px2 / share), threshold)


def discounted_past(
    graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, share: float
) -> gtsam.NonlinearFactorGraph:
    """Return a window's graph whose marginals have a share in (0, 1] of their information on landmarks.

    The marginal of variables that have left is a density of states times one of landmarks given these states. The
    second comes from sightings alone, so its information is multiplied by the share. The density of states is kept,
    because motion contributes most or part of it. ``values`` are of all variables of the graph.
    """
    made = gtsam.NonlinearFactorGraph()
    for factor in (graph.at(i) for i in range(graph.size())):
        is_linear = isinstance(factor, gtsam.LinearContainerFactor)
        made.add(_discounted_marginal(factor, values, share) if is_linear else factor)
    return made


def _discounted_marginal(
    factor: gtsam.NonlinearFactor, values: gtsam.Values, share: float
) -> gtsam.LinearContainerFactor:
    """Eliminate the landmarks first: their rows are the conditional density, those below involve states alone."""
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
    """The weight of a smoother's sightings, estimated from those of earlier frames, or from all.

    With odometry the weight follows from the correlation along tracks and among neighbours; with an IMU also from the
    tracks' scores for a drift. The noise of odometry is stated, or estimated from its scatter, as white, which does not
    cover lasting errors such as a wrong wheel radius. If tracks had no more weight than their scores allow, the drift
    would follow these errors.
    """

    def __init__(self, setup: Setup) -> None:
        self._setup = setup
        self._rig, self._huber = setup.rig, setup.settings.outliers.smoother_huber
        self._correlation = ResidualCorrelation.of(setup)
        self._beside_imu = setup.motion_kind == "imu"

    @property
    def share(self) -> float:
        """Return the present weight of a sighting, a factor in (0, 1] on its information."""
        return self._correlation.share

    @property
    def now(self) -> Discounted:
        """Return the rig and the loss threshold that give sightings this weight."""
        return discounted(self._rig, self._huber, self.share)

    @property
    def messages(self) -> tuple[str, ...]:
        """Return one log line if tracks have less than their full weight, else nothing."""
        return self._correlation.messages

    def learn(self, frames: list[StereoFrame], T_world_imu: Array, points: Mapping[int, Array]) -> None:
        """Add residuals of points (3,) m in the first of two frames and in the second, from poses (2, 4, 4)."""
        if self._correlation.matches:
            left = residuals_of(frames, T_world_imu, points, self._rig)
            self._learn(left, left.select(left.frames == 0))
            self.settle(frames[0], T_world_imu[0])

    def learn_from_all(self, frames: list[StereoFrame], T_world_imu: Array, points: Mapping[int, Array]) -> None:
        """Add residuals of points (3,) m in all frames, at the final poses (K, 4, 4)."""
        if not self._correlation.matches:
            return
        left = residuals_of(frames, T_world_imu, points, self._rig)
        self._learn(left, left)
        for frame, pose in zip(frames, T_world_imu, strict=True):
            self.settle(frame, pose)
        self._correlation.settle_last()

    def relearned(
        self, frames: list[StereoFrame], T_world_imu: Array, points: Mapping[int, Array]
    ) -> "DiscountedTracks":
        """Return the weight measured from nothing but residuals of points (3,) m at the final poses (K, 4, 4)."""
        anew = DiscountedTracks(self._setup)
        anew.learn_from_all(frames, T_world_imu, points)
        return anew

    def settle(self, frame: StereoFrame, T_world_imu: Array) -> None:
        """Add the next frame whose pose (4, 4) will hardly change any more."""
        if self._beside_imu:
            self._correlation.settle(frame, T_world_imu)

    def learn_from(self, sightings: Sightings, T_world_imu: Array, points: Array) -> None:
        """Add sightings, with the rows of their poses in (K, 4, 4) and of their points in (M, 3) m."""
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
    """Return the ids of tracks with enough sightings that the fitted landmark does not absorb their residuals."""
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
        """Return some rows (N,)."""
        tracks, frames, uvs_px, whitened, H_pose = self
        return Residuals(tracks[rows], frames[rows], uvs_px[rows], whitened[rows], H_pose[rows])

    @property
    def sound(self) -> "Residuals":
        """Return the residuals that are not outliers by the stated noise."""
        return self.select(np.square(self.whitened).sum(axis=1) < chi2_bound(3, SOUND))

    def successive(self) -> tuple[Array, Array]:
        """Return the residuals (n, 3) whose track is also seen one frame later, and those of that frame (n, 3)."""
        order = np.lexsort((self.frames, self.tracks))
        before, after = order[:-1], order[1:]
        pairs = (self.tracks[before] == self.tracks[after]) & (self.frames[after] == self.frames[before] + 1)
        return self.whitened[before[pairs]], self.whitened[after[pairs]]


def residuals_of(
    frames: list[StereoFrame], T_world_imu: Array, points: Mapping[int, Array], rig: StereoRig
) -> Residuals:
    """Return the residuals of points (3,) m in frames from poses (K, 4, 4), outliers left out."""
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
