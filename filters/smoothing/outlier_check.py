"""Which sightings are outliers to a smoother, far from where it expects their landmark; and which landmarks are wrong.

Expected is what the newest state sees of the smoother's own landmarks, once the measured motion and all of the frame's
sightings have put it in its place: a gate that has to let all pass that the motion may be off by lets a car pass, too,
that moves slowly through the image. No filter beside the smoother takes part: one whose covariance is too small
diverges, and would reject every sound sighting.

A landmark that begins far too far away may refuse all that its track shows for as long as it lives. It is wrong where
more sightings of its track are refused than were taken, and these agree with each other.
"""

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import NamedTuple, Self

import numpy as np

from filters.smoothing.known_landmarks import KnownLandmarks
from filters.smoothing.robust_loss import Cauchy
from toolkit.geometry import Array, BoolArray, se3_exp, se3_inverse, transform
from toolkit.models import left_only, stereo
from toolkit.models.gating import LEAST_DISPARITY_PX, MOST_MISMATCHED, chi2_bound, mahalanobis_squared
from toolkit.models.state import POSE, Belief
from toolkit.sequence import StereoFrame, StereoRig
from toolkit.settings import Outliers

# One mismatch is refused, and another by chance; three in succession that see the same point elsewhere are not chance.
FEWEST_REFUSED = 3
# Gauss-Newton with weights of the step before: a turn of three pixels is within a tenth of one after these.
_STEPS = 5
# A step (in the mean over its sightings, by their noise) that changes no residual to speak of is the last.
_LEAST_STEP = 0.01
# As batch has it, between its first solve and its last.
_LOSS = Cauchy(2.0)


def relative_to_its_map(belief: Belief) -> Belief:
    """Return the belief with its pose taken for certain.

    Landmarks are known from the pose, and share its error: how far both are off in the world shows in no sighting.
    """
    cov = belief.cov.copy()
    cov[POSE], cov[:, POSE] = 0.0, 0.0
    return replace(belief, cov=cov)


@dataclass(frozen=True, eq=False)
class OutlierCheck:
    """Leaves sightings out that are beyond the gate of an outlier policy, or a multiple of it."""

    rig: StereoRig
    policy: Outliers

    def placed(
        self, expected: Belief, frame: StereoFrame, landmarks: KnownLandmarks, share: float = 1.0
    ) -> tuple[Belief, StereoFrame]:
        """Return the state where a frame puts it, and the frame without what is an outlier there.

        ``expected`` is the state as predicted, its covariance that of its motion relative to the map, ``share`` what
        sightings count for. There the error of the motion no longer enters the gate.
        """
        known = _KnownSightings.of(frame, landmarks)
        there = _aligned(expected, known, self.rig, share)
        return there, frame.select(~self._outliers(known, relative_to_its_map(there)))

    def outliers(self, frame: StereoFrame, landmarks: KnownLandmarks, expected: Belief) -> BoolArray:
        """Say which sightings (N,) of a frame are not of the landmarks that their tracks have.

        ``expected`` is the state as predicted, its covariance that of its motion relative to the map. A sighting of an
        unknown landmark is no outlier. Where most are outliers the state is wrong, and none is returned.
        """
        return self._outliers(_KnownSightings.of(frame, landmarks), expected)

    def _outliers(self, known: "_KnownSightings", expected: Belief) -> BoolArray:
        if not len(known.points):
            return known.rows
        predicted, uvs_px = stereo.predict(known.points, expected.T_world_imu, self.rig), known.uvs_px
        by_pose = left_only.seen_rows(uvs_px, predicted.d_uv_d_pose)
        by_point = left_only.seen_rows(uvs_px, predicted.d_uv_d_point)
        covs_px2 = left_only.noise_px2(uvs_px, self.rig) + _carried(by_pose, expected.cov[POSE, POSE])
        covs_px2 = covs_px2 + _carried(by_point, known.covs)
        dof = left_only.degrees_of_freedom(uvs_px)
        bound = self.policy.smoother_gate_factor * chi2_bound(dof, self.policy.gate_probability)
        far = mahalanobis_squared(left_only.residuals_px(uvs_px, predicted.uv_px), covs_px2) > bound
        if far.mean() > MOST_MISMATCHED:
            return np.zeros_like(known.rows)
        result = known.rows.copy()
        result[known.rows] = far
        return result


