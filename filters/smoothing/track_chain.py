"""Sightings whose errors are correlated along their tracks, as linear factors on two poses and a landmark each.

A sighting's error is predicted from that of the sighting before it (:class:`toolkit.models.correlated_noise.Chain`), so
its innovation is a residual of both poses and of the landmark. GTSAM has no such factor, and a Python factor is slow:
here all of them are evaluated and linearised at once, and take part in a solve by their linearisation. If the values
have a scale of disparities, it is a variable of every sighting, which no factor of GTSAM's has either; independent
sightings are then chains without correlation.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import gtsam
import numpy as np

from filters.smoothing.landmark_steps import LandmarksSeen, LandmarkSteps
from filters.smoothing.robust_loss import Huber, Loss, Squares
from toolkit.geometry import Array, BoolArray, IntArray
from toolkit.models import left_only, stereo
from toolkit.models.correlated_noise import Chain, channels_of, in_channels
from toolkit.models.factors import SCALE, L, X, linear_factor
from toolkit.models.stereo import d_uv_d_scale, scaled_rig
from toolkit.sequence import StereoFrame, StereoRig, is_left_only
from toolkit.track_noise import TrackNoise

# Degrees of freedom of Student's t over tracks, fitted to all real recordings (docs/tracks.md); with Gaussian errors it
# costs a few percent of accuracy.
FREEDOM_OF_TRACKS = 2.0


@dataclass(frozen=True, eq=False)
class ChainedSightings:
    """N sightings: frame and track numbers (N,), (uL, uR, v) (N, 3) px, and the correlation of their errors.

    ``counted`` (N,) says which innovations are used; an outlying one is left out, and the track's error is free to take
    any value from there on. ``track_ids`` (M,) ascending are the tracks; ``channels`` (3, 3), or one each (N, 3, 3),
    maps (uL, uR, v) to channels.
    """

    pose: IntArray
    point: IntArray
    uv_px: Array
    chain: Chain
    counted: BoolArray
    track_ids: IntArray
    channels: Array

    @classmethod
    def of(cls, frames: list[StereoFrame], rig: StereoRig) -> "ChainedSightings":
        """Return the sightings of frames (K,), with the rig's track noise model if it has one."""
        pose = np.repeat(np.arange(len(frames)), [frame.track_ids.size for frame in frames])
        ids, point = np.unique(np.concatenate([frame.track_ids for frame in frames]), return_inverse=True)
        ages, uv_px = np.concatenate([f.ages for f in frames]), np.concatenate([f.uvs_px for f in frames])
        if rig.track_noise is None:
            chain, channels = Chain.without_memory(point.size), left_only.whitener(uv_px, rig)
        else:
            chain, channels = Chain.of(rig.track_noise, point, ages, is_left_only(uv_px)), channels_of(uv_px)
        return cls(pose, point, uv_px, chain, np.ones(pose.size, dtype=bool), ids, channels)

    def places(self, values: gtsam.Values) -> tuple[Array, Array]:
        """Return the poses (N, 4, 4) and points (N, 3) m of the sightings."""
        frames, row = np.unique(self.pose, return_inverse=True)
        poses = np.array([values.atPose3(X(k)).matrix() for k in frames.tolist()]).reshape(-1, 4, 4)
        points = np.array([values.atPoint3(L(i)) for i in self.track_ids.tolist()]).reshape(-1, 3)
        return poses[row], points[self.point]


