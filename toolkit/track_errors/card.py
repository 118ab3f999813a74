"""The card of a recording: statistics of its tracks, and the scale of vision over the measured motion, without truth.

All figures are computed at the poses of the noise fit. Residuals are about the landmark that is estimated under white
noise, as in an estimator that assumes white noise; differences along a track hardly depend on the landmark.
"""

from dataclasses import dataclass

import numpy as np

from toolkit.audit.parts.intervals import interval_means
from toolkit.audit.parts.robust import MAD_TO_SIGMA, Scalar, slope
from toolkit.geometry import Array, BoolArray, se3_inverse, se3_log
from toolkit.measured_motion import TwistSamples
from toolkit.models.camera_motion import neighbours
from toolkit.models.gating import LEAST_DISPARITY_PX
from toolkit.models.stereo import CHANNELS, disparity_px
from toolkit.resampling import NS_PER_S
from toolkit.sequence import Sequence, StereoRig
from toolkit.simulation.track_noise import TrackNoise
from toolkit.track_errors.fit import Fit
from toolkit.track_errors.tracklets import Tracklets, linearised, middle_of_pair

# Sightings between which residuals are compared, at most.
LAGS = 8
# A residual beyond this many robust standard deviations is in the tails; a track with this many times the usual
# residual contradicts the motion.
_TAIL, _ODDS = 4.0, 4.0
# A lag with fewer pairs has no statistic.
_FEWEST_PAIRS = 30
# Intervals with fewer common tracks are not used for the scale; a scale from fewer intervals, or with a larger standard
# error, is not given.
_FEWEST_COMMON, _FEWEST_INTERVALS, _SCALE_ERROR = 8, 30, 0.05
QUANTILES = (0.1, 0.5, 0.9)


@dataclass(frozen=True, eq=False)
class Card:
    """Statistics of the visible tracks of a recording.

    ``tracks`` is the number of those the noise was fitted to; ``a_frame`` their sightings in a frame; ``seen_frames``
    and ``depth_m`` (3,) are the 10, 50 and 90 % quantiles of sightings a track and of depth; ``blind_intervals`` is the
    number of intervals without a common track, of ``intervals``. ``noise``, ``degrees``, ``gain`` and ``gain_error``
    are the fit's. ``correlation`` and ``structure_px2`` (L, 3) are, at lags of 1 to L frames and by c, d, v, the
    autocorrelation of residuals along a track and half the mean square of their difference, ``fitted_px2`` (L, 3) the
    latter under the fitted noise. ``left_right`` is the correlation of residuals in uL and uR, ``tails`` the share
    beyond four robust sigmas, ``at_odds`` the share of tracks whose residuals are four times the usual and more, and
    ``scale`` vision's translation over the measured one, None where that is not known. ``left_out`` is the share of
    visible sightings withheld from estimators because they move against the rest, None where that was not asked for.
    """

    tracks: int
    a_frame: float
    seen_frames: Array
    depth_m: Array
    intervals: int
    blind_intervals: int
    noise: TrackNoise
    degrees: float
    gain: float
    gain_error: float
    correlation: Array
    structure_px2: Array
    fitted_px2: Array
    left_right: float
    tails: float
    at_odds: float
    scale: Scalar | None
    left_out: float | None = None

    @property
    def correlated(self) -> bool:
        """Say whether the errors of a track are correlated."""
        return self.noise.is_correlated


def card_of(sequence: Sequence, fit: Fit) -> Card:
    """Return the card of a sequence from its fitted track noise."""
    seen, rig, state = sequence.visible, sequence.rig, fit.adjusted
    groups = [_TrackResiduals.of(group, state.T_world_middle, rig, state.freedom) for group in state.tracks]
    spread_px = _spread_px(groups)
    size = [np.sqrt(((group.fixed_px / spread_px) ** 2).sum(axis=(1, 2)) / group.equations) for group in groups]
    usual = float(np.median(np.concatenate(size)))
    sound = [one < _ODDS * usual for one in size]
    common = np.bincount(neighbours(seen).interval, minlength=max(sequence.frame_count - 1, 0))
    disparity = disparity_px(seen.uv_px)
    depth_m = rig.fx_px * rig.baseline_m / disparity[disparity > LEAST_DISPARITY_PX]
    off = np.concatenate([np.abs(group.fixed_px).reshape(-1, 3) for group in groups]) > _TAIL * spread_px
    return Card(
        tracks=fit.tracks,
        a_frame=len(seen) / sequence.frame_count,
        seen_frames=np.quantile(np.unique(seen.track_id, return_counts=True)[1], QUANTILES),
        depth_m=np.quantile(depth_m, QUANTILES),
        intervals=common.size,
        blind_intervals=int((common == 0).sum()),
        noise=fit.noise,
        degrees=fit.degrees,
        gain=fit.gain,
        gain_error=fit.gain_error,
        correlation=_correlation(groups, sound),
        structure_px2=_structure(groups),
        fitted_px2=fit.noise.white_px**2 + 0.5 * fit.noise.walk_px**2 * np.arange(1.0, LAGS + 1.0)[:, None],
        left_right=_left_right(groups, sound),
        tails=float(off.mean()),
        at_odds=1.0 - float(np.concatenate(sound).mean()),
        scale=_scale(sequence, state.T_world_middle, common >= _FEWEST_COMMON),
    )