class _KnownSightings(NamedTuple):
    """Which of a frame's sightings (N,) are of known landmarks, these (n, 3) px, and the landmarks.

    ``points`` (n, 3) are in m, ``covs`` (n, 3, 3) in m^2.
    """

    rows: BoolArray
    uvs_px: Array
    points: Array
    covs: Array

    @classmethod
    def of(cls, frame: StereoFrame, landmarks: KnownLandmarks) -> Self:
        rows = landmarks.among(frame.track_ids.tolist())
        return cls(rows, frame.uvs_px[rows], *landmarks.of(frame.track_ids[rows].tolist()))


class _Refused(NamedTuple):
    """Where the first of some refused sightings was (3,) m in the world, and how many there are."""

    point: Array
    sightings: int


class RefusedTracks:
    """Counts, track by track, successive sightings that are refused and agree."""

    def __init__(self, rig: StereoRig, gate_probability: float | None) -> None:
        self._rig, self._bound = rig, chi2_bound(3, gate_probability)
        self._refused: dict[int, _Refused] = {}
        self._taken = Counter[int]()

    def forget(self, track_ids: Iterable[int]) -> None:
        """Begin to count anew for tracks whose landmarks are gone."""
        for i in track_ids:
            self._taken.pop(i, None)

    def contradicted(self, frame: StereoFrame, refused: BoolArray, T_world_imu: Array) -> set[int]:
        """Take in a frame, of which some sightings (N,) were refused, and its pose; return the tracks to begin anew."""
        self._taken.update(frame.track_ids[~refused].tolist())
        seen = frame.select(refused & (stereo.disparity_px(frame.uvs_px) > LEAST_DISPARITY_PX))
        if not seen.track_ids.size:
            self._refused = {}
            return set()
        points = stereo.triangulate_world(seen.uvs_px, T_world_imu, self._rig)
        before = [self._refused.get(i) for i in seen.track_ids.tolist()]
        expected = np.array([point if one is None else one.point for one, point in zip(before, points, strict=True)])
        off_px = seen.uvs_px - stereo.images(transform(se3_inverse(T_world_imu), expected), self._rig)[0]
        # Both sightings err.
        covs_px2 = np.broadcast_to(2.0 * self._rig.cov_uv_px2, (len(points), 3, 3))
        agree = mahalanobis_squared(off_px, covs_px2) <= self._bound
        found = zip(seen.track_ids.tolist(), before, points, agree.tolist(), strict=True)
        self._refused = {
            i: one._replace(sightings=one.sightings + 1) if one is not None and agrees else _Refused(point, 1)
            for i, one, point, agrees in found
        }
        least = ((i, max(FEWEST_REFUSED, self._taken[i] + 1)) for i in self._refused)
        return {i for i, sightings in least if self._refused[i].sightings >= sightings}


def _carried(H: Array, cov: Array) -> Array:
    """Return what a covariance, one or one each, comes to in images by Jacobians (n, 3, d): (n, 3, 3) px^2."""
    return np.asarray(H @ cov @ np.swapaxes(H, 1, 2))


def aligned(
    expected: Belief, frame: StereoFrame, landmarks: KnownLandmarks, rig: StereoRig, share: float = 1.0
) -> Belief:
    """Return the belief at the pose that a frame's sightings of known landmarks and the expected pose agree on.

    Each sighting counts for a share of what it tells by itself, with the noise of the pixels; what is far is so by all
    of it. The covariance stays as it is.
    """
    return _aligned(expected, _KnownSightings.of(frame, landmarks), rig, share)


def _aligned(expected: Belief, known: _KnownSightings, rig: StereoRig, share: float) -> Belief:
    if not len(known.points):
        return expected
    uvs_px, landmarks = known.uvs_px, known.points
    cov = expected.cov[POSE, POSE]
    T_world_imu, off, whitener = expected.T_world_imu, np.zeros(6), left_only.whitener(uvs_px, rig)
    for _ in range(_STEPS):
        predicted = stereo.predict(landmarks, T_world_imu, rig)
        residual = left_only.whitened_residuals(uvs_px, predicted.uv_px, rig)
        weights = np.where(predicted.depth_m > 0.0, share * _LOSS.weight(np.linalg.norm(residual, axis=1)), 0.0)
        H = (whitener @ predicted.d_uv_d_pose).reshape(-1, 6)
        weighed = H * np.repeat(weights, 3)[:, None]
        step = np.linalg.solve(np.eye(6) + cov @ (weighed.T @ H), cov @ (weighed.T @ residual.ravel()) - off)
        off, T_world_imu = off + step, T_world_imu @ se3_exp(step)
        if np.square(H @ step).mean() < _LEAST_STEP**2:
            break
    return replace(expected, T_world_imu=T_world_imu)