@dataclass(frozen=True, eq=False)
class SightingRows:
    """N sightings in the order of time: frame number (N,), stamp, track id, (uL, uR, v) (N, 3) px, age.

    ``begins`` (N,) says which were the first of a landmark in the graph.
    """

    pose: IntArray
    t_ns: IntArray
    track_id: IntArray
    uv_px: Array
    age: IntArray
    begins: BoolArray

    @classmethod
    def none(cls) -> "SightingRows":
        """Return no rows."""
        empty = np.empty(0, dtype=np.int64)
        return cls(empty, empty, empty, np.empty((0, 3)), empty, np.empty(0, dtype=bool))

    def followed_by(self, frame: StereoFrame, k: int) -> "SightingRows":
        """Return the rows with those of frame k appended."""
        count = frame.track_ids.size
        return SightingRows(
            np.concatenate([self.pose, np.full(count, k)]),
            np.concatenate([self.t_ns, np.full(count, frame.t_ns)]),
            np.concatenate([self.track_id, frame.track_ids]),
            np.concatenate([self.uv_px, frame.uvs_px]),
            np.concatenate([self.age, frame.ages]),
            np.concatenate([self.begins, ~np.isin(frame.track_ids, self.track_id)]),
        )

    def select(self, rows: BoolArray) -> "SightingRows":
        """Return the rows of a mask (N,)."""
        return SightingRows(*(column[rows] for column in vars(self).values()))

    @classmethod
    def joined(cls, parts: Iterable["SightingRows"]) -> "SightingRows":
        """Return several concatenated."""
        return cls(*map(np.concatenate, zip(*(vars(part).values() for part in parts), strict=True)))

    def keys(self) -> list[int]:
        """Return the keys of the poses and landmarks of all sightings."""
        return [*map(X, np.unique(self.pose).tolist()), *map(L, np.unique(self.track_id).tolist())]

    def chained(self, noise: TrackNoise) -> ChainedSightings:
        """Return all sightings as one chain per track; an innovation is used only if the sighting before it is known.

        The first sighting of a landmark in the graph is used as well.
        """
        ids, point = np.unique(self.track_id, return_inverse=True)
        chain = Chain.of(noise, point.astype(np.int64), self.age, is_left_only(self.uv_px))
        counted = self.begins | (chain.before >= 0)
        channels = channels_of(self.uv_px)
        return ChainedSightings(self.pose, point.astype(np.int64), self.uv_px, chain, counted, ids, channels)


def without_jumps(
    sightings: ChainedSightings, frames: list[StereoFrame], jumped: BoolArray
) -> tuple[ChainedSightings, list[StereoFrame]]:
    """Return the sightings of frames (K,) without the innovations (N,) that jumped, and the frames with those left.

    A track whose first sighting jumped is left out, because the rest of it hardly determines its landmark. So is a
    track that has no sighting in both images left.
    """
    began_with = jumped & (sightings.chain.before < 0)
    kept = ~np.isin(sightings.point, sightings.point[began_with])
    placing = ~jumped & ~is_left_only(sightings.uv_px)
    kept &= np.isin(sightings.point, sightings.point[placing])
    rows = np.split(kept, np.cumsum([frame.track_ids.size for frame in frames])[:-1])
    frames = [frame.select(row) for frame, row in zip(frames, rows, strict=True)]
    tracks, point = np.unique(sightings.point[kept], return_inverse=True)
    left = ChainedSightings(
        sightings.pose[kept],
        point.astype(np.int64),
        sightings.uv_px[kept],
        sightings.chain.of_tracks(kept),
        ~jumped[kept],
        sightings.track_ids[tracks],
        sightings.channels if sightings.channels.ndim == 2 else sightings.channels[kept],
    )
    return left, frames


