"""``metrics.json``, the contract ``vislam.metrics/1``: scores on one sequence (docs/metrics-json.md)."""

from typing import Annotated, Literal

from msgspec import UNSET, Meta, Struct, UnsetType

from toolkit.estimate import Output, Status

# The keys every document of the contract has, whatever metrics were added since: those of its first version, as the
# metric files say.
from toolkit.metrics import contract_keys

PROMISED_KEYS = contract_keys()
ALL_PROMISED = Meta(description="by metric key", extra_json_schema={"required": list(PROMISED_KEYS)})

MotionKind = Literal["twist", "imu", "none"]
Motion = Annotated[MotionKind, Meta(description="body velocities or raw IMU between the frames")]
Count = Annotated[int, Meta(ge=0)]
# A count stays an integer when it is read and written again.
Value = int | float | None
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
    Annotated[dict[str, str], Meta(description="by fault, why it could not be judged; absent before it was added")]
    | UnsetType
)


class Judged(Struct, frozen=True, kw_only=True):
    """What a run's errors, or its innovations, say of the uncertainty it states."""

    verdict: Annotated[
        Literal["consistent", "overconfident", "timid"], Meta(description="by where the mean is: in, above, below band")
    ]
    metric: Annotated[str, Meta(description="key of the metric it rests on")]
    mean: Annotated[float, Meta(description="its value, over seeds the mean over the runs that are ok")]
    band: Annotated[tuple[float, float], Meta(description="of 95 % of consistent estimators")]


Consistency = (
    Annotated[Judged, Meta(description="absent where neither NEES nor NIS can be had, and before it was added")]
    | UnsetType
)


class ScoredRun(Struct, frozen=True, kw_only=True):
    """One kind of output of one estimator."""

    estimator: Annotated[str, Meta(description="its name, as in vislam list, or what was read from a file")]
    output: Annotated[Output, Meta(description="what it knew at each frame, or when it had seen everything")]
    status: Annotated[
        Status, Meta(description="ran to a plausible end; ran to the end and left what is plausible; could not go on")
    ]
    metrics: Annotated[dict[str, Value], ALL_PROMISED]
    notes: Notes
    log: Annotated[tuple[str, ...], Meta(description="what the estimator had to recover from")]
    consistency: Consistency = UNSET

    def __post_init__(self) -> None:
        check_promised(dict(self.metrics))
        for key, value in self.metrics.items():
            if value is None and not self.notes.get(key):
                raise ValueError(f"metrics.{key} is null, and notes does not say why")


class Metrics(Struct, frozen=True, kw_only=True):
    """Every estimator's scores on one sequence."""

    schema: Literal["vislam.metrics/1"]
    sequence: SequenceRead
    audit: Annotated[tuple[AuditEntry, ...], Meta(description="in the order checked; empty for a clean recording")]
    undecided: Undecided = UNSET
    runs: Annotated[tuple[ScoredRun, ...], Meta(description="by estimator, causal before final")]
