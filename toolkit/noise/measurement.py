"""Measures the noise of a recording on stretches of it, and keeps what was measured under the recording's hash.

The factor on the motion's white noise is the most likely one given the residuals of the motion samples at adjusted
stretches (restricted likelihood: Patterson & Thompson 1971, "Recovery of inter-block information when block sizes are
unequal"). With |r|^2 their squares, t their expectation and s the squared norm of their covariance
(:class:`~toolkit.noise.stretches.MotionFit`), a step of Fisher's scoring multiplies the variance by
``1 + (|r|^2 - t) / s``; it has the relative variance 2 / s.
"""

from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field, replace
from importlib.metadata import version

import msgspec
import numpy as np

from toolkit.errors import EstimatorError, OutputError
from toolkit.files.writing import replaced_file
from toolkit.frontend.cache import folder
from toolkit.measurements import MotionNoise, StereoRig
from toolkit.noise.correlation import FEWEST_SIGHTINGS, TrackWeight, track_weight
from toolkit.noise.stretches import Adjusted, MotionFit, Stretch, stretches
from toolkit.sequence import Sequence

# Raised with every change of the measurement that changes what it finds.
_MEASUREMENT = 2
# The weight of tracks is measured with the motion's noise this many times as large as stated: a motion that errs more
# than stated would otherwise pull the poses, and with them all residuals of an image.
_LOOSE = 10.0
# With fewer frames a stretch shows no correlation along tracks.
_FEWEST_FRAMES = 2 * FEWEST_SIGHTINGS
# The stated noise is kept unless the residuals exceed it by this many standard deviations, and the factor found does
# too: chance does once in a thousand.
_STANDARD_ERRORS = 3.0
# A step changes the variance at most by this factor, because a linear step from far off overshoots. The scoring ends
# where a step is a small part of a standard error.
_LARGEST_STEP, _SMALL, _MOST_STEPS = 4.0, 0.3, 8
# Largest factor: a motion whose errors are a hundred times the stated ones has another fault, which the audit names.
_MOST = 100.0


@dataclass(frozen=True)
class MotionScale:
    """The factor on the standard deviations of the motion's white noise, with its standard error.

    ``ratio`` is that of the squared residuals to their expectation by the stated noise.
    """

    value: float = 1.0
    error: float = 0.0
    ratio: float = 1.0


@dataclass(frozen=True)
class MeasuredNoise:
    """What was measured on a recording; ``why_not`` says why nothing was, and both are then as stated."""

    tracks: TrackWeight = field(default_factory=TrackWeight)
    motion: MotionScale = field(default_factory=MotionScale)
    why_not: str = ""


@np.errstate(all="ignore")  # wild values overflow: their stretch has no solution, or they are outliers
def measured_noise(sequence: Sequence) -> MeasuredNoise:
    """Return the weight of tracks and the factor on the motion's noise of a recording.

    Only the visible tracks and the motion samples are used. White errors as stated give exactly 1 and 1. What was
    measured is kept on disk, so that it is measured once. Raises DataError where the recording cannot be run.
    """
    made_by = f"{_MEASUREMENT}-{version('gtsam')}-{version('numpy')}"
    path = folder() / "noise" / f"{sequence.content_hash()}-{made_by}.json"
    with suppress(OSError, msgspec.DecodeError):
        return msgspec.json.decode(path.read_bytes(), type=MeasuredNoise)
    found = _measured(sequence)
    with suppress(OSError, OutputError):
        path.parent.mkdir(parents=True, exist_ok=True)
        with replaced_file(path) as partial:
            partial.write_bytes(msgspec.json.encode(found))
    return found


def _measured(sequence: Sequence) -> MeasuredNoise:
    if sequence.frame_count < _FEWEST_FRAMES:
        return MeasuredNoise(why_not=f"{sequence.frame_count} frames are too few")
    if not len(sequence.visible):
        return MeasuredNoise(why_not="there are no tracks")
    at_hand = list(_adjusted_again(adjusted_stretches(sequence), sequence.rig, sequence.noise.scaled(_LOOSE)))
    if not at_hand:
        return MeasuredNoise(why_not="the tracks do not determine the motion in any part of it")
    weight = track_weight((one.residuals(FEWEST_SIGHTINGS), stretch.used) for stretch, one in at_hand)
    if not weight.pairs:
        return MeasuredNoise(why_not=f"no track is seen by both images in {FEWEST_SIGHTINGS} frames and more")
    if sequence.motion_kind == "none":
        return MeasuredNoise(weight)
    rig = replace(sequence.rig, track_weight=weight.value)

    def fit(scale: float) -> MotionFit:
        now = list(_adjusted_again(at_hand, rig, sequence.noise.scaled(scale)))
        at_hand[:] = now or at_hand
        fits = [(0.0, 0.0, 0.0), *(one.motion_fit() for _, one in now)]
        return MotionFit(*np.sum(fits, axis=0).tolist())

    return MeasuredNoise(weight, motion_scale(fit))


def adjusted_stretches(sequence: Sequence) -> Iterator[tuple[Stretch, Adjusted]]:
    """Yield stretches of a recording, adjusted with hardly any weight of the motion samples, where that is solvable."""
    for stretch in stretches(sequence):
        with suppress(EstimatorError, np.linalg.LinAlgError):
            yield stretch, stretch.adjusted(sequence.rig, sequence.noise.scaled(_LOOSE))


def _adjusted_again(
    before: Iterable[tuple[Stretch, Adjusted]], rig: StereoRig, noise: MotionNoise
) -> Iterator[tuple[Stretch, Adjusted]]:
    for stretch, adjusted in before:
        with suppress(EstimatorError, np.linalg.LinAlgError):
            yield stretch, stretch.adjusted_again(adjusted, rig, noise)


def motion_scale(fit: Callable[[float], MotionFit]) -> MotionScale:
    """Return the factor by the fit of the motion samples under the stated noise times a factor.

    Where a step leaves no stretch that could be adjusted, the fit says nothing and the stated noise is kept.
    """
    squares, expected, spread = fit(1.0)
    ratio = squares / expected if expected > 0.0 else 1.0
    if spread <= 0.0 or squares - expected <= _STANDARD_ERRORS * np.sqrt(2.0 * spread):
        return MotionScale(ratio=ratio)
    variance = 1.0
    for _ in range(_MOST_STEPS):
        step = float(np.clip(1.0 + (squares - expected) / spread, 1.0 / _LARGEST_STEP, _LARGEST_STEP))
        variance = float(np.clip(variance * step, 1.0, _MOST**2))
        squares, expected, spread = fit(variance**0.5)
        if spread <= 0.0:
            return MotionScale(ratio=ratio)
        if abs(squares - expected) < _SMALL * np.sqrt(2.0 * spread):
            break
    error = variance * float(np.sqrt(2.0 / spread))
    if variance - 1.0 < _STANDARD_ERRORS * error:
        return MotionScale(ratio=ratio)
    value = float(np.sqrt(variance))
    return MotionScale(value, 0.5 * error / value, ratio)