@dataclass(frozen=True, eq=False)
class _TrackResiduals:
    """Residuals (B, n, 3) px in c, d, v: about the fitted landmark, and about the one estimated under white noise."""

    px: Array
    fixed_px: Array
    equations: int

    @classmethod
    def of(cls, tracks: Tracklets, T_world_middle: Array, rig: StereoRig, freedom: float) -> "_TrackResiduals":
        here = linearised(tracks, T_world_middle, rig)
        sigma_px = np.sqrt(np.diag(CHANNELS @ rig.cov_uv_px2 @ CHANNELS.T))
        count = len(here.residual_px)
        whole = (here.residual_px / sigma_px).reshape(count, -1, 1)
        basis = np.linalg.qr((here.d_landmark / sigma_px[:, None]).reshape(count, -1, 3))[0]
        fixed = (whole - basis @ (np.swapaxes(basis, 1, 2) @ whole)).reshape(here.residual_px.shape) * sigma_px
        return cls(here.residual_px / np.sqrt(freedom), fixed / np.sqrt(freedom), tracks.equations)


def _spread_px(groups: list[_TrackResiduals]) -> Array:
    every = np.abs(np.concatenate([group.fixed_px.reshape(-1, 3) for group in groups]))
    return np.asarray(np.maximum(MAD_TO_SIGMA * np.median(every, axis=0), 1e-9))


def _correlation(groups: list[_TrackResiduals], sound: list[BoolArray]) -> Array:
    """Return the autocorrelation (LAGS, 3) of sound tracks' residuals, NaN where too few are long enough."""
    rows = []
    for lag in range(1, LAGS + 1):
        pairs = [_pairs(group.fixed_px[kept], lag) for group, kept in zip(groups, sound, strict=True)]
        first, second = (np.concatenate([pair[i] for pair in pairs]) for i in (0, 1))
        size = np.sqrt((first**2).mean(axis=0) * (second**2).mean(axis=0)) if len(first) >= _FEWEST_PAIRS else np.nan
        rows.append((first * second).mean(axis=0) / size if len(first) else np.full(3, np.nan))
    return np.stack(rows)


def _structure(groups: list[_TrackResiduals]) -> Array:
    """Return half the mean square (LAGS, 3) px^2 of differences along tracks, from their median size."""
    rows = []
    for lag in range(1, LAGS + 1):
        pairs = [_pairs(group.px, lag) for group in groups]
        apart = np.concatenate([np.abs(second - first) for first, second in pairs])
        enough = len(apart) >= _FEWEST_PAIRS
        rows.append(0.5 * (MAD_TO_SIGMA * np.median(apart, axis=0)) ** 2 if enough else np.full(3, np.nan))
    return np.stack(rows)


def _pairs(residual_px: Array, lag: int) -> tuple[Array, Array]:
    """Return the residuals (P, 3) of sightings, and those of the same tracks ``lag`` frames later."""
    return residual_px[:, :-lag].reshape(-1, 3), residual_px[:, lag:].reshape(-1, 3)


def _left_right(groups: list[_TrackResiduals], sound: list[BoolArray]) -> float:
    every = np.concatenate([group.fixed_px[kept].reshape(-1, 3) for group, kept in zip(groups, sound, strict=True)])
    left_px, right_px = every[:, 0] + 0.5 * every[:, 1], every[:, 0] - 0.5 * every[:, 1]
    return float((left_px * right_px).mean() / np.sqrt((left_px**2).mean() * (right_px**2).mean()))


def _scale(sequence: Sequence, T_world_middle: Array, known: BoolArray) -> Scalar | None:
    """Return the ratio of vision's velocities to the measured ones, with neighbouring intervals as instruments."""
    motion = sequence.motion
    if not isinstance(motion, TwistSamples):
        return None
    T_imu_middle = sequence.rig.T_imu_cam @ middle_of_pair(sequence.rig)
    steps = T_imu_middle @ se3_inverse(T_world_middle[:-1]) @ T_world_middle[1:] @ se3_inverse(T_imu_middle)
    dt_s = np.diff(sequence.frames_t_ns)[:, None] / NS_PER_S
    seen_mps = se3_log(steps)[:, 3:] / dt_s
    measured_mps = interval_means(motion.t_ns, motion.values, sequence.frames_t_ns)[:, :3]
    middle = 1 + np.flatnonzero(known[:-2] & known[1:-1] & known[2:])
    if middle.size < _FEWEST_INTERVALS:
        return None
    around_mps = 0.5 * (seen_mps[middle - 1] + seen_mps[middle + 1])
    # Only along the axis of most motion: across it there is only noise, which is correlated in neighbouring intervals.
    along = np.linalg.eigh(around_mps.T @ around_mps)[1][:, -1:]
    scale = slope(around_mps @ along, measured_mps[middle] @ along, seen_mps[middle] @ along)
    return scale if scale.error < _SCALE_ERROR else None
