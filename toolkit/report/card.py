"""The card of a recording as text and as a record: why a smoother is or is not better than a filter on it."""

from collections.abc import Iterator

import numpy as np
from msgspec import UNSET

from toolkit.files.documents import number, rounded
from toolkit.geometry import Array
from toolkit.report.comparison_table import sequence_line
from toolkit.report.prose import WIDTH, Width, filled
from toolkit.report.records import CardRecord
from toolkit.report.table import MISSING, Table, as_text
from toolkit.sequence import Sequence
from toolkit.track_errors import Card

# Shares and lengths beyond which there is a remark.
_MANY_AT_ODDS, _MANY_BLIND, _FEW_FRAMES = 0.05, 0.02, 5.0
# A scale is wrong where it differs from one by this many standard errors and by this much: unbiased errors of
# disparities make vision 0.15 to 0.25 % too long on average (eight seeds of drive and of drive-realistic).
_SIGMAS, _SCALE_OFF = 3.0, 0.005
_STRAYS = ": moving objects or lasting mismatches; the outlier policy matters more than the estimator"


def card_lines(card: Card) -> Iterator[str]:
    """Yield the statements of the card, one or two sentences each."""
    few, middle, many = card.seen_frames
    yield (
        f"{card.a_frame:.0f} visible tracks a frame, seen in {middle:.0f} frames in the median ({few:.0f} to "
        f"{many:.0f} in 80 %), at a depth of {card.depth_m[1]:.1f} m ({card.depth_m[0]:.1f} to {card.depth_m[2]:.1f} m)"
    )
    yield _noise(card)
    if middle < _FEW_FRAMES:
        yield (
            f"tracks are short: most poses share few points with any but the next, and a smoother gains "
            f"little over a filter; half of the tracks are gone after {middle:.0f} frames"
        )
    yield (
        f"{card.tails:.1%} of the residuals lie beyond four robust standard deviations, and {card.at_odds:.1%} of the "
        f"tracks are inconsistent with the motion" + (_STRAYS if card.at_odds > _MANY_AT_ODDS else "")
    )
    if card.left_out is not None:
        yield f"{card.left_out:.1%} of the sightings contradict most others and are not given to estimators"
    if card.blind_intervals > _MANY_BLIND * card.intervals:
        yield (
            f"{card.blind_intervals} of {card.intervals} intervals have no common track: there every estimator depends "
            "on the measured motion alone, and no smoother corrects its errors"
        )
    yield from _scale(card)


def _noise(card: Card) -> str:
    lags = "/".join(f"{one:.2f}" for one in card.correlation[0])
    if not card.correlated:
        return (
            f"errors of a track are white, {_channels(card.noise.white_px)} (correlation from frame to frame {lags}): "
            "what every estimator assumes, so that a smoother, which uses more data, should be the most accurate"
        )
    parts = []
    if card.noise.walk_px.any():
        parts.append(f"a random walk of {_channels(card.noise.walk_px)} per root frame")
    if card.noise.offset_px.any():
        parts.append(f"an offset of the disparity of {card.noise.offset_px[1]:.2f} px, constant along a track")
    return (
        f"errors of a track are correlated: {' and '.join(parts)}, beside white noise of "
        f"{_channels(card.noise.white_px)} (correlation from frame to frame {lags}; {card.gain:.1f} +- "
        f"{card.gain_error:.1f} in log-likelihood a track better than white). An estimator that assumes white noise "
        "uses every further sighting of a track as new information, a smoother most of all: it is overconfident and "
        "need not be the most accurate; noise.match_tracks gives tracks less weight, noise.tracks=fitted models the "
        "correlation"
    )


def _scale(card: Card) -> Iterator[str]:
    if card.scale is None:
        return
    off, error = card.scale.value - 1.0, card.scale.error
    if abs(off) > max(_SIGMAS * error, _SCALE_OFF):
        yield (
            f"vision's steps are {abs(off):.2%} +- {error:.2%} {'longer' if off > 0.0 else 'shorter'} than the "
            "measured motion's: calibration or odometry is off by as much, and errors after an SE(3) alignment show "
            "that first"
        )
    else:
        yield f"vision and the measured motion agree in scale, to {abs(off):.2%} +- {error:.2%}"


def _channels(parts_px: Array) -> str:
    return "/".join(f"{part:.2f}" for part in parts_px) + " px in c/d/v"


def card_text(sequence: Sequence, card: Card, width: Width = WIDTH) -> str:
    """Return the card as plain text: what it says, and the residuals along tracks as a table."""
    headings = (("lag",), *(((name,)) for name in ("corr. c", "d", "v", "spread c", "d", "v", "fitted c", "d", "v")))
    rows = tuple(
        (str(lag + 1), *map(_cell, (*card.correlation[lag], *spread, *fitted)))
        for lag, (spread, fitted) in enumerate(zip(np.sqrt(card.structure_px2), np.sqrt(card.fitted_px2), strict=True))
    )
    lines = [filled(sequence_line(sequence), width), ""]
    lines += [filled(line, width) for line in card_lines(card)]
    lines += ["", as_text(Table(headings, rows, labels=1)), ""]
    lines.append(
        filled(
            "lag in frames; corr.: autocorrelation of the residuals along a track; spread: difference of the errors "
            "of two sightings of a track, in px, divided by root two; fitted: the same as the fitted noise has it",
            width,
        )
    )
    return "\n".join(lines)


def _cell(value: float) -> str:
    return f"{value:.2f}" if np.isfinite(value) else MISSING


def card_record(card: Card) -> CardRecord:
    """Return the card as a record; what is not finite becomes null."""
    scale = card.scale
    return CardRecord(
        schema="vislam.card/1",
        tracks=card.tracks,
        tracks_a_frame=rounded(card.a_frame),
        seen_frames=_three(card.seen_frames),
        depth_m=_three(card.depth_m),
        intervals=card.intervals,
        intervals_without_common_track=card.blind_intervals,
        correlated=card.correlated,
        white_px=_three(card.noise.white_px),
        walk_px=_three(card.noise.walk_px),
        offset_px=_three(card.noise.offset_px),
        degrees_of_freedom=rounded(card.degrees),
        gain=rounded(card.gain),
        gain_error=rounded(card.gain_error),
        correlation=_lags(card.correlation),
        structure_px2=_lags(card.structure_px2),
        fitted_px2=_lags(card.fitted_px2),
        left_right_correlation=rounded(card.left_right),
        tails=rounded(card.tails),
        at_odds=rounded(card.at_odds),
        scale=None if scale is None else rounded(scale.value),
        scale_error=None if scale is None else rounded(scale.error),
        left_out=UNSET if card.left_out is None else rounded(card.left_out),
        words=tuple(card_lines(card)),
    )


def _three(values: Array) -> tuple[float, float, float]:
    first, second, third = map(rounded, values.tolist())
    return first, second, third


def _lags(rows: Array) -> tuple[tuple[float | None, float | None, float | None], ...]:
    return tuple((number(row[0]), number(row[1]), number(row[2])) for row in rows.tolist())
