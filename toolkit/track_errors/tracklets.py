"""The visible tracks as channels (c, d, v), their residuals, and the likelihood of a track noise with its gradient.

The camera of the channels stands half-way between the two of the rig: there a point (x, y, z) is seen in the mean
column ``c = fx x / z + cx``, at the disparity ``d = fx b / z``, in the row ``v = fy y / z + cy``. A landmark is given
by its (c, d, v) in the track's first frame; d is an inverse depth, so that it may be at infinity (Civera, Davison &
Montiel, "Inverse depth parametrization for monocular SLAM", 2008).

The landmark of a track is in no other track, so it is eliminated with a flat prior: whitened residuals are projected
off the three directions it explains (Triggs et al., "Bundle adjustment", 2000, section 6.1; restricted likelihood:
Patterson & Thompson 1971). The remaining residuals are multivariate Student-t: a track that slid off its point, or
whose point moves, has little weight (Lange, Little & Taylor, "Robust statistical modeling using the t distribution",
1989).
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import gammaln, psi

from toolkit.geometry import Array, BoolArray, IntArray, se3, se3_inverse, skew
from toolkit.models.gating import LEAST_DEPTH_M, LEAST_DISPARITY_PX
from toolkit.models.stereo import CHANNELS
from toolkit.sequence import Sequence, StereoRig, is_left_only
from toolkit.simulation.track_noise import TrackNoise

# A landmark has as many unknowns as one sighting has coordinates; with three sightings a walk differs from white noise.
FEWEST_SIGHTINGS = 3
# Longer tracks are cut to their first sightings: these show a walk of twelve steps, and the time grows with the square.
MOST_SIGHTINGS = 12
# More tracks in a frame give no further information about their noise; an even share of them is used.
MOST_A_FRAME = 80
# In longer recordings, stretches of this many frames, evenly spread, are used, so that an hour is fitted in seconds.
MOST_FRAMES, STRETCH_FRAMES = 1200, 100


@dataclass(frozen=True, eq=False)
class Tracklets:
    """B tracks of n sightings each, in successive frames.

    ``first_frame`` (B,), increasing; ``cdv_px`` (B, n, 3) measured channels; ``landmark_cdv_px`` (B, 3) the estimated
    landmark, as the channels would be in the first frame; ``track_id`` (B,).
    """

    first_frame: IntArray
    track_id: IntArray
    cdv_px: Array
    landmark_cdv_px: Array

    @property
    def sightings(self) -> int:
        """Return n, the number of sightings per track."""
        return int(self.cdv_px.shape[1])

    @property
    def equations(self) -> int:
        """Return the number of equations per track after its landmark's three unknowns are eliminated."""
        return 3 * self.sightings - 3

    @property
    def frames(self) -> IntArray:
        """Return the frame (B, n) of each sighting."""
        return self.first_frame[:, None] + np.arange(self.sightings)

    def moved(self, by_px: Array) -> "Tracklets":
        """Return the tracks with landmarks moved by (B, 3) px, none beyond infinity."""
        landmark = self.landmark_cdv_px + by_px
        landmark[:, 1] = np.maximum(landmark[:, 1], 0.0)
        return replace(self, landmark_cdv_px=landmark)

    def select(self, rows: BoolArray | IntArray | slice) -> "Tracklets":
        """Return the tracks of a mask (B,) or an index (M,)."""
        return Tracklets(self.first_frame[rows], self.track_id[rows], self.cdv_px[rows], self.landmark_cdv_px[rows])


