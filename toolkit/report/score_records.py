"""The scores of estimators: ``metrics.json`` on one sequence, ``seeds.json`` over many seeds (docs/metrics-json.md).

The contracts are ``vislam.metrics/1`` and ``vislam.seeds/1``.
"""

from typing import Annotated, Literal

from msgspec import UNSET, Meta, Struct, UnsetType

from toolkit.estimate import STATUS_MEANING, Output, Status
from toolkit.files.documents import Count, Value
from toolkit.metrics import contract_keys

# The keys every document of the contracts has, whatever metrics were added since: those of their first version, as the
# metric files say.
PROMISED_KEYS = contract_keys()
ALL_PROMISED = Meta(description="by metric key", extra_json_schema={"required": list(PROMISED_KEYS)})

MotionKind = Literal["twist", "imu", "none"]
Motion = Annotated[MotionKind, Meta(description="body velocities, raw IMU or nothing between the frames")]
Notes = Annotated[dict[str, str], Meta(description="by metric key, why there is no value, or a remark on the value")]


def check_promised(metrics: dict[str, object]) -> None:
    """Raise ValueError where one of the keys is missing that every document has."""
    missing = next((key for key in PROMISED_KEYS if key not in metrics), None)
    if missing is not None:
        raise ValueError(f"metrics.{missing} is missing")


class SequenceRead(Struct, frozen=True, kw_only=True):
    """The sequence as the estimators read it, after the audit's repairs and ``--max-frames``."""

    name: Annotated[str, Meta(description="the sequence's name")]
    hash: Annotated[str, Meta(description="SHA-256 over measurements, calibration, noise, prior and truth")]
    frames: Annotated[Count, Meta(description="camera frames")]
    tracks: Annotated[Count, Meta(description="different tracks, those held out included")]
    observations: Annotated[Count, Meta(description="stereo sightings, those held out included")]
    duration_s: Annotated[float, Meta(description="from the first frame to the last", ge=0)]
    path_m: Annotated[float | None, Meta(description="length of the true path meanwhile; null without truth")]
    motion: Motion


class AuditEntry(Struct, frozen=True, kw_only=True):
    """A fault the audit found in the recording."""

    fault: Annotated[str, Meta(description="its name, as in vislam list")]
    count: Annotated[int, Meta(description="in the fault's own unit, named in detail")]
    repaired: Annotated[bool, Meta(description="whether the estimators read the data without it")]
    detail: Annotated[str, Meta(description="one sentence")]


Undecided = (
    Annotated[dict[str, str], Meta(description="by fault, why it could not be decided; absent before it was added")]
    | UnsetType
)


class ConsistencyMark(Struct, frozen=True, kw_only=True):
    """What a run's errors, or its innovations, say of the uncertainty it states."""

    verdict: Annotated[
        Literal["consistent", "overconfident", "timid", "heavy-tailed", "contradicted"],
        Meta(
            description="by the mean: in, above, below its band; below, behind a gate that rejected many; corrections "
            "that lean one way by more than their limit"
        ),
    ]
    metric: Annotated[str, Meta(description="key of the metric it rests on")]
    mean: Annotated[float, Meta(description="its value, over seeds the mean over the runs that are ok")]
    band: Annotated[
        tuple[float, float], Meta(description="of 95 % of consistent estimators; of a correction trend 0 and its limit")
    ]


Consistency = (
    Annotated[
        ConsistencyMark,
        Meta(description="absent where neither NEES nor NIS nor a trend decides, and before it was added"),
    ]
    | UnsetType
)


class ScoredRun(Struct, frozen=True, kw_only=True):
    """One kind of output of one estimator."""

    estimator: Annotated[str, Meta(description="its name, as in vislam list, or what was read from a file")]
    output: Annotated[Output, Meta(description="what it estimated at each frame, or from the whole recording")]
    status: Annotated[Status, Meta(description="; ".join(STATUS_MEANING.values()))]
    metrics: Annotated[dict[str, Value], ALL_PROMISED]
    notes: Notes
    log: Annotated[tuple[str, ...], Meta(description="what the estimator had to recover from")]
    consistency: Consistency = UNSET

    def __post_init__(self) -> None:
        check_promised(dict(self.metrics))
        for key, value in self.metrics.items():
            if value is None and not self.notes.get(key):
                raise ValueError(f"metrics.{key} is null, and notes does not say why")


class MetricsDocument(Struct, frozen=True, kw_only=True):
    """Every estimator's scores on one sequence."""

    schema: Literal["vislam.metrics/1"]
    sequence: SequenceRead
    audit: Annotated[tuple[AuditEntry, ...], Meta(description="in the order checked; empty for a clean recording")]
    undecided: Undecided = UNSET
    runs: Annotated[tuple[ScoredRun, ...], Meta(description="by estimator, causal before final")]


class SequenceOfSeeds(Struct, frozen=True, kw_only=True):
    """What the recordings of all seeds have in common."""

    name: Annotated[str, Meta(description="the sequence's name")]
    source: Annotated[str, Meta(description="as it was requested")]
    frames: Annotated[Count, Meta(description="camera frames")]
    duration_s: Annotated[float, Meta(description="from the first frame to the last", ge=0)]
    motion: Motion


