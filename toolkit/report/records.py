"""The JSON documents a comparison or a check leaves behind, as typed records, each read from its file by a function.

Here are the records of ``report.json``, the contract ``vislam.report/1``: what a report draws and says beyond the
scores (docs/report.md). It has two forms: of a comparison, and of one over seeds. Times ``t_s`` count from the first
frame; numbers have six digits; what is not finite is null. The card of a recording in it is a document of its own, the
contract ``vislam.card/2`` (docs/tracks.md). The scores are in ``score_records``, the manifest in ``manifest``, a check
in :mod:`toolkit.gate.verdict`; :mod:`toolkit.files.documents` reads and writes, :mod:`toolkit.report.schemas` writes
docs/schemas.
"""

from collections.abc import Sized
from pathlib import Path
from typing import Annotated, Literal

from msgspec import UNSET, Meta, Struct, UnsetType
from msgspec.structs import asdict

from toolkit.estimate import Output
from toolkit.experiment.contests import Question
from toolkit.files.documents import read
from toolkit.gate.verdict import OLDER_CHECKS, CheckDocument
from toolkit.report.manifest import Manifest
from toolkit.report.score_records import MetricsDocument, Seeds, Undecided

Channels = Annotated[tuple[float, float, float], Meta(description="in mean column, disparity, row")]
Quantiles = Annotated[tuple[float, float, float], Meta(description="10, 50 and 90 %")]
Lags = Annotated[
    tuple[tuple[float | None, float | None, float | None], ...],
    Meta(description="at lags of 1, 2 ... frames, in mean column, disparity, row; null where tracks are too short"),
]
Times = Annotated[tuple[float, ...], Meta(description="seconds from the first frame")]
Numbers = tuple[float | None, ...]
Vector = tuple[float, float, float]
__all__ = [
    "CardRecord",
    "CheckDocument",
    "Manifest",
    "MetricsDocument",
    "Report",
    "Seeds",
    "SeedsReport",
    "read_card",
    "read_check",
    "read_manifest",
    "read_metrics",
    "read_report",
    "read_seeds",
    "read_seeds_report",
]
_REPEAT = "repeat the comparison"


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
    track_weight: (
        Annotated[float, Meta(description="share of its information that a sighting has; not in version 1", ge=0, le=1)]
        | UnsetType
    ) = UNSET
    track_weight_error: float | UnsetType = UNSET
    correlation: Annotated[Lags, Meta(description="autocorrelation of residuals along a track")]
    left_right_correlation: float
    tails: Annotated[float, Meta(description="share of residuals beyond four robust sigmas", ge=0, le=1)]
    at_odds: Annotated[float, Meta(description="share of tracks that are inconsistent with the motion", ge=0, le=1)]
    scale: Annotated[float | None, Meta(description="translation by vision over the measured one, or null")]
    scale_error: float | None
    words: Annotated[tuple[str, ...], Meta(description="what that means for filters and smoothers")]


class _Columns(Struct, frozen=True, kw_only=True):
    """Columns of one table: of equal length, which decoding checks."""

    def __post_init__(self) -> None:
        _check_lengths({name: column for name, column in asdict(self).items() if name != "band"})


def _check_lengths(columns: dict[str, Sized]) -> None:
    """Raise ValueError where columns are not as long as the first."""
    first, *others = columns
    for name in others:
        if len(columns[name]) != len(columns[first]):
            raise ValueError(f"{name} has {len(columns[name])} entries, {first} has {len(columns[first])}")


class ErrorKind(Struct, frozen=True, kw_only=True):
    """What the errors of this report are."""

    what: Annotated[str, Meta(description="error, or the difference from whom")]
    placing: (
        Annotated[str, Meta(description="how estimates are placed; absent in older documents, whose caption says it")]
        | UnsetType
    ) = UNSET
    caption: str


class ErrorSeries(_Columns, frozen=True, kw_only=True):
    """Errors along the recording, after the alignment."""

    t_s: Times
    path_m: Annotated[Numbers, Meta(description="along the truth")]
    position_m: Numbers
    heading_deg: Numbers


class ComponentSeries(_Columns, frozen=True, kw_only=True):
    """Errors by component along the recording, not aligned but placed as for the NEES, and what is stated of them.

    Estimate minus truth, or without truth minus another estimate, along and about the world's axes.
    """

    t_s: Times
    x_m: Numbers
    y_m: Numbers
    z_m: Numbers
    about_x_deg: Numbers
    about_y_deg: Numbers
    about_z_deg: Numbers
    sigma_x_m: Annotated[Numbers, Meta(description="stated standard deviation; null where none is stated")]
    sigma_y_m: Numbers
    sigma_z_m: Numbers
    sigma_about_x_deg: Numbers
    sigma_about_y_deg: Numbers
    sigma_about_z_deg: Numbers