def tracklets(sequence: Sequence) -> tuple[Tracklets, ...]:
    """Return the tracks an estimator may see, one group per number of sightings; no group if none is long enough."""
    seen = sequence.visible
    # The fit needs disparities, so a track ends where a sighting lacks the right image.
    seen = seen.select(~is_left_only(seen.uv_px))
    order = np.lexsort((seen.frame, seen.track_id))
    frame, track_id, cdv_px = seen.frame[order], seen.track_id[order], seen.uv_px[order] @ CHANNELS.T
    first = np.flatnonzero(np.diff(track_id, prepend=track_id[:1] - 1) != 0)
    count = _unbroken(frame, track_id, first)
    # Tracks are selected by their first sighting: a selection by all sightings would depend on the noise of later ones.
    usable = (cdv_px[first, 1] > LEAST_DISPARITY_PX) & (count >= FEWEST_SIGHTINGS)
    usable &= _in_stretches(frame[first], sequence.frame_count)
    frames = min(sequence.frame_count, MOST_FRAMES)
    usable &= _evenly(usable, float(np.minimum(count, MOST_SIGHTINGS)[usable].sum()) / max(frames, 1))
    groups = []
    for n in np.unique(count[usable]).tolist():
        begin = first[usable & (count == n)]
        begin = begin[np.argsort(frame[begin], kind="stable")]
        rows = begin[:, None] + np.arange(n)
        finite = np.isfinite(cdv_px[rows]).all(axis=(1, 2))
        begin, rows = begin[finite], rows[finite]
        if begin.size:
            groups.append(Tracklets(frame[begin], track_id[begin], cdv_px[rows], cdv_px[begin]))
    return tuple(groups)


def _unbroken(frame: IntArray, track_id: IntArray, first: IntArray) -> IntArray:
    """Return the number of sightings (T,) of each track in successive frames from its first, whose row is given."""
    breaks = np.flatnonzero((np.diff(frame, prepend=-2) != 1) | (np.diff(track_id, prepend=-1) != 0))
    following = np.append(breaks, frame.size)[np.searchsorted(breaks, first, side="right")]
    return np.minimum(following - first, MOST_SIGHTINGS)


def _in_stretches(frame: IntArray, frame_count: int) -> BoolArray:
    """Say which frames (T,) are in one of the stretches that are used."""
    if frame_count <= MOST_FRAMES:
        return np.ones(frame.size, dtype=bool)
    period = frame_count * STRETCH_FRAMES // MOST_FRAMES
    return np.asarray(frame % period < STRETCH_FRAMES)


def _evenly(usable: BoolArray, a_frame: float) -> BoolArray:
    """Say which tracks (T,) to keep so that on average at most MOST_A_FRAME are in a frame."""
    number = np.cumsum(usable) * min(MOST_A_FRAME / max(a_frame, 1.0), 1.0)
    return np.asarray(np.diff(np.floor(number), prepend=0.0) > 0.0)


def middle_of_pair(rig: StereoRig) -> Array:
    """Return T_cam_middle (4, 4), the pose of the camera half-way between left and right in the left camera."""
    return se3(np.eye(3), np.array([0.5 * rig.baseline_m, 0.0, 0.0]))


@dataclass(frozen=True, eq=False)
class LinearisedTracklets:
    """Residuals (B, n, 3) px, measured minus predicted in (c, d, v), and derivatives of the prediction.

    ``d_landmark`` (B, n, 3, 3) by the landmark's own (c, d, v); ``d_pose`` (B, n, 3, 6) by the sighting's pose of the
    camera, perturbed on the right [rotation, position], the landmark fixed in the world.
    """

    residual_px: Array
    d_landmark: Array
    d_pose: Array


