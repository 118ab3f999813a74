"""The track noise of a recording: fitted to its visible tracks, and chosen among white, walk, offset and both.

Poses and noise are estimated in turn: an adjustment of all tracks under the present noise, then the noise of greatest
likelihood for the residuals. A walk, or an offset, is accepted only if it explains far more than chance: by the
criterion of Schwarz ("Estimating the dimension of a model", 1978), and beyond three standard errors over stretches of
the recording, because errors of tracks that are seen together are correlated.
"""

from dataclasses import dataclass

import numpy as np

from toolkit.errors import DataError
from toolkit.geometry import Array, BoolArray, IntArray
from toolkit.sequence import Sequence, check_runnable
from toolkit.track_errors.adjustment import Adjusted, adjusted, started
from toolkit.track_errors.tracklets import (
    Likelihood,
    Tailed,
    TrackletResiduals,
    Tracklets,
    joined,
    likelihood,
    linearised,
    tracklets,
)
from toolkit.track_noise import CHANNELS, TrackNoise

# Fewer tracks of three sightings do not determine a noise of seven parameters, or its kind.
FEWEST_TRACKS = 100
# There are too few tracks where the poses use more than a quarter of the residuals' degrees of freedom.
LEAST_FREEDOM = 0.75
# Rounds of poses and noise; they end earlier if a round gains less than this log-likelihood per track.
_ROUNDS, _STEPS, _ENOUGH = 12, 2, 0.02
# Smallest white noise, walk and offset (px): coordinates are not more accurate than this.
_LEAST_PX = np.repeat([[0.02], [0.002], [0.01]], 3, axis=1)
_MOST_PX = 100.0
_DEGREES = (2.0, 200.0)
# Walks and offsets below this many times their smallest value count as zero.
_NONE = 2.5
# Initial values of the search; they do not affect the result.
_START_PX = np.array([[0.3, 0.5, 0.3], [0.1, 0.1, 0.1], [0.5, 0.5, 0.5]])
_START_DEGREES = 5.0
_STRETCHES, _SIGMAS = 12, 3.0

# Parts (white, walk, offset) x (c, d, v) of each kind of noise, the simplest first. An offset in c and v cannot be
# distinguished from another position of the landmark.
_KINDS: dict[str, BoolArray] = {
    "white": np.array([[1, 1, 1], [0, 0, 0], [0, 0, 0]], dtype=bool),
    "offset": np.array([[1, 1, 1], [0, 0, 0], [0, 1, 0]], dtype=bool),
    "walk": np.array([[1, 1, 1], [1, 1, 1], [0, 0, 0]], dtype=bool),
    "walk and offset": np.array([[1, 1, 1], [1, 1, 1], [0, 1, 0]], dtype=bool),
}
_RICHEST = _KINDS["walk and offset"]


@dataclass(frozen=True, eq=False)
class Fit:
    """The fitted noise, and its gain in likelihood.

    ``noise`` is that of most tracks, ``degrees`` the degrees of freedom of the tracks' Student-t (fewer: heavier
    tails). ``gain`` is the log-likelihood per track above that of white noise, with its standard error. ``adjusted``
    has the poses and landmarks about which it was fitted.
    """

    noise: TrackNoise
    degrees: float
    gain: float
    gain_error: float
    adjusted: Adjusted

    @property
    def correlated(self) -> bool:
        """Say whether the errors of a track are correlated."""
        return self.noise.is_correlated

    @property
    def tracks(self) -> int:
        """Return the number of tracks."""
        return sum(len(group.first_frame) for group in self.adjusted.tracks)


def fit_track_noise(sequence: Sequence) -> Fit:
    """Fit the noise of a sequence's visible tracks, without its truth.

    Raises DataError where time, motion samples or tracks do not allow it.
    """
    check_runnable(sequence)
    groups = tracklets(sequence)
    count = sum(len(group.first_frame) for group in groups)
    if count < FEWEST_TRACKS:
        raise DataError(
            f"{sequence.name}: {count} visible tracks begin with three successive sightings by both images, too few to "
            f"fit their noise to ({FEWEST_TRACKS} are needed)"
        )
    try:
        return _fitted(sequence, groups)
    except np.linalg.LinAlgError as error:
        raise DataError(
            f"{sequence.name}: no motion of the camera fits the tracks, so that their noise cannot be fitted; "
            "vislam check-data may say what is wrong with them or with the calibration"
        ) from error


def _fitted(sequence: Sequence, groups: tuple[Tracklets, ...]) -> Fit:
    state, value = started(sequence, groups), -np.inf
    model: Tailed | None = None
    for _ in range(_ROUNDS):
        model, reached = _most_likely(_residuals(state, sequence), _RICHEST, model)
        if reached.each.mean() < value + _ENOUGH:
            break
        value = float(reached.each.mean())
        state = adjusted(state, model, sequence, _STEPS)
        if state.freedom < LEAST_FREEDOM:
            raise DataError(
                f"{sequence.name}: {_used_a_frame(groups):.1f} usable sightings a frame (by both images, of tracks "
                "that begin with three in succession) are too few: the camera's motion absorbs their errors, and their "
                "noise cannot be fitted"
            )
    assert model is not None
    return _chosen(state, model, sequence)


