"""Which sightings are outliers to a smoother, far from their landmark's predicted image, and which landmarks are wrong.

The prediction is the image of the smoother's own landmarks in the newest state, after the measured motion and all of
the frame's sightings have corrected that state. A gate around the uncorrected state would have to allow for the error
of the motion, and would accept a car that moves slowly through the image. No filter runs beside the smoother: a filter
whose covariance is too small diverges, and would reject every sound sighting.

A landmark whose first estimate is far too distant may cause all later sightings of its track to be rejected. It is
wrong if more sightings of its track are rejected than were accepted, and the rejected ones agree with each other.
"""

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple, Self

import numpy as np

from toolkit.geometry import Array, BoolArray, se3_exp, se3_inverse, transform
from toolkit.measurements import StereoFrame, StereoRig
from toolkit.models import stereo
from toolkit.models.gating import LEAST_DISPARITY_PX, MOST_MISMATCHED, chi2_bound, mahalanobis_squared
from toolkit.models.state import POSE, Belief
from toolkit.settings import Outliers

# One sighting may be rejected as a mismatch and another by chance; three in a row that agree on another point are not
# chance.
FEWEST_REFUSED = 3
# Gauss-Newton with the weights of the step before: a rotation by three pixels is corrected to a tenth after these.
_STEPS = 5
# A step that changes residuals by less than this, in sigma and as a root mean square, is the last.
_LEAST_STEP = 0.01
# A landmark that began with an outlier is far from all later sightings: while one sighting alone determines a landmark,
# that one and the new one both have to be sound.
_MOST_MISMATCHED_PAIRS = 1.0 - (1.0 - MOST_MISMATCHED) ** 2
# The scale of the Cauchy loss of batch between its first and its last solve.
_LOSS_SCALE = 2.0


class KnownLandmarks:
    """The points (3,) m in the world of tracks, by id, and for each the information (3, 3) 1/m^2 of its sightings.

    The position of a landmark seen once, far away, in a later nearby image is uncertain by many pixels; that of one
    seen often, by a fraction of a pixel. Poses are taken as exact: a landmark shares their error.
    """

    def __init__(self, rig: StereoRig) -> None:
        self._rig = rig
        self._points: dict[int, Array] = {}
        self._information: dict[int, Array] = {}
        self._sightings = Counter[int]()

    def __contains__(self, track_id: int) -> bool:
        return track_id in self._points

    def among(self, track_ids: Iterable[int]) -> BoolArray:
        return np.array([i in self._points for i in track_ids], dtype=bool)

    def see(self, frame: StereoFrame, placed: Mapping[int, Array], T_world_imu: Array) -> None:
        """Add the sightings of a frame from a pose (4, 4), of known landmarks and of those ``placed`` here."""
        if not frame.track_ids.size:
            return
        ids = frame.track_ids.tolist()
        self._sightings.update(ids)
        points = [placed[i] if i in placed else self._points[i] for i in ids]
        expected = stereo.predict(np.array(points), T_world_imu, self._rig)
        H = stereo.whitener(frame.uvs_px, self._rig) @ stereo.seen_rows(frame.uvs_px, expected.d_uv_d_point)
        self._points.update(zip(ids, points, strict=True))
        information = zip(ids, np.swapaxes(H, 1, 2) @ H, strict=True)
        self._information.update({i: self._information.get(i, 0.0) + one for i, one in information})

    def move(self, points: Mapping[int, Array]) -> None:
        self._points.update({i: point for i, point in points.items() if i in self._points})

    def keep(self, points: Mapping[int, Array]) -> None:
        self.forget([i for i in self._points if i not in points])
        self.move(points)

    def forget(self, track_ids: Iterable[int]) -> None:
        """Drop landmarks; if seen again, they are started again."""
        for i in track_ids:
            self._points.pop(i, None)
            self._information.pop(i, None)
            self._sightings.pop(i, None)

    def confirmed(self, track_ids: Iterable[int]) -> BoolArray:
        """Say which of the tracks (N,) have a landmark that more than one sighting agrees on."""
        return np.array([self._sightings[i] > 1 for i in track_ids], dtype=bool)

    def of(self, track_ids: Iterable[int]) -> tuple[Array, Array]:
        """Return the points (n, 3) m of some known tracks and the covariances (n, 3, 3) m^2 of their errors."""
        ids = list(track_ids)
        points = np.array([self._points[i] for i in ids]).reshape(-1, 3)
        return points, np.linalg.inv(np.array([self._information[i] for i in ids]).reshape(-1, 3, 3))


