"""The card of a recording: statistics of its tracks, and the scale of vision over the measured motion, without truth.

Residuals are those of the adjusted stretches on which the noise is measured, of all sightings, outliers too.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from toolkit.arrays import rows_of
from toolkit.audit.clocks import LAG
from toolkit.audit.fault import Evidence
from toolkit.audit.intervals import usual_step_s
from toolkit.audit.robust import Scalar
from toolkit.errors import DataError
from toolkit.geometry import Array, IntArray
from toolkit.measurements import NS_PER_S, is_left_only
from toolkit.models.camera_motion import neighbours
from toolkit.models.gating import LEAST_DISPARITY_PX, MAD_TO_SIGMA
from toolkit.models.stereo import CHANNELS, disparity_px
from toolkit.motion_samples import TwistSamples
from toolkit.noise.correlation import FEWEST_SIGHTINGS, TrackWeight
from toolkit.noise.measurement import adjusted_stretches, measured_noise
from toolkit.noise.stretches import Adjusted
from toolkit.sequence import Sequence, check_runnable

# Sightings between which residuals are compared, at most.
LAGS = 8
# A residual beyond this many robust standard deviations is in the tails; a track with this many times the usual
# residual contradicts the motion.
_TAIL, _ODDS = 4.0, 4.0
# A lag with fewer pairs has no statistic; with fewer residuals there is no card.
_FEWEST_PAIRS, _FEWEST_RESIDUALS = 30, 300
# A scale with a larger standard error is not given.
_SCALE_ERROR = 0.05
QUANTILES = (0.1, 0.5, 0.9)


@dataclass(frozen=True, eq=False)
class Card:
    """Statistics of the visible tracks of a recording.

    ``tracks`` is the number of those in the adjusted stretches; ``a_frame`` their sightings in a frame; ``seen_frames``
    and ``depth_m`` (3,) are the 10, 50 and 90 % quantiles of sightings a track and of depth; ``blind_intervals`` is the
    number of intervals without a common track, of ``intervals``. ``weight`` is that of the tracks. ``correlation``
    (L, 3) is the autocorrelation of residuals along a track at lags of 1 to L frames, by mean column, disparity and
    row; ``left_right`` that of residuals in uL and uR; ``tails`` the share of residuals beyond four robust sigmas,
    ``at_odds`` the share of tracks whose residuals are four times the usual and more. ``scale`` is vision's translation
    over the measured one, None where that is not known.
    """

    tracks: int
    a_frame: float
    seen_frames: Array
    depth_m: Array
    intervals: int
    blind_intervals: int
    weight: TrackWeight
    correlation: Array
    left_right: float
    tails: float
    at_odds: float
    scale: Scalar | None

    @property
    def correlated(self) -> bool:
        return self.weight.correlation > 0.0


@np.errstate(all="ignore")  # as in the measurement
def card_of(sequence: Sequence) -> Card:
    """Return the card of a sequence; raises DataError where it cannot be run or its tracks are too few."""
    check_runnable(sequence)
    seen, rig, measured = sequence.visible, sequence.rig, measured_noise(sequence)
    if measured.why_not:
        raise DataError(f"{sequence.name}: what its tracks are like cannot be measured: {measured.why_not}")
    here = _Residuals(np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int64), np.empty((0, 3)))
    for _, adjusted in adjusted_stretches(sequence):
        more = _Residuals.of(adjusted, int(here.track.max(initial=-1)) + 1)
        here = _Residuals(*(np.concatenate(pair) for pair in zip(here, more, strict=True)))
    if here.px.size < _FEWEST_RESIDUALS:
        raise DataError(
            f"{sequence.name}: the tracks seen {FEWEST_SIGHTINGS} times and more are too few to say what they are like"
        )
    spread_px = np.maximum(MAD_TO_SIGMA * np.median(np.abs(here.px), axis=0), 1e-9)
    squares = np.square(here.px / spread_px).mean(axis=1)
    size = np.sqrt(np.bincount(here.track, squares) / np.bincount(here.track))
    sound = size < _ODDS * np.median(size)
    common = np.bincount(neighbours(seen).interval, minlength=max(sequence.frame_count - 1, 0))
    disparity = disparity_px(seen.uv_px)
    depth_m = rig.fx_px * rig.baseline_m / disparity[disparity > LEAST_DISPARITY_PX]
    of_sound = _Residuals(*(values[sound[here.track]] for values in here))
    return Card(
        tracks=size.size,
        a_frame=len(seen) / sequence.frame_count,
        seen_frames=np.quantile(np.unique(seen.track_id, return_counts=True)[1], QUANTILES),
        depth_m=np.quantile(depth_m, QUANTILES),
        intervals=common.size,
        blind_intervals=int((common == 0).sum()),
        weight=measured.tracks,
        correlation=np.stack([_correlation(of_sound, lag) for lag in range(1, LAGS + 1)]),
        left_right=_left_right(of_sound.px),
        tails=float((np.abs(here.px) > _TAIL * spread_px).mean()),
        at_odds=1.0 - float(sound.mean()),
        scale=_scale(replace(sequence, observations=seen, track_budget=None)),
    )


class _Residuals(NamedTuple):
    """N residuals (N, 3) px in mean column, disparity and row, of tracks (N,) in frames (N,)."""

    track: IntArray
    frame: IntArray
    px: Array

    @classmethod
    def of(cls, adjusted: Adjusted, begin: int) -> "_Residuals":
        """Return those of a stretch, by both images, of tracks seen often enough, numbered from ``begin`` on."""
        vision, seen = adjusted.vision, adjusted.window.sightings
        both = vision.in_front & ~is_left_only(seen.uv_px)
        often = (
            both
            & (np.bincount(seen.point[both], minlength=len(adjusted.window.points)) >= FEWEST_SIGHTINGS)[seen.point]
        )
        _, track = np.unique(seen.point[often], return_inverse=True)
        return cls(begin + track, seen.pose[often], vision.residual_px[often] @ CHANNELS.T)


def _correlation(here: _Residuals, lag: int) -> Array:
    key = here.track * (here.frame.max(initial=0) + lag + 1) + here.frame
    order = np.argsort(key)
    then, found = rows_of(key + lag, key[order])
    first, second = here.px[found], here.px[order[then[found]]]
    if len(first) < _FEWEST_PAIRS:
        return np.full(3, np.nan)
    return np.asarray((first * second).mean(axis=0) / np.sqrt((first**2).mean(axis=0) * (second**2).mean(axis=0)))


def _left_right(px: Array) -> float:
    left_px, right_px = px[:, 0] + 0.5 * px[:, 1], px[:, 0] - 0.5 * px[:, 1]
    return float((left_px * right_px).mean() / np.sqrt((left_px**2).mean() * (right_px**2).mean()))


def _scale(sequence: Sequence) -> Scalar | None:
    """Return the audit's ratio of vision's translations to odometry's, whose error allows slip that lasts.

    The audit takes twists as linear between their stamps. A twist of the whole interval from its stamp on, or up to it,
    is put into the middle of that, without which braking for some seconds looks like a scale of 0.5 %.
    """
    motion = sequence.motion
    if not isinstance(motion, TwistSamples):
        return None
    step_ns = round(usual_step_s(motion.t_ns) * NS_PER_S)
    t_ns = np.concatenate([motion.t_ns[:1] - step_ns, motion.t_ns, motion.t_ns[-1:] + step_ns])
    v_mps, w_radps = (np.pad(samples, ((1, 1), (0, 0)), "edge") for samples in (motion.v_mps, motion.w_radps))
    late_ns = round((0.5 - LAG[motion.pairing]) * step_ns)
    found = Evidence(replace(sequence, motion=TwistSamples(t_ns + late_ns, v_mps, w_radps, "mean"))).velocity_fit
    if found is None or not found.scale.error < _SCALE_ERROR:
        return None
    return Scalar(1.0 + found.scale.value, found.scale.error)