class NeesSeries(_Columns, frozen=True, kw_only=True):
    """NEES along the recording, each over its degrees of freedom."""

    t_s: Times
    pose: Numbers
    orientation: Numbers
    position: Numbers
    band: Annotated[tuple[float, float], Meta(description="95 % band of the pose")]


class NisSeries(_Columns, frozen=True, kw_only=True):
    """NIS of each step that reports one."""

    t_s: Times
    per_dof: Annotated[Numbers, Meta(description="over what is expected of the step: its degrees of freedom, or less")]
    low: Annotated[Numbers, Meta(description="lower end of the 95 % band for as many")]
    high: Annotated[Numbers, Meta(description="upper end of the 95 % band for as many")]


class DrawnRun(Struct, frozen=True, kw_only=True):
    """One kind of output of one estimator, in the order of metrics.json."""

    estimator: str
    output: Output
    repeats_causal: Annotated[bool, Meta(description="this final answer is the causal one, which has its own entry")]
    trajectory: Annotated[str | None, Meta(description="its TUM file in the run directory")]
    rotation: Annotated[tuple[Vector, Vector, Vector], Meta(description="of its alignment, rows")]
    translation_m: Annotated[Vector, Meta(description="rotation times a position plus this is in the truth's world")]
    errors: Annotated[ErrorSeries | None, Meta(description="null where there are none, or with the causal entry")]
    nees: Annotated[NeesSeries | str, Meta(description="or why there is none")]
    nis: Annotated[NisSeries | str, Meta(description="or why there is none")]
    components: Annotated[
        ComponentSeries | UnsetType, Meta(description="absent where there are none, or with the causal entry")
    ] = UNSET


class StepTimes(Struct, frozen=True, kw_only=True):
    """The wall clock of an estimator's steps."""

    estimator: str
    t_s: Times
    step_ms: Numbers
    finish_s: float | None

    def __post_init__(self) -> None:
        _check_lengths({"t_s": self.t_s, "step_ms": self.step_ms})


class DrawnMap(Struct, frozen=True, kw_only=True):
    """Where an estimator's landmarks are."""

    estimator: str
    landmarks: Annotated[str, Meta(description="their file in the run directory")]
    output: Annotated[Output, Meta(description="with whose alignment they move")]


class TrackErrors(Struct, frozen=True, kw_only=True):
    """How far the sightings of a frame are from where an output's poses and their tracks' other sightings say."""

    estimator: str
    output: Output
    off_px: Annotated[Numbers, Meta(description="null where a track has fewer than three posed sightings")]


class CameraFrame(Struct, frozen=True, kw_only=True):
    """A left image, rectified, with the sightings that are in it."""

    t_s: Annotated[float, Meta(description="seconds from the first frame")]
    image: Annotated[str, Meta(description="its JPEG file in the run directory")]
    width_px: int
    height_px: int
    u_px: Numbers
    v_px: Numbers
    errors: tuple[TrackErrors, ...]

    def __post_init__(self) -> None:
        _check_lengths({"u_px": self.u_px, "v_px": self.v_px})
        for one in self.errors:
            _check_lengths({"u_px": self.u_px, f"off_px of {one.estimator}": one.off_px})


class AuditMessage(Struct, frozen=True, kw_only=True):
    """A fault of the recording and what became of it."""

    fault: str
    count: int
    outcome: str
    detail: str


class Rival(Struct, frozen=True, kw_only=True):
    """A row of a contest; of the first one, its advantage is null."""

    estimator: str
    output: Output
    value: Annotated[float, Meta(description="of the metric; over seeds the mean")]
    ratio: Annotated[float | None, Meta(description="how many times as much it drifts, or errs, as the first")]
    interval: Annotated[tuple[float, float] | None, Meta(description="99 % of the ratio; null with too few data")]


class ContestRecord(Struct, frozen=True, kw_only=True):
    """Rows ranked by an error, and whether any is better than all others by more than chance."""

    question: Question
    metric: Annotated[str, Meta(description="key of the error they are ranked by")]
    by: Annotated[str, Meta(description="what the test is over: stretches of the path or of time, or seeds")]
    rivals: Annotated[tuple[Rival, ...], Meta(description="from the least error up")]
    leaders: Annotated[tuple[str, ...], Meta(description="estimators that may be the best; one where it is decided")]
    winner: Annotated[
        str | None, Meta(description="the only leader, unless its stated uncertainty is marked; else null")
    ]


VerdictText = Annotated[str, Meta(description="in words; absent before it was added")] | UnsetType
Contests = (
    Annotated[tuple[ContestRecord, ...], Meta(description="who wins, or that nobody does; absent before it was added")]
    | UnsetType
)