@dataclass(frozen=True, eq=False)
class ChainedFactors:
    """Evaluates and linearises chained sightings at GTSAM's values, under a loss of the innovations' norms.

    With ``freedom``, the remaining error of a track is Student-t distributed as a whole, with that number of degrees of
    freedom: a track with larger errors than the others throughout, such as one on a vehicle, has a smaller weight
    throughout (Lange, Little & Taylor 1989, "Robust statistical modeling using the t distribution", eq. 3).
    """

    sightings: ChainedSightings
    rig: StereoRig
    loss: Loss
    freedom: float | None = None

    @classmethod
    def of(cls, rows: SightingRows, rig: StereoRig, huber: float | None) -> "ChainedFactors":
        """Return an incremental smoother's factors, with Huber's loss and Student's t over tracks, or with neither.

        The rig must have a track noise model.
        """
        assert rig.track_noise is not None
        sightings = rows.chained(rig.track_noise)
        if huber is None:
            return cls(sightings, rig, Squares())
        return cls(sightings, rig, Huber(huber), FREEDOM_OF_TRACKS)

    def in_front(self, values: gtsam.Values) -> "ChainedFactors":
        """Return the chains without sightings whose landmark is behind their camera or that of the sighting before."""
        seen, in_front = self.sightings, self.predicted(values).depth_m > 0.0
        in_front &= in_front[seen.chain.before] | (seen.chain.before < 0)
        return replace(self, sightings=replace(seen, counted=seen.counted & in_front))

    def with_fixed_weights(self, values: gtsam.Values) -> "ChainedFactors":
        """Return the chains as least squares: each innovation keeps its weight at the values."""
        seen = self.sightings
        sigma_px = seen.chain.sigma_px / np.sqrt(self.weights(self.innovations(values)))[:, None]
        return ChainedFactors(replace(seen, chain=replace(seen.chain, sigma_px=sigma_px)), self.rig, Squares())

    def error(self, values: gtsam.Values) -> float:
        """Return the sum of the losses; without a loss, half the sum of squares."""
        costs = self.loss.cost(np.linalg.norm(self.innovations(values), axis=1))
        if self.freedom is None:
            return float(costs[self.sightings.counted].sum())
        of_tracks = self._of_tracks(costs)
        return float((0.5 * (self.freedom + self._dof) * np.log1p(2.0 * of_tracks / self.freedom)).sum())

    def weights(self, innovation: Array) -> Array:
        """Return the weights (N,) of the squares of innovations (N, 3)."""
        norms = np.linalg.norm(innovation, axis=1)
        weights = self.loss.weight(norms)
        if self.freedom is None:
            return weights
        of_tracks = self._of_tracks(self.loss.cost(norms))
        return np.asarray(
            weights * ((self.freedom + self._dof) / (self.freedom + 2.0 * of_tracks))[self.sightings.point]
        )

    def _of_tracks(self, costs: Array) -> Array:
        """Return the sum (M,) of each track's used costs (N,)."""
        seen = self.sightings
        counted = np.where(seen.counted, costs, 0.0)
        return np.asarray(np.bincount(seen.point, counted, seen.track_ids.size), dtype=float)

    @cached_property
    def _dof(self) -> Array:
        """The degrees of freedom (M,) of each track's innovations; its first sighting determines the landmark."""
        seen = self.sightings
        dof = left_only.degrees_of_freedom(seen.uv_px)
        follows = np.where(seen.counted & (seen.chain.before >= 0), dof, 0)
        return np.asarray(np.bincount(seen.point, follows, seen.track_ids.size), dtype=float)

    def linearised(self, values: gtsam.Values, jacobians_at: gtsam.Values | None = None) -> gtsam.NonlinearFactorGraph:
        """Return the used innovations as linear factors about the values, with the weights of the loss there.

        Their Jacobians are taken at the same values, or at ``jacobians_at``.
        """
        linear = self.linear(values, jacobians_at)
        return self.factors(linear, values, self.sightings.counted, self._to_scale(values))

    def landmark_steps(self, values: gtsam.Values) -> LandmarkSteps:
        """Return the system of a step from the values, of the used innovations with the weights of the loss."""
        seen, linear = self.sightings, self.linear(values)
        _, begins = np.unique(seen.point, return_index=True)
        landmarks = LandmarksSeen.at(values, seen.track_ids, seen.pose[begins], self.rig)
        in_image = linear.point @ np.linalg.inv(landmarks.by_point)[seen.point]
        roots = np.sqrt(self.weights(linear.innovation))
        linear = linear._replace(point=in_image).scaled(roots)
        squares = np.square(linear.point).sum(axis=1)
        information = [np.bincount(seen.point, seen.counted * column, seen.track_ids.size) for column in squares.T]
        graph = gtsam.GaussianFactorGraph()
        to_scale = self._to_scale(values)
        scaled = None if to_scale is None else roots[:, None, None] * to_scale
        for factor in self._terms(linear, seen.counted, scaled):
            graph.add(factor)
        return LandmarkSteps(values, landmarks, graph, np.column_stack(information), self.rig)

    def innovations(self, values: gtsam.Values) -> Array:
        """Return the innovation of each sighting (N, 3), in sigmas."""
        return self._innovations(self.predicted(values))

    def _innovations(self, predicted: stereo.StereoPrediction) -> Array:
        seen = self.sightings
        return seen.chain.innovations(left_only.residuals_px(seen.uv_px, predicted.uv_px), seen.channels)

    def linear(self, values: gtsam.Values, jacobians_at: gtsam.Values | None = None) -> "LinearInnovations":
        """Return the innovations and their Jacobians, without a loss."""
        chain = self.sightings.chain
        predicted = self.predicted(values)
        innovation = self._innovations(predicted)
        if jacobians_at is not None:
            predicted = self.predicted(jacobians_at)
        channels, nothing = self.sightings.channels, np.zeros_like(predicted.d_uv_d_pose)
        to_pose, to_point = predicted.d_uv_d_pose, predicted.d_uv_d_point
        return LinearInnovations(
            innovation,
            chain.whitened(in_channels(channels, to_pose), nothing),
            chain.whitened(nothing, chain.of_before(channels, to_pose)),
            chain.whitened(in_channels(channels, to_point), chain.of_before(channels, to_point)),
        )

    def predicted(self, values: gtsam.Values) -> stereo.StereoPrediction:
        """Return the predicted image of each sighting (N,)."""
        poses, points = self.sightings.places(values)
        rig = scaled_rig(self.rig, scale_in(values)) if values.exists(SCALE) else self.rig
        return stereo.predict(points, poses, rig)

    def _to_scale(self, values: gtsam.Values) -> Array | None:
        """Return the derivative (N, 3, 1) of the innovations by the scale if the values have one."""
        if not values.exists(SCALE):
            return None
        seen = self.sightings
        to_scale = d_uv_d_scale(self.predicted(values).uv_px, scale_in(values))[..., None]
        own, before = in_channels(seen.channels, to_scale), seen.chain.of_before(seen.channels, to_scale)
        return seen.chain.whitened(own, before)

    def factors(
        self, linear: "LinearInnovations", values: gtsam.Values, rows: BoolArray, to_scale: Array | None = None
    ) -> gtsam.NonlinearFactorGraph:
        """Return innovations of a mask (N,), linear about the values, as factors with the weights of the loss.

        ``to_scale`` (N, 3, 1) is their derivative by a scale of disparities among the values.
        """
        roots = np.sqrt(self.weights(linear.innovation))
        graph = gtsam.NonlinearFactorGraph()
        scaled = None if to_scale is None else roots[:, None, None] * to_scale
        for factor in self._terms(linear.scaled(roots), rows, scaled):
            graph.add(gtsam.LinearContainerFactor(factor, values))
        return graph

    def _terms(
        self, linear: "LinearInnovations", rows: BoolArray, to_scale: Array | None
    ) -> Iterator[gtsam.JacobianFactor]:
        """Yield innovations of a mask (N,) as linear factors."""
        seen = self.sightings
        innovation, own, before, points = linear
        poses, landmarks = [X(k) for k in seen.pose.tolist()], [L(i) for i in seen.track_ids[seen.point].tolist()]
        previous = seen.chain.before.tolist()
        for row in np.flatnonzero(rows).tolist():
            terms = [(poses[row], own[row]), (landmarks[row], points[row])]
            if previous[row] >= 0:
                terms.insert(0, (poses[previous[row]], before[row]))
            if to_scale is not None:
                terms.append((SCALE, to_scale[row]))
            yield linear_factor(terms, innovation[row])


class LinearInnovations(NamedTuple):
    """Innovations (N, 3) in sigmas, and their decrease per step of the pose, of the pose before, and of the point.

    ``own`` and ``before`` are (N, 3, 6), ``point`` (N, 3, 3).
    """

    innovation: Array
    own: Array
    before: Array
    point: Array

    def scaled(self, factors: Array) -> "LinearInnovations":
        """Return each multiplied by a factor (N,)."""
        column = factors[:, None, None]
        return LinearInnovations(
            column[:, 0] * self.innovation, column * self.own, column * self.before, column * self.point
        )


def scale_in(values: gtsam.Values) -> float:
    """Return the scale of disparities among values, 0 if they have none."""
    return float(values.atVector(SCALE)[0]) if values.exists(SCALE) else 0.0