def relative_to_its_map(belief: Belief) -> Belief:
    """Return the belief with no error of its pose: landmarks were estimated from it and share that error."""
    cov = belief.cov.copy()
    cov[POSE], cov[:, POSE] = 0.0, 0.0
    return replace(belief, cov=cov)


@dataclass(frozen=True, eq=False)
class OutlierCheck:
    """Removes sightings beyond the gate of an outlier policy, or a multiple of it."""

    rig: StereoRig
    policy: Outliers

    def placed(self, expected: Belief, frame: StereoFrame, landmarks: KnownLandmarks) -> tuple[Belief, StereoFrame]:
        """Return the state corrected by a frame, and the frame without its outliers at that state.

        ``expected`` is the predicted state, with the covariance of its motion relative to the map. At the corrected
        state the error of the motion no longer enters the gate.
        """
        known = KnownSightings.of(frame, landmarks)
        there = _aligned(expected, known, self.rig)
        return there, frame.select(~self.outliers(known, relative_to_its_map(there)))

    def outliers(self, known: "KnownSightings", expected: Belief) -> BoolArray:
        """Say which sightings (N,) of a frame do not fit the landmarks of their tracks.

        ``expected`` is the predicted state, with the covariance of its motion relative to the map. A sighting of an
        unknown landmark is no outlier. If most sightings are outliers the state is wrong, and none is returned.
        """
        if not len(known.points):
            return known.rows
        predicted, uvs_px = stereo.predict(known.points, expected.T_world_imu, self.rig), known.uvs_px
        by_pose = stereo.seen_rows(uvs_px, predicted.d_uv_d_pose)
        by_point = stereo.seen_rows(uvs_px, predicted.d_uv_d_point)
        covs_px2 = stereo.noise_px2(uvs_px, self.rig) + _carried(by_pose, expected.cov[POSE, POSE])
        covs_px2 = covs_px2 + _carried(by_point, known.covs)
        dof = stereo.degrees_of_freedom(uvs_px)
        bound = self.policy.smoother_gate_factor * chi2_bound(dof, self.policy.gate_probability)
        far = mahalanobis_squared(stereo.residuals_px(uvs_px, predicted.uv_px), covs_px2) > bound
        if known.confirmed.any():
            is_state_wrong = far[known.confirmed].mean() > MOST_MISMATCHED
        else:
            is_state_wrong = far.mean() > _MOST_MISMATCHED_PAIRS
        if is_state_wrong:
            return np.zeros_like(known.rows)
        result = known.rows.copy()
        result[known.rows] = far
        return result


class KnownSightings(NamedTuple):
    """The sightings of known landmarks: which (N,) of a frame's they are, (n, 3) px, and the landmarks.

    ``confirmed`` (n,) are the landmarks that more than one sighting agrees on, ``points`` (n, 3) are in m, ``covs``
    (n, 3, 3) in m^2.
    """

    rows: BoolArray
    uvs_px: Array
    confirmed: BoolArray
    points: Array
    covs: Array

    @classmethod
    def of(cls, frame: StereoFrame, landmarks: KnownLandmarks) -> Self:
        rows = landmarks.among(frame.track_ids.tolist())
        ids = frame.track_ids[rows].tolist()
        return cls(rows, frame.uvs_px[rows], landmarks.confirmed(ids), *landmarks.of(ids))