class Messages(Struct, frozen=True, kw_only=True):
    """What the report says."""

    sequence: Annotated[str, Meta(description="the recording in a line")]
    verdict: VerdictText = UNSET
    notes: tuple[str, ...]
    remarks: tuple[str, ...]
    start: str
    audit: tuple[AuditMessage, ...]
    undecided: Undecided = UNSET
    facts: tuple[str, ...]
    changes: Annotated[dict[str, str], Meta(description="on a ladder, what each rung changes")]


class Report(Struct, frozen=True, kw_only=True):
    """What the report of a comparison draws and says."""

    schema: Literal["vislam.report/1"]
    start_ns: Annotated[int, Meta(description="stamp of the first frame")]
    truth: Annotated[str | None, Meta(description="the truth while the camera ran, a TUM file in the run directory")]
    alignment: Annotated[str, Meta(description="in words, how estimates are laid over the truth")]
    error: Annotated[ErrorKind | None, Meta(description="null where there are no errors")]
    runs: Annotated[tuple[DrawnRun, ...], Meta(description="one for each of metrics.json, in its order")]
    steps: tuple[StepTimes, ...]
    maps: tuple[DrawnMap, ...]
    words: Messages
    card: Annotated[CardRecord | UnsetType, Meta(description="of the recording's tracks, where requested")] = UNSET
    frames: Annotated[
        tuple[CameraFrame, ...] | UnsetType, Meta(description="some images with their tracks, where there are images")
    ] = UNSET
    contests: Contests = UNSET


class MeanNeesSeries(_Columns, frozen=True, kw_only=True):
    """Pose NEES over 6, averaged over the seeds, with its 95 % band for as many runs."""

    pose: Numbers
    low: Numbers
    high: Numbers


class DrawnOverSeeds(Struct, frozen=True, kw_only=True):
    """One kind of output of one estimator, in the order of seeds.json; its series are over the frames."""

    estimator: str
    output: Output
    nees: MeanNeesSeries | None
    position_rms_m: Annotated[
        Numbers | None, Meta(description="root mean square over the seeds, from the common start")
    ]


class SeedsMessages(Struct, frozen=True, kw_only=True):
    """What the report over seeds says."""

    sequence: Annotated[str, Meta(description="the recording and the seeds in a line")]
    verdict: VerdictText = UNSET
    pairs: Annotated[
        tuple[str, ...] | UnsetType, Meta(description="how each differs from the best; absent before it was added")
    ] = UNSET
    notes: tuple[str, ...]
    verdicts: Annotated[tuple[str, ...], Meta(description="which estimators are overconfident")]
    start: str


class SeedsReport(Struct, frozen=True, kw_only=True):
    """What the report of a comparison over seeds draws and says."""

    schema: Literal["vislam.report/1"]
    t_s: Annotated[Times, Meta(description="of the frames")]
    runs: Annotated[tuple[DrawnOverSeeds, ...], Meta(description="one for each of seeds.json, in its order")]
    words: SeedsMessages
    contests: Contests = UNSET

    def __post_init__(self) -> None:
        for i, run in enumerate(self.runs):
            nees = {} if run.nees is None else {f"runs[{i}].nees.pose": run.nees.pose}
            errors = {} if run.position_rms_m is None else {f"runs[{i}].position_rms_m": run.position_rms_m}
            _check_lengths({"t_s": self.t_s, **nees, **errors})


def read_metrics(path: Path) -> MetricsDocument:
    """Read a ``metrics.json``; raises DataError, in one line with the place, where it is not one."""
    return read(path, MetricsDocument, remedy=_REPEAT)


def read_seeds(path: Path) -> Seeds:
    """Read a ``seeds.json``; raises DataError, in one line with the place, where it is not one."""
    return read(path, Seeds, remedy=_REPEAT)


def read_report(path: Path) -> Report:
    """Read the ``report.json`` of a comparison; raises DataError, in one line with the place, where it is not one."""
    return read(path, Report, remedy=_REPEAT)


def read_seeds_report(path: Path) -> SeedsReport:
    """Read a ``report.json`` over seeds; raises DataError, in one line with the place, where it is not one."""
    return read(path, SeedsReport, remedy=_REPEAT)


def read_manifest(path: Path) -> Manifest:
    """Read a ``manifest.json``; raises DataError, in one line with the place, where it is not one."""
    return read(path, Manifest, remedy=_REPEAT)


def read_check(path: Path) -> CheckDocument:
    """Read what ``vislam check --json`` wrote; raises DataError, in one line with the place, where it is not that."""
    return read(path, CheckDocument, remedy="repeat vislam check", older=OLDER_CHECKS)


def read_card(path: Path) -> CardRecord:
    """Read what ``vislam card --json`` wrote; raises DataError, in one line with the place, where it is not that."""
    return read(path, CardRecord, remedy="repeat vislam card")
