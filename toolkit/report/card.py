"""A recording as text: what its audit found, and its card, which is a record too and says whether a smoother gains."""

from collections.abc import Iterator
from typing import Annotated, Literal

import numpy as np
from msgspec import UNSET, Meta, Struct, UnsetType, convert

from toolkit.audit import Audit
from toolkit.errors import printable
from toolkit.files.documents import number, reader, rounded
from toolkit.noise import Card
from toolkit.report.headers import sequence_line, tracks_measured
from toolkit.report.messages import outcome, undecided_lines
from toolkit.report.text import MISSING, WIDTH, Table, Width, as_text, filled, section
from toolkit.sequence import Sequence

Channels = Annotated[tuple[float, float, float], Meta(description="in mean column, disparity, row")]
Quantiles = Annotated[tuple[float, float, float], Meta(description="10, 50 and 90 %")]
Lags = Annotated[
    tuple[tuple[float | None, float | None, float | None], ...],
    Meta(description="at lags of 1, 2 ... frames, in mean column, disparity, row; null where tracks are too short"),
]
# Shares and lengths beyond which there is a remark.
_MANY_AT_ODDS, _MANY_BLIND, _FEW_FRAMES = 0.05, 0.02, 5.0
# A scale is wrong where it differs from one by this many standard errors and by this much: unbiased errors of
# disparities make vision 0.15 to 0.25 % too long on average (eight seeds of drive and of drive-realistic).
_SIGMAS, _SCALE_OFF = 3.0, 0.005
_STRAYS = ": moving objects or lasting mismatches; the outlier policy matters more than the estimator"


class CardRecord(Struct, frozen=True, kw_only=True):
    """What the visible tracks of a recording are like, without truth."""

    schema: Literal["vislam.card/1", "vislam.card/2"]
    tracks: Annotated[int, Meta(description="in the stretches that were adjusted", ge=0)]
    tracks_a_frame: float
    seen_frames: Annotated[Quantiles, Meta(description="sightings of a track")]
    depth_m: Quantiles
    intervals: Annotated[int, Meta(ge=0)]
    intervals_without_common_track: Annotated[int, Meta(ge=0)]
    correlated: Annotated[bool, Meta(description="whether the errors of a track are correlated")]
    track_weight: Annotated[float, Meta(description="what a sighting counts for", ge=0, le=1)] | UnsetType = UNSET
    track_weight_error: float | UnsetType = UNSET
    correlation: Annotated[Lags, Meta(description="autocorrelation of residuals along a track")]
    left_right_correlation: float
    tails: Annotated[float, Meta(description="share of residuals beyond four robust sigmas", ge=0, le=1)]
    at_odds: Annotated[float, Meta(description="share of tracks that are inconsistent with the motion", ge=0, le=1)]
    scale: Annotated[float | None, Meta(description="translation by vision over the measured one, or null")]
    scale_error: float | None
    words: Annotated[tuple[str, ...], Meta(description="what that means for filters and smoothers")]


read_card = reader(CardRecord, "repeat vislam card")


def card_lines(card: Card) -> Iterator[str]:
    few, middle, many = card.seen_frames
    yield (
        f"{card.a_frame:.0f} visible tracks a frame, seen in {middle:.0f} frames in the median ({few:.0f} to "
        f"{many:.0f} in 80 %), at a depth of {card.depth_m[1]:.1f} m ({card.depth_m[0]:.1f} to {card.depth_m[2]:.1f} m)"
    )
    weight, lags = card.weight, "/".join(f"{one:.2f}" for one in card.correlation[0])
    if card.correlated:
        yield (
            f"sightings: {tracks_measured(weight)}; in column, disparity and row {lags}, with {weight.variance:.2g} "
            "times the stated variance (noise.track_weight)"
        )
    else:
        yield (
            f"errors of a track are white (correlation from frame to frame {lags} in column, disparity and row): what "
            "every estimator assumes, so that a smoother, which uses more data, should be the most accurate"
        )
    if middle < _FEW_FRAMES:
        yield (
            f"tracks are short: most poses share few points with any but the next, and a smoother gains "
            f"little over a filter; half of the tracks are gone after {middle:.0f} frames"
        )
    yield (
        f"{card.tails:.1%} of the residuals lie beyond four robust standard deviations, and {card.at_odds:.1%} of the "
        f"tracks are inconsistent with the motion" + (_STRAYS if card.at_odds > _MANY_AT_ODDS else "")
    )
    if card.blind_intervals > _MANY_BLIND * card.intervals:
        yield (
            f"{card.blind_intervals} of {card.intervals} intervals have no common track: there every estimator depends "
            "on the measured motion alone, and no smoother corrects its errors"
        )
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


def audit_text(audited: Audit, width: Width = WIDTH) -> str:
    findings = audited.findings
    lines = [printable(sequence_line(audited.sequence)), ""]
    if findings:
        headings = (("fault",), ("outcome",), ("count",))
        rows = tuple((f.fault, outcome(f), str(f.count)) for f in findings)
        lines += [as_text(Table(headings, rows, labels=2)), ""]
        lines += [filled(f"{finding.fault}: {finding.detail}", width) for finding in findings]
    else:
        lines += ["no fault found"]
    lines += [filled(line, width) for line in undecided_lines(audited.undecided)]
    lines += section("facts", audited.sequence.provenance.facts, width)
    if findings and not audited.undecided and not any(f.blocking or f.warning for f in findings):
        lines += ["", "no fault is left that invalidates a result"]
    return "\n".join(lines)


def card_text(sequence: Sequence, card: Card, width: Width = WIDTH) -> str:
    headings = (("lag",), ("column",), ("disparity",), ("row",))
    cells = [[f"{one:.2f}" if np.isfinite(one) else MISSING for one in each] for each in card.correlation]
    rows = tuple((str(lag), *each) for lag, each in enumerate(cells, start=1))
    lines = [filled(sequence_line(sequence), width), ""]
    lines += [filled(line, width) for line in card_lines(card)]
    lines += ["", as_text(Table(headings, rows, labels=1)), ""]
    lines.append(filled("lag in frames: autocorrelation of the residuals along a track", width))
    return "\n".join(lines)


def card_record(card: Card) -> CardRecord:
    scale = card.scale
    return CardRecord(
        schema="vislam.card/2",
        tracks=card.tracks,
        tracks_a_frame=rounded(card.a_frame),
        seen_frames=convert([rounded(one) for one in card.seen_frames.tolist()], Quantiles),
        depth_m=convert([rounded(one) for one in card.depth_m.tolist()], Quantiles),
        intervals=card.intervals,
        intervals_without_common_track=card.blind_intervals,
        correlated=card.correlated,
        track_weight=rounded(card.weight.value),
        track_weight_error=rounded(card.weight.error),
        correlation=tuple((number(a), number(b), number(c)) for a, b, c in card.correlation.tolist()),
        left_right_correlation=rounded(card.left_right),
        tails=rounded(card.tails),
        at_odds=rounded(card.at_odds),
        scale=None if scale is None else rounded(scale.value),
        scale_error=None if scale is None else rounded(scale.error),
        words=tuple(card_lines(card)),
    )