class _AgreeingRejections(NamedTuple):
    """The point (3,) m in the world of the first of some agreeing rejected sightings, and their number."""

    point: Array
    sightings: int


class RefusedTracks:
    """Counts, for each track, successive sightings that are rejected and agree."""

    def __init__(self, rig: StereoRig, gate_probability: float | None) -> None:
        self._rig, self._bound = rig, chi2_bound(3, gate_probability)
        self._refused: dict[int, _AgreeingRejections] = {}
        self._taken = Counter[int]()

    def forget(self, track_ids: Iterable[int]) -> None:
        """Restart the count of tracks whose landmarks are gone."""
        for i in track_ids:
            self._taken.pop(i, None)

    def contradicted(self, frame: StereoFrame, refused: BoolArray, T_world_imu: Array) -> set[int]:
        """Add a frame, which of its sightings (N,) were rejected, and its pose; return the tracks to start again."""
        self._taken.update(frame.track_ids[~refused].tolist())
        seen = frame.select(refused & (stereo.disparity_px(frame.uvs_px) > LEAST_DISPARITY_PX))
        if not seen.track_ids.size:
            self._refused = {}
            return set()
        points = stereo.triangulate_world(seen.uvs_px, T_world_imu, self._rig)
        before = [self._refused.get(i) for i in seen.track_ids.tolist()]
        expected = np.array([point if one is None else one.point for one, point in zip(before, points, strict=True)])
        off_px = seen.uvs_px - stereo.images(transform(se3_inverse(T_world_imu), expected), self._rig)[0]
        # Twice the covariance, because the predicted sighting has noise as well.
        covs_px2 = np.broadcast_to(2.0 * self._rig.cov_uv_px2, (len(points), 3, 3))
        agree = mahalanobis_squared(off_px, covs_px2) <= self._bound
        found = zip(seen.track_ids.tolist(), before, points, agree.tolist(), strict=True)
        self._refused = {
            i: one._replace(sightings=one.sightings + 1)
            if one is not None and agrees
            else _AgreeingRejections(point, 1)
            for i, one, point, agrees in found
        }
        least = ((i, max(FEWEST_REFUSED, self._taken[i] + 1)) for i in self._refused)
        return {i for i, sightings in least if self._refused[i].sightings >= sightings}


def _carried(H: Array, cov: Array) -> Array:
    """Return covariances propagated to images by Jacobians (n, 3, d): (n, 3, 3) px^2."""
    return np.asarray(H @ cov @ np.swapaxes(H, 1, 2))


def _aligned(expected: Belief, known: KnownSightings, rig: StereoRig) -> Belief:
    """Return the belief with its pose corrected by the sightings of known landmarks; its covariance stays."""
    if not len(known.points):
        return expected
    uvs_px, landmarks = known.uvs_px, known.points
    cov = expected.cov[POSE, POSE]
    T_world_imu, off, whitener = expected.T_world_imu, np.zeros(6), stereo.whitener(uvs_px, rig)
    for _ in range(_STEPS):
        predicted = stereo.predict(landmarks, T_world_imu, rig)
        residual = stereo.whitened_residuals(uvs_px, predicted.uv_px, rig)
        weights = np.where(predicted.depth_m > 0.0, 1.0 / (1.0 + np.square(residual / _LOSS_SCALE).sum(axis=1)), 0.0)
        H = (whitener @ predicted.d_uv_d_pose).reshape(-1, 6)
        weighed = H * np.repeat(weights, 3)[:, None]
        step = np.linalg.solve(np.eye(6) + cov @ (weighed.T @ H), cov @ (weighed.T @ residual.ravel()) - off)
        off, T_world_imu = off + step, T_world_imu @ se3_exp(step)
        if np.square(H @ step).mean() < _LEAST_STEP**2:
            break
    return replace(expected, T_world_imu=T_world_imu)