def _used_a_frame(groups: tuple[Tracklets, ...]) -> float:
    """Return the mean number of sightings used, over the frames that have any."""
    frames = np.concatenate([group.frames.ravel() for group in groups])
    return frames.size / np.unique(frames).size


def _residuals(state: Adjusted, sequence: Sequence) -> list[TrackletResiduals]:
    return [
        TrackletResiduals.of(linearised(group, state.T_world_middle, sequence.rig), state.freedom)
        for group in state.tracks
    ]


def _most_likely(groups: list[TrackletResiduals], free: BoolArray, start: Tailed | None) -> tuple[Tailed, Likelihood]:
    """Return the most likely noise with the parts (3, 3) that are free, and its likelihood."""
    begin = _START_PX if start is None else np.maximum(_parts(start.noise), 2.0 * _LEAST_PX)
    degrees = _START_DEGREES if start is None else start.degrees
    count = sum(group.px.shape[1] for group in groups)

    def model(x: Array) -> Tailed:
        parts_px = np.zeros((3, 3))
        parts_px[free] = np.exp(x[:-1])
        return Tailed(TrackNoise(*parts_px), float(np.exp(x[-1])))

    def cost(x: Array) -> tuple[float, Array]:
        now = model(x)
        found = joined(likelihood(group, now) for group in groups)
        by_log = (2.0 * found.by_variance * _parts(now.noise) ** 2)[free]
        return -float(found.each.mean()), -np.append(by_log, found.by_degrees * now.degrees) / count

    lowest, highest = np.append(_LEAST_PX[free], _DEGREES[0]), np.append(np.full(free.sum(), _MOST_PX), _DEGREES[1])
    x = np.log(np.clip(np.append(begin[free], degrees), lowest, highest))
    bounds = list(zip(np.log(lowest), np.log(highest), strict=True))
    from scipy.optimize import (
        minimize,
    )  # slow to import, and most processes do not need it

    best = model(minimize(cost, x, jac=True, method="L-BFGS-B", bounds=bounds).x)
    return best, joined(likelihood(group, best) for group in groups)


def _parts(noise: TrackNoise) -> Array:
    return np.stack([noise.white_px, noise.walk_px, noise.offset_px])


def _chosen(state: Adjusted, richest: Tailed, sequence: Sequence) -> Fit:
    """Return the simplest noise over which no richer one has a credible gain."""
    groups = _residuals(state, sequence)
    frames = np.concatenate([group.first_frame for group in state.tracks])
    stretch = frames * _STRETCHES // sequence.frame_count
    kinds = [(free, *_most_likely(groups, free, richest)) for free in _KINDS.values()]
    white = best = kinds[0]
    for richer in kinds[1:]:
        gain = _Gain.over(stretch, richer[2].each - best[2].each)
        if gain.is_credible(int(richer[0].sum() - best[0].sum())):
            best = richer
    gain = _Gain.over(stretch, best[2].each - white[2].each)
    model = best[1]
    return Fit(_without_traces(model.noise), model.degrees, gain.mean, gain.error, state)


@dataclass(frozen=True)
class _Gain:
    """The mean log-likelihood per track that one noise gains over another, its standard error, the number of tracks."""

    mean: float
    error: float
    tracks: int

    @classmethod
    def over(cls, stretch: IntArray, each: Array) -> "_Gain":
        """Return the gain of tracks (B,), with the number (B,) of the stretch of the recording that each is in."""
        apart = np.bincount(stretch, each - each.mean(), _STRETCHES)
        return cls(float(each.mean()), float(np.sqrt((apart**2).sum())) / each.size, each.size)

    def is_credible(self, further: int) -> bool:
        """Say whether the gain justifies ``further`` more parameters."""
        return bool(self.mean > max(_SIGMAS * self.error, 0.5 * further * np.log(self.tracks) / self.tracks))


def _without_traces(noise: TrackNoise) -> TrackNoise:
    walk_px, offset_px = (
        np.where(part < _NONE * least, 0.0, part) for part, least in zip(_parts(noise)[1:], _LEAST_PX[1:], strict=True)
    )
    return TrackNoise(noise.white_px, walk_px, offset_px)


def summary_of(fit: Fit, stated_px2: Array) -> str:
    """Return the fitted noise in a line; if it is white, beside the covariance (3, 3) of (uL, uR, v) in use."""
    noise = fit.noise
    parts = [f"white {_of_channels(noise.white_px)}"]
    if noise.walk_px.any():
        parts.append(f"a walk of {_of_channels(noise.walk_px)} per root frame")
    if noise.offset_px.any():
        parts.append(f"an offset of {noise.offset_px[1]:.2f} px in d")
    if not fit.correlated:
        stated_px = np.sqrt(np.diag(CHANNELS @ stated_px2 @ CHANNELS.T))
        times = float(np.exp(np.mean(np.log(stated_px / noise.white_px))))
        return (
            f"{parts[0]}, independent between sightings; estimators still assume the recording's own "
            f"{_of_channels(stated_px)}, {times:.2f} times that"
        )
    return (
        f"{', '.join(parts)}; {fit.gain:.1f} +- {fit.gain_error:.1f} in log-likelihood a track better than white noise"
    )


def _of_channels(parts_px: Array) -> str:
    return "/".join(f"{part:.2f}" for part in parts_px) + " px in c/d/v"
