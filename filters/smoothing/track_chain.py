"""Sightings whose errors hang together along their tracks, as linear factors on two poses and a landmark each.

A sighting's error follows from that of the sighting before it (:class:`toolkit.models.correlated_noise.Chain`), so what
is new in it is a residual of both poses and of the landmark. GTSAM has no such factor, and one written in Python is
slow: here all of them are evaluated and linearised at once, and take part in a solve by their linearisation. A scale
of all disparities is a variable of every sighting where the values have one, which no factor of GTSAM's knows either;
sightings that err each by itself are then chains without memory.
"""

from dataclasses import dataclass
from itertools import chain as chain_of
from typing import Any, NamedTuple

import gtsam
import numpy as np

from filters.smoothing.robust_loss import Loss
from toolkit.geometry import Array, BoolArray, IntArray
from toolkit.models import stereo
from toolkit.models.correlated_noise import Chain
from toolkit.models.disparity_scale import d_uv_d_scale, scaled_rig
from toolkit.models.factors import SCALE, L, X
from toolkit.sequence import StereoFrame, StereoRig
from toolkit.track_noise import CHANNELS

# GTSAM's Python has linear factors on so many variables; on more it has conditionals, which are such factors too.
_MOST_TERMS = 3


@dataclass(frozen=True, eq=False)
class ChainedSightings:
    """N sightings: frame and track (N,), both by number, (uL, uR, v) (N, 3) px, and how their errors hang together.

    ``counted`` (N,) says which of the innovations count: an outlying one leaves the track free to be anywhere else from
    there on. ``track_ids`` (M,) ascending are the tracks; ``channels`` (3, 3) is what makes channels of (uL, uR, v).
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
        """Return the sightings of frames (K,), with the noise of tracks if the rig states it."""
        pose = np.repeat(np.arange(len(frames)), [frame.track_ids.size for frame in frames])
        ids, point = np.unique(np.concatenate([frame.track_ids for frame in frames]), return_inverse=True)
        ages = np.concatenate([frame.ages for frame in frames])
        if rig.track_noise is None:
            chain, channels = Chain.without_memory(point.size), rig.whitener
        else:
            chain, channels = Chain.of(rig.track_noise, point, ages), CHANNELS
        uv_px = np.concatenate([frame.uvs_px for frame in frames])
        return cls(pose, point, uv_px, chain, np.ones(pose.size, dtype=bool), ids, channels)


def without_jumps(
    sightings: ChainedSightings, frames: list[StereoFrame], jumped: BoolArray
) -> tuple[ChainedSightings, list[StereoFrame]]:
    """Return the sightings of frames (K,) less the innovations (N,) that jumped, and the frames with those left.

    A track that jumped at its beginning is left out: where its landmark is, the rest of it hardly says.
    """
    began_with = jumped & (sightings.chain.before < 0)
    kept = ~np.isin(sightings.point, sightings.point[began_with])
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
        sightings.channels,
    )
    return left, frames


@dataclass(frozen=True, eq=False)
class ChainedFactors:
    """Evaluates and linearises chained sightings at GTSAM's values, under a loss of the innovations' lengths."""

    sightings: ChainedSightings
    rig: StereoRig
    loss: Loss

    def error(self, values: gtsam.Values) -> float:
        """Return the sum of the losses, half a square each where there is none."""
        norms = np.linalg.norm(self.innovations(values), axis=1)
        return float(self.loss.cost(norms)[self.sightings.counted].sum())

    def linearised(self, values: gtsam.Values) -> gtsam.NonlinearFactorGraph:
        """Return the innovations as linear factors, weighed as the loss does there."""
        predicted, chain = self._predicted(values), self.sightings.chain
        residual, to_pose, to_point, to_scale = (
            self.sightings.channels @ change
            for change in (
                (self.sightings.uv_px - predicted.uv_px)[..., None],
                predicted.d_uv_d_pose,
                predicted.d_uv_d_point,
                d_uv_d_scale(predicted.uv_px, scale_in(values))[..., None],
            )
        )
        innovation = chain.whitened(residual, residual[chain.before])[..., 0]
        roots = np.sqrt(self.loss.weight(np.linalg.norm(innovation, axis=1)))[:, None, None]
        parts = _Linearised(
            own=roots * chain.whitened(to_pose, np.zeros_like(to_pose)),
            before=roots * chain.whitened(np.zeros_like(to_pose), to_pose[chain.before]),
            point=roots * chain.whitened(to_point, to_point[chain.before]),
            scale=roots * chain.whitened(to_scale, to_scale[chain.before]),
            innovation=roots[:, 0] * innovation,
        )
        return self._factors(values, parts)

    def innovations(self, values: gtsam.Values) -> Array:
        """Return what is new in each sighting (N, 3), in sigmas."""
        residual = (self.sightings.uv_px - self._predicted(values).uv_px) @ self.sightings.channels.T
        return self.sightings.chain.whitened(residual, residual[self.sightings.chain.before])

    def _predicted(self, values: gtsam.Values) -> stereo.StereoPrediction:
        seen, rig = self.sightings, scaled_rig(self.rig, scale_in(values)) if values.exists(SCALE) else self.rig
        poses = np.array([values.atPose3(X(k)).matrix() for k in range(int(seen.pose.max()) + 1)])
        points = np.array([values.atPoint3(L(i)) for i in seen.track_ids.tolist()])
        return stereo.predict(points[seen.point], poses[seen.pose], rig)

    def _factors(self, values: gtsam.Values, parts: "_Linearised") -> gtsam.NonlinearFactorGraph:
        seen, unit = self.sightings, gtsam.noiseModel.Unit.Create(3)
        graph, has_scale = gtsam.NonlinearFactorGraph(), values.exists(SCALE)
        poses, landmarks = [X(k) for k in seen.pose.tolist()], [L(i) for i in seen.track_ids[seen.point].tolist()]
        previous = seen.chain.before.tolist()
        for row in np.flatnonzero(seen.counted).tolist():
            terms = [(poses[row], parts.own[row]), (landmarks[row], parts.point[row])]
            if previous[row] >= 0:
                terms.insert(0, (poses[previous[row]], parts.before[row]))
            if has_scale:
                terms.append((SCALE, parts.scale[row]))
            graph.add(gtsam.LinearContainerFactor(_linear(terms, parts.innovation[row], unit), values))
        return graph


class _Linearised(NamedTuple):
    """Derivatives (N, 3, ...) of what is new in N sightings, by their pose, the pose before, landmark and scale."""

    own: Array
    before: Array
    point: Array
    scale: Array
    innovation: Array


def _linear(terms: list[tuple[int, Array]], residual: Array, unit: gtsam.noiseModel.Unit) -> gtsam.JacobianFactor:
    if len(terms) <= _MOST_TERMS:
        arguments: Any = [*chain_of(*terms), residual, unit]
        return gtsam.JacobianFactor(*arguments)
    return gtsam.JacobianFactor(gtsam.GaussianConditional(terms, len(terms), residual, unit))


def scale_in(values: gtsam.Values) -> float:
    """Return the scale of disparities among values, 0 where they have none."""
    return float(values.atVector(SCALE)[0]) if values.exists(SCALE) else 0.0