def linearised(tracks: Tracklets, T_world_middle: Array, rig: StereoRig) -> LinearisedTracklets:
    """Linearise the tracks about their landmarks and the poses (K, 4, 4) of the camera in the middle of the pair."""
    T_now_first = (
        se3_inverse(T_world_middle)[tracks.frames] @ T_world_middle[tracks.first_frame][:, None]
    )  # (B, n, 4, 4)
    focal_px, centre_px = np.array([rig.fx_px, rig.fy_px]), np.array([rig.cx_px, rig.cy_px])
    landmark = tracks.landmark_cdv_px
    ray = np.ones((len(landmark), 3))
    ray[:, :2] = (landmark[:, [0, 2]] - centre_px) / focal_px
    scale_px_m = rig.fx_px * rig.baseline_m
    inverse_depth = landmark[:, 1] / scale_px_m
    # The point times its inverse depth in the first frame: finite where the point is not.
    rotation, shift = T_now_first[..., :3, :3], T_now_first[..., :3, 3]
    point = (rotation @ ray[:, None, :, None])[..., 0] + inverse_depth[:, None, None] * shift
    point[..., 2] = np.maximum(point[..., 2], LEAST_DEPTH_M * np.maximum(inverse_depth, 1e-6)[:, None])
    predicted = np.empty((*point.shape[:2], 3))
    predicted[..., [0, 2]] = focal_px * point[..., :2] / point[..., 2:] + centre_px
    predicted[..., 1] = landmark[:, None, 1] / point[..., 2]
    d_point = _d_cdv_d_point(point, landmark[:, None, 1], rig)
    by_landmark = np.empty((*point.shape[:2], 3, 3))
    by_landmark[..., 0], by_landmark[..., 2] = rotation[..., 0] / rig.fx_px, rotation[..., 1] / rig.fy_px
    by_landmark[..., 1] = shift / scale_px_m
    d_landmark = d_point @ by_landmark
    d_landmark[..., 1, 1] += 1.0 / point[..., 2]
    by_position = np.broadcast_to(-inverse_depth[:, None, None, None] * np.eye(3), by_landmark.shape)
    d_pose = d_point @ np.concatenate([skew(point), by_position], axis=-1)
    return LinearisedTracklets(tracks.cdv_px - predicted, d_landmark, d_pose)


def _d_cdv_d_point(point: Array, disparity_px: Array, rig: StereoRig) -> Array:
    """Return the derivative (B, n, 3, 3) by a point (B, n, 3) that is scaled by its first inverse depth."""
    x, y, z = point[..., 0], point[..., 1], point[..., 2]
    jacobian = np.zeros((*point.shape, 3))
    jacobian[..., 0, 0], jacobian[..., 0, 2] = rig.fx_px / z, -rig.fx_px * x / z**2
    jacobian[..., 1, 2] = -disparity_px / z**2
    jacobian[..., 2, 1], jacobian[..., 2, 2] = rig.fy_px / z, -rig.fy_px * y / z**2
    return jacobian


def whitening(noise: TrackNoise, sightings: int) -> Array:
    """Return L^-1 (3, n, n) per channel, with L L^T the covariance of n sightings in successive frames."""
    cov: Array = noise.cov(np.arange(float(sightings)))
    return np.asarray(np.linalg.inv(np.linalg.cholesky(cov)))


def whitened(per_channel: Array, values: Array) -> Array:
    """Return values (B, n, 3, ...) of the channels, whitened by (3, n, n), as rows (B, 3 n, ...)."""
    rows: Array = np.einsum("cij,bjc...->bic...", per_channel, values)
    return rows.reshape(len(values), -1, *values.shape[3:])


@dataclass(frozen=True, eq=False)
class TrackletResiduals:
    """Residuals (3, B, n) px of B tracks, channel by channel, and their derivatives by the landmark (3, B, 3, n)."""

    px: Array
    by_landmark: Array

    @classmethod
    def of(cls, tracks: LinearisedTracklets, freedom: float) -> "TrackletResiduals":
        """Return the residuals about adjusted poses, scaled to the size of errors by the remaining share of freedom."""
        px = np.moveaxis(tracks.residual_px, 2, 0) / np.sqrt(freedom)
        by_landmark = tracks.d_landmark.transpose(2, 0, 3, 1)
        return cls(np.ascontiguousarray(px), np.ascontiguousarray(by_landmark))

    def select(self, rows: slice) -> "TrackletResiduals":
        """Return the residuals of some tracks."""
        return TrackletResiduals(self.px[:, rows], self.by_landmark[:, rows])

    @property
    def equations(self) -> int:
        """Return how many equations (3 n - 3) a track has, the landmark eliminated."""
        return 3 * int(self.px.shape[2]) - 3


