"""Sightings whose errors hang together along their tracks, as linear factors on two poses and a landmark each.

A sighting's error follows from that of the sighting before it (:class:`toolkit.models.correlated_noise.Chain`), so what
is new in it is a residual of both poses and of the landmark. GTSAM has no such factor, and one written in Python is
slow: here all of them are evaluated and linearised at once, and take part in a solve by their linearisation.
"""

from dataclasses import dataclass

import gtsam
import numpy as np

from filters.smoothing.robust_loss import Loss
from toolkit.geometry import Array, BoolArray, IntArray
from toolkit.models import stereo
from toolkit.models.correlated_noise import Chain
from toolkit.models.factors import L, X
from toolkit.sequence import StereoFrame, StereoRig
from toolkit.track_noise import CHANNELS


@dataclass(frozen=True, eq=False)
class ChainedSightings:
    """N sightings: frame and track (N,), both by number, (uL, uR, v) (N, 3) px, and how their errors hang together.

    ``counted`` (N,) says which of the innovations count: an outlying one leaves the track free to be anywhere else from
    there on. ``track_ids`` (M,) ascending are the tracks.
    """

    pose: IntArray
    point: IntArray
    uv_px: Array
    chain: Chain
    counted: BoolArray
    track_ids: IntArray

    @classmethod
    def of(cls, frames: list[StereoFrame], rig: StereoRig) -> "ChainedSightings":
        """Return the sightings of frames (K,) of a rig that states the noise of tracks."""
        assert rig.track_noise is not None
        pose = np.repeat(np.arange(len(frames)), [frame.track_ids.size for frame in frames])
        ids, point = np.unique(np.concatenate([frame.track_ids for frame in frames]), return_inverse=True)
        ages = np.concatenate([frame.ages for frame in frames])
        chain = Chain.of(rig.track_noise, point, ages)
        uv_px = np.concatenate([frame.uvs_px for frame in frames])
        return cls(pose, point, uv_px, chain, np.ones(pose.size, dtype=bool), ids)


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

    def linearised(self, values: gtsam.Values, jacobians_at: gtsam.Values | None = None) -> gtsam.NonlinearFactorGraph:
        """Return the innovations as linear factors about the values, weighed as the loss does there.

        Their Jacobians are those at the same values, or at others.
        """
        chain = self.sightings.chain
        innovation = self.innovations(values)
        predicted = self.predicted(values if jacobians_at is None else jacobians_at)
        to_pose, to_point = CHANNELS @ predicted.d_uv_d_pose, CHANNELS @ predicted.d_uv_d_point
        roots = np.sqrt(self.loss.weight(np.linalg.norm(innovation, axis=1)))[:, None, None]
        own = roots * chain.whitened(to_pose, np.zeros_like(to_pose))
        before = roots * chain.whitened(np.zeros_like(to_pose), to_pose[chain.before])
        points = roots * chain.whitened(to_point, to_point[chain.before])
        return self._factors(values, own, before, points, roots[:, 0] * innovation)

    def innovations(self, values: gtsam.Values) -> Array:
        """Return what is new in each sighting (N, 3), in sigmas."""
        return self.sightings.chain.innovations(self.sightings.uv_px - self.predicted(values).uv_px)

    def predicted(self, values: gtsam.Values) -> stereo.StereoPrediction:
        """Return what the values say of each sighting (N,)."""
        seen = self.sightings
        frames, row = np.unique(seen.pose, return_inverse=True)
        poses = np.array([values.atPose3(X(k)).matrix() for k in frames.tolist()])
        points = np.array([values.atPoint3(L(i)) for i in seen.track_ids.tolist()])
        return stereo.predict(points[seen.point], poses[row], self.rig)

    def _factors(
        self, values: gtsam.Values, own: Array, before: Array, points: Array, innovation: Array
    ) -> gtsam.NonlinearFactorGraph:
        seen, unit = self.sightings, gtsam.noiseModel.Unit.Create(3)
        graph = gtsam.NonlinearFactorGraph()
        poses, landmarks = [X(k) for k in seen.pose.tolist()], [L(i) for i in seen.track_ids[seen.point].tolist()]
        previous = seen.chain.before.tolist()
        for row in np.flatnonzero(seen.counted).tolist():
            here, landmark, last = poses[row], landmarks[row], previous[row]
            terms = (here, own[row], landmark, points[row], innovation[row], unit)
            if last >= 0:
                linear = gtsam.JacobianFactor(poses[last], before[row], *terms)
            else:
                linear = gtsam.JacobianFactor(*terms)
            graph.add(gtsam.LinearContainerFactor(linear, values))
        return graph