class QuantilesAll(Struct, frozen=True, kw_only=True):
    """Quartiles over all runs, where one that is not ok counts as infinitely bad; null where such runs decide it."""

    lower_quartile: float | None
    median: float | None
    upper_quartile: float | None
    reason: Annotated[str, Meta(description="why a quartile is null")] | UnsetType = UNSET

    def __post_init__(self) -> None:
        if None in (self.lower_quartile, self.median, self.upper_quartile) and not self.reason:
            raise ValueError("a quartile over all runs is null, and reason does not say why")


class MetricOverSeeds(Struct, frozen=True, kw_only=True):
    """One metric: its spread over the runs that are ok, null where there are none, and its value under each seed."""

    n: Annotated[Count, Meta(description="how many runs that are ok have a value")]
    mean: float | None
    median: float | None
    std: Annotated[float | None, Meta(description="with n - 1 in its divisor; null for a single value")]
    least: float | None
    lower_quartile: float | None
    upper_quartile: float | None
    most: float | None
    values: Annotated[tuple[Value, ...], Meta(description="one a seed, whatever the run's status")]
    quantiles_all: (
        Annotated[
            QuantilesAll, Meta(description="absent where no value is best, or none was had, and before it was added")
        ]
        | UnsetType
    ) = UNSET

    def __post_init__(self) -> None:
        of_any = (self.mean, self.median, self.least, self.lower_quartile, self.upper_quartile, self.most)
        if any((value is None) != (self.n == 0) for value in of_any) or (self.std is None) != (self.n < 2):
            raise ValueError(f"n is {self.n}, which its mean, median, std, least, most or a quartile does not fit")


class WholeRuns(Struct, frozen=True, kw_only=True):
    """What is taken over frames and seeds together; of the pose NEES, over 6, its mean over the seeds at each frame."""

    position_rmse_m: Annotated[float | None, Meta(description="root mean square over frames and seeds, not aligned")]
    runs: Annotated[Count, Meta(description="the most runs that have a NEES at one frame")]
    nees_pose_band: Annotated[tuple[float, float] | None, Meta(description="95 % band of the mean of so many runs")]
    nees_pose_in_band_percent: Annotated[float | None, Meta(description="share of the frames within their band")]
    nees_pose_above_percent: Annotated[float | None, Meta(description="share of the frames above their band")]


class RunOverSeeds(Struct, frozen=True, kw_only=True):
    """One kind of output of one estimator under all seeds."""

    estimator: Annotated[str, Meta(description="its name, as in vislam list")]
    output: Annotated[Output, Meta(description="what it estimated at each frame, or from the whole recording")]
    change: (
        Annotated[str, Meta(description="on a ladder only: what it changes against the rung before")] | UnsetType
    ) = UNSET
    status: Annotated[tuple[Status, ...], Meta(description="one a seed")]
    counts: Annotated[dict[Status, Count], Meta(description="how many seeds ended each way")]
    metrics: Annotated[dict[str, MetricOverSeeds], ALL_PROMISED]
    notes: Notes
    over_seeds: WholeRuns
    consistency: Consistency = UNSET
    ok_share: Annotated[float, Meta(description="of the seeds, from 0 to 1", ge=0, le=1)] | UnsetType = UNSET

    def __post_init__(self) -> None:
        ends: tuple[Status, ...] = ("ok", "diverged", "failed")
        if self.counts != {status: self.status.count(status) for status in ends}:
            raise ValueError("counts does not count status")
        check_promised(dict(self.metrics))
        for key, metric in self.metrics.items():
            if len(metric.values) != len(self.status):
                raise ValueError(f"metrics.{key}.values does not have an entry a seed")
            if metric.n == 0 and not self.notes.get(key):
                raise ValueError(f"metrics.{key} has no value, and notes does not say why")


class LogEntry(Struct, frozen=True, kw_only=True):
    """What one run had to say."""

    estimator: str
    seed: int
    status: Status
    log: Annotated[tuple[str, ...], Meta(description="what the estimator had to recover from")]


class Seeds(Struct, frozen=True, kw_only=True):
    """Every estimator's scores over many seeds of one sequence."""

    schema: Literal["vislam.seeds/1"]
    sequence: SequenceOfSeeds
    seeds: Annotated[tuple[int, ...], Meta(description="in order")]
    hashes: Annotated[
        tuple[str | None, ...],
        Meta(description="of what was read under each seed; null where every run's process died"),
    ]
    start: Annotated[str, Meta(description="where every run started")]
    estimators: Annotated[tuple[str, ...], Meta(description="in order")]
    runs: Annotated[tuple[RunOverSeeds, ...], Meta(description="by estimator, causal before final")]
    log: Annotated[tuple[LogEntry, ...], Meta(description="every run that has log lines")]

    def __post_init__(self) -> None:
        if len(self.hashes) != len(self.seeds):
            raise ValueError("hashes does not have an entry a seed")
        for i, run in enumerate(self.runs):
            if len(run.status) != len(self.seeds):
                raise ValueError(f"runs[{i}].status does not have an entry a seed")