@dataclass(frozen=True, eq=False)
class Tailed:
    """The noise of most tracks, and the degrees of freedom of the Student-t: the fewer, the heavier its tails."""

    noise: TrackNoise
    degrees: float

    def weights(self, chi2: Array, equations: int) -> Array:
        """Return the weights of tracks (B,) by their squared whitened residuals: about 1, less for outliers."""
        return np.asarray((self.degrees + equations) / (self.degrees + chi2))


@dataclass(frozen=True, eq=False)
class Likelihood:
    """Log-likelihood (B,) of each track, and the gradients of their sum.

    ``by_variance`` (3, 3) is the gradient by the variances, white, walk, offset x c, d, v; ``by_degrees`` that by the
    degrees of freedom. ``chi2`` (B,) is the squared whitened residual of each track at its best landmark.
    """

    each: Array
    by_variance: Array
    by_degrees: float
    chi2: Array


def likelihood(tracks: TrackletResiduals, model: Tailed) -> Likelihood:
    """Return the likelihood of tracks of one length."""
    n = tracks.px.shape[2]
    cov = model.noise.cov(np.arange(float(n)))
    information = np.asarray(np.linalg.inv(cov), dtype=np.float64)
    weighted = tracks.px @ information
    weighted_by = (tracks.by_landmark.reshape(3, -1, n) @ information).reshape(tracks.by_landmark.shape)
    normal: Array = (weighted_by @ np.swapaxes(tracks.by_landmark, 2, 3)).sum(axis=0)  # (B, 3, 3)
    root = np.linalg.cholesky(normal)
    spread: Array = np.linalg.solve(root[None], weighted_by)  # C^-1 H R^-1, transposed
    explained = (spread @ tracks.px[..., None]).sum(axis=0)  # (B, 3, 1)
    left = weighted - (np.swapaxes(spread, 2, 3) @ explained)[..., 0]  # P r
    chi2 = np.maximum((left * tracks.px).sum(axis=(0, 2)), 0.0)
    log_det = np.linalg.slogdet(cov)[1].sum() + 2.0 * np.log(np.diagonal(root, axis1=1, axis2=2)).sum(axis=1)
    each, by_degrees = _student(chi2, tracks.equations, model.degrees)
    by_variance = _by_variance(information, left, spread, model.weights(chi2, tracks.equations))
    return Likelihood(each - 0.5 * log_det, by_variance, by_degrees, chi2)


def _student(chi2: Array, p: int, nu: float) -> tuple[Array, float]:
    """Return the log-density (B,) of a whitened p-dimensional Student-t, and the sum of its derivative by nu."""
    constant = gammaln(0.5 * (nu + p)) - gammaln(0.5 * nu) - 0.5 * p * np.log(np.pi * nu)
    tail = np.log1p(chi2 / nu)
    slope = psi(0.5 * (nu + p)) - psi(0.5 * nu) - p / nu - tail + (nu + p) * chi2 / (nu * (nu + chi2))
    return constant - 0.5 * (nu + p) * tail, 0.5 * float(slope.sum())


def _by_variance(information: Array, left: Array, spread: Array, weight: Array) -> Array:
    """Return half of the weighted r^T P K P r - tr(P K) (3, 3), with K the parts of each channel's covariance."""
    count, n = left.shape[1:]
    ages = np.arange(n)
    rows = []
    for part in (np.eye(n), np.minimum(ages[:, None], ages), np.ones((n, n))):
        fitted = ((left @ part) * left).sum(axis=2) @ weight
        explained = ((spread.reshape(3, -1, n) @ part) * spread.reshape(3, -1, n)).sum(axis=(1, 2))
        rows.append(fitted - count * (information * part).sum(axis=(1, 2)) + explained)
    return 0.5 * np.stack(rows)


def joined(parts: Iterable[Likelihood]) -> Likelihood:
    """Return the likelihood of all tracks, group after group."""
    parts = list(parts)
    each, chi2 = (np.concatenate([getattr(part, name) for part in parts]) for name in ("each", "chi2"))
    by_variance = np.sum([part.by_variance for part in parts], axis=0)
    return Likelihood(each, by_variance, sum(part.by_degrees for part in parts), chi2)
