"""The card of a recording as a document, the contract ``vislam.card/1`` (docs/tracks.md)."""

from typing import Annotated, Literal

from msgspec import UNSET, Meta, Struct, UnsetType

Channels = Annotated[tuple[float, float, float], Meta(description="in mean column, disparity, row")]
Quantiles = Annotated[tuple[float, float, float], Meta(description="10, 50 and 90 %")]
Lags = Annotated[
    tuple[tuple[float | None, float | None, float | None], ...],
    Meta(description="at lags of 1, 2 ... frames, in mean column, disparity, row; null where tracks are too short"),
]


class CardRecord(Struct, frozen=True, kw_only=True):
    """What the visible tracks of a recording are like, without truth."""

    schema: Literal["vislam.card/1"]
    tracks: Annotated[int, Meta(description="that the noise was fitted to", ge=0)]
    tracks_a_frame: float
    seen_frames: Annotated[Quantiles, Meta(description="sightings of a track")]
    depth_m: Quantiles
    intervals: Annotated[int, Meta(ge=0)]
    intervals_without_common_track: Annotated[int, Meta(ge=0)]
    correlated: Annotated[bool, Meta(description="whether the errors of a track are correlated")]
    white_px: Channels
    walk_px: Annotated[Channels, Meta(description="per root frame")]
    offset_px: Channels
    degrees_of_freedom: Annotated[float, Meta(description="of the tracks' Student-t: the fewer, the heavier its tails")]
    gain: Annotated[float, Meta(description="log-likelihood a track over white noise")]
    gain_error: float
    correlation: Annotated[Lags, Meta(description="autocorrelation of residuals along a track")]
    structure_px2: Annotated[Lags, Meta(description="half the mean square of the difference of residuals")]
    fitted_px2: Annotated[Lags, Meta(description="the same as the fitted noise has it")]
    left_right_correlation: float
    tails: Annotated[float, Meta(description="share of residuals beyond four robust sigmas", ge=0, le=1)]
    at_odds: Annotated[float, Meta(description="share of tracks at odds with the motion", ge=0, le=1)]
    scale: Annotated[float | None, Meta(description="translation by vision over the measured one, or null")]
    scale_error: float | None
    left_out: (
        Annotated[float, Meta(description="share of sightings not given to estimators, where some are", ge=0, le=1)]
        | UnsetType
    ) = UNSET
    words: Annotated[tuple[str, ...], Meta(description="what that means for filters and smoothers")]
