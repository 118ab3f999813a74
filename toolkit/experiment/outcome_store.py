"""Outcomes kept on disk: each is added to a file of the run directory as it ends, and is found there afterwards.

An outcome is read back exactly as it was kept. An outcome of other data, settings or code has another key and is never
returned instead. A run whose process died is not kept: it is tried again. A line of the file ``outcomes.jsonl`` holds
one outcome, exactly, and all that it depends on (docs/scaling.md).
"""

import hashlib
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePosixPath
from typing import Annotated, Any, Literal, Protocol

import msgspec
import numpy as np
from msgspec import Meta, Struct

from toolkit.answers import Output, Status
from toolkit.errors import DataError, OutputError
from toolkit.experiment.code_version import code_digest, numeric_versions
from toolkit.experiment.units import Outcome, Scored, Unit
from toolkit.files.reading import read_input
from toolkit.files.writing import LineFile, plain_name, whole_lines
from toolkit.geometry import Array
from toolkit.metrics import Scores, repeated, without_requests
from toolkit.settings import Settings, as_values

# JSON has no such numbers; null stands for NaN.
Infinite = Literal["inf", "-inf"]
Number = float | Infinite | None
Series = Annotated[tuple[Number, ...], Meta(description="one a frame; null where unknown")]
OUTCOMES, _TRAJECTORIES = "outcomes.jsonl", "trajectories"
# Every line of such a file begins so.
_OUR_START = b'{"schema":"vislam.outcome'
_NO_CHECKSUM = b'"sha256":""}'
_FILES_START = b'{"schema":"vislam.outcome-files/1"'


class UnitKey(Struct, frozen=True, kw_only=True):
    """Everything that an outcome depends on: equal keys give equal outcomes, except for the times."""

    data: Annotated[str, Meta(description="SHA-256 of the recording under seed 0, repaired, and of the part used")]
    seed: int
    estimator: str
    settings: Annotated[dict[str, Any], Meta(description="those that reach a run of this estimator")]
    keep: Annotated[tuple[str, ...], Meta(description="faults that are not repaired")]
    faults: Annotated[tuple[tuple[str, float], ...] | None, Meta(description="planted ones, with their doses")] = None
    code: Annotated[str, Meta(description="SHA-256 of the toolkit's code and of the estimators'")]
    versions: Annotated[dict[str, str], Meta(description="of Python and of the packages that compute")]

    def text(self) -> bytes:
        """Return the key in one form, for a mapping."""
        return msgspec.json.encode(self, order="deterministic")


class ScoredRecord(Struct, frozen=True, kw_only=True):
    """One output's scores and series."""

    values: dict[str, int | float | None]
    notes: dict[str, str]
    nees_pose: Series
    position_m: Series
    nis_dof: Number
    drift_m: Annotated[tuple[Number, ...], Meta(description="over equal stretches of time")] = ()
    heldout_px: Annotated[tuple[Number, ...], Meta(description="over equal stretches of time")] = ()


class UncheckedRecord(Struct, frozen=True, kw_only=True, tag_field="schema", tag="vislam.outcome/1"):
    """An outcome without a checksum, as earlier versions wrote it: of other code, and so never found.

    A final output that only repeats the causal one is not there.
    """

    unit: UnitKey
    requested: Annotated[tuple[str, ...], Meta(description="metrics on request that were computed")]
    status: Status
    sequence_hash: Annotated[str, Meta(description="SHA-256 of the recording it read")]
    final_is_causal: bool
    outputs: dict[Output, ScoredRecord]
    files: Annotated[dict[str, str], Meta(description="SHA-256 of its trajectories by their relative paths")]
    log: tuple[str, ...]


class OutcomeRecord(UncheckedRecord, frozen=True, kw_only=True, tag_field="schema", tag="vislam.outcome/2"):
    """An outcome as its line holds it."""

    sha256: Annotated[str, Meta(description="of the line with this empty: a line that was edited is refused")]


class FilesRecord(Struct, frozen=True, kw_only=True, tag_field="schema", tag="vislam.outcome-files/1"):
    """Files that are written next, so that they are known as ours whatever happens then."""

    files: tuple[str, ...]


def record_of(outcome: Outcome, unit: UnitKey, requested: tuple[str, ...], files: dict[str, str]) -> OutcomeRecord:
    """Return an outcome as a line holds it, with its trajectory files; the run itself is left out."""
    repeats = outcome.final_is_causal
    return OutcomeRecord(
        unit=unit,
        requested=requested,
        status=outcome.status,
        sequence_hash=outcome.sequence_hash,
        final_is_causal=repeats,
        outputs={k: _scored_record(v) for k, v in outcome.outputs.items() if not (repeats and k == "final")},
        files=files,
        log=outcome.log,
        sha256="",
    )


def line_of(record: OutcomeRecord) -> bytes:
    """Return the line of an outcome, with its checksum, which stands last."""
    line = msgspec.json.encode(record)
    assert line.endswith(_NO_CHECKSUM)
    return _with_checksum(line, hashlib.sha256(line).hexdigest())


def _with_checksum(line: bytes, digest: str) -> bytes:
    return line.removesuffix(_NO_CHECKSUM) + _NO_CHECKSUM[:-2] + digest.encode() + _NO_CHECKSUM[-2:]


def _is_as_written(line: bytes, record: OutcomeRecord) -> bool:
    """Say whether the checksum of a line is that of the line."""
    end = _with_checksum(_NO_CHECKSUM, record.sha256)
    bare = line.removesuffix(end) + _NO_CHECKSUM
    return line.endswith(end) and hashlib.sha256(bare).hexdigest() == record.sha256


def outcome_of_record(record: OutcomeRecord, requested: tuple[str, ...]) -> Outcome:
    """Return the outcome of a line to the bit, without metrics on request that are not ``requested``."""
    outputs = {output: _scored(one, requested) for output, one in record.outputs.items()}
    if record.final_is_causal:
        causal = outputs["causal"]
        final = replace(causal, scores=repeated(causal.scores))
        outputs = {"causal": causal, "final": final}
    return Outcome(
        seed=record.unit.seed,
        estimator=record.unit.estimator,
        status=record.status,
        outputs=outputs,
        log=record.log,
        sequence_hash=record.sequence_hash,
        final_is_causal=record.final_is_causal,
        files=record.files,
    )


def _scored_record(scored: Scored) -> ScoredRecord:
    return ScoredRecord(
        values={key: _plain(value) for key, value in scored.scores.values.items()},
        notes=dict(scored.scores.notes),
        nees_pose=_numbers(scored.nees_pose),
        position_m=_numbers(scored.position_m),
        nis_dof=None if scored.nis_dof is None else _number(float(scored.nis_dof)),
        drift_m=_numbers(scored.drift_m),
        heldout_px=_numbers(scored.heldout_px),
    )


def _plain(value: float | None) -> float | None:
    """Return a number of NumPy's as Python's, whole ones whole."""
    return value.item() if isinstance(value, np.generic) else value


def _scored(record: ScoredRecord, requested: tuple[str, ...]) -> Scored:
    scores = without_requests(Scores(dict(record.values), dict(record.notes)), requested)
    nis_dof = None if record.nis_dof is None else float(record.nis_dof)
    stretches = _series(record.drift_m), _series(record.heldout_px)
    return Scored(scores, _series(record.nees_pose), _series(record.position_m), nis_dof, *stretches)


def _numbers(values: Array) -> tuple[Number, ...]:
    return tuple(_number(value) for value in values.tolist())


def _number(value: float) -> Number:
    if math.isfinite(value):
        return value
    return None if math.isnan(value) else "inf" if value > 0.0 else "-inf"


def _series(numbers: tuple[Number, ...]) -> Array:
    return np.array([math.nan if number is None else float(number) for number in numbers], dtype=float)


_DECODER = msgspec.json.Decoder(OutcomeRecord | UncheckedRecord | FilesRecord)


class Store(Protocol):
    """Where outcomes are looked for before a unit is run, and kept when it has ended."""

    def find(self, unit: Unit) -> Outcome | None:
        """Return the outcome of a unit, or None where it has to be run."""

    def keep(self, unit: Unit, outcome: Outcome) -> Outcome:
        """Keep an outcome; return it as it will be found again."""

    def close(self) -> None:
        """Let others add to what is kept."""


class Nowhere:
    """Keeps nothing: every unit is run, and its outcome is in memory alone."""

    def find(self, _unit: Unit) -> None:
        """Find nothing."""

    def keep(self, _unit: Unit, outcome: Outcome) -> Outcome:
        """Return the outcome."""
        return outcome

    def close(self) -> None:
        """Do nothing."""


NOWHERE = Nowhere()


@dataclass(frozen=True)
class Conditions:
    """What the units of a case share: the ``data``, as :class:`Prepared` has it under seed 0, and what is kept.

    A unit may keep more. ``own`` are the SHA-256 of estimators in files of the user's own, by name.
    """

    data: str
    keep: frozenset[str] = frozenset()
    own: Mapping[str, str] = field(default_factory=dict)

    def key(self, unit: Unit) -> UnitKey:
        """Return everything that the outcome of a unit depends on."""
        return UnitKey(
            data=self.data,
            seed=unit.seed,
            estimator=unit.estimator,
            settings=settings_of_a_run(unit.settings, unit.estimator),
            keep=tuple(sorted(self.keep | unit.requested.keep)),
            faults=unit.requested.faults,
            code=_code("" if unit.entry is None else unit.entry.own_digest),
            versions=numeric_versions(),
        )

    def fit(self, key: UnitKey) -> bool:
        """Say whether a key can be that of a unit of this case, with some seed, estimator and settings."""
        ours = (self.data, _code(self.own.get(key.estimator, "")), numeric_versions())
        return (key.data, key.code, key.versions) == ours and self.keep <= set(key.keep)


def _code(own: str) -> str:
    """Return the SHA-256 of all code that runs for an estimator, which may be ``own``, the SHA-256 of a user's file."""
    return hashlib.sha256(f"{code_digest()}{own}".encode()).hexdigest() if own else code_digest()


def settings_of_a_run(settings: Settings, estimator: str) -> dict[str, object]:
    """Return the settings that a run depends on: all but the number of seeds and the requested metrics."""
    values = as_values(settings)
    for name in ("first_seed", "seeds", "metrics"):
        del values[name]
    values["estimators"] = {name: options for name, options in values["estimators"].items() if name == estimator}
    return values


class OutcomeStore:
    """The outcomes in a run directory; until it is closed no other process adds to them.

    ``found`` counts the units that were there. Raises DataError where the file is damaged, OutputError where it cannot
    be written or another process does so.
    """

    def __init__(self, directory: Path, conditions: Conditions) -> None:
        self.found = 0
        self._directory, self._conditions = directory, conditions
        self._path = directory / OUTCOMES
        self._lines = LineFile(self._path) if self._path.exists() else None
        self._records: dict[bytes, list[OutcomeRecord]] = {}
        self._unchecked = 0
        try:
            for record in _records_in(self._path):
                if isinstance(record, OutcomeRecord):
                    self._records.setdefault(record.unit.text(), []).append(record)
                self._unchecked += type(record) is UncheckedRecord
        except BaseException:
            self.close()
            raise

    @property
    def unusable(self) -> int:
        """Return how many outcomes are of other data, code or repairs, so that no unit of the case can use them."""
        of_others = (not self._conditions.fit(one.unit) for records in self._records.values() for one in records)
        return self._unchecked + sum(of_others)

    @property
    def is_there(self) -> bool:
        """Say whether anything is kept."""
        return self._lines is not None

    def find(self, unit: Unit) -> Outcome | None:
        """Return the outcome of a unit with everything that is requested of it, or None."""
        if unit.build is not None:  # a function, which cannot be told from another of its name
            return None
        metric_keys = unit.settings.metrics.requested()
        for record in self._records.get(self._conditions.key(unit).text(), []):
            if set(metric_keys) <= set(record.requested):
                files = self._unchanged(record.files)
                if not unit.keep_trajectories or files.keys() == _names(unit, record.final_is_causal, record.outputs):
                    self.found += 1
                    return replace(outcome_of_record(record, metric_keys), files=files)
        return None

    def keep(self, unit: Unit, outcome: Outcome) -> Outcome:
        """Write the trajectories of an outcome where it has any, then its line."""
        if unit.build is not None:
            return outcome
        if self._lines is None:
            self._lines = LineFile(self._path)
        texts = {trajectory_file(unit, output): text.encode() for output, text in outcome.tum.items()}
        if texts:
            self._lines.append(msgspec.json.encode(FilesRecord(files=tuple(texts))))
            self._write(texts)
        digests = {name: hashlib.sha256(text).hexdigest() for name, text in texts.items()}
        metric_keys = unit.settings.metrics.requested()
        line = line_of(record_of(outcome, self._conditions.key(unit), metric_keys, digests))
        self._lines.append(line)
        kept = _DECODER.decode(line)
        assert isinstance(kept, OutcomeRecord)
        return outcome_of_record(kept, metric_keys)

    def close(self) -> None:
        """Let other processes add to the file."""
        if self._lines is not None:
            self._lines.close()
            self._lines = None

    def _write(self, texts: Mapping[str, bytes]) -> None:
        try:
            for name, text in texts.items():
                path = self._directory / name
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_bytes(text)
        except OSError as error:
            why = error.strerror or error
            raise OutputError(f"{self._directory / name} cannot be written ({why}); make room, and repeat") from error

    def _unchanged(self, files: Mapping[str, str]) -> dict[str, str]:
        """Return those of some files that are there as they were written."""
        return {name: digest for name, digest in files.items() if _digest(self._directory / name) == digest}


def trajectory_file(unit: Unit, output: Output) -> str:
    """Return where in a run directory the trajectory of a unit's output is kept."""
    return f"{_TRAJECTORIES}/seed-{unit.seed}/{plain_name(unit.estimator)}_{output}.tum"


def _names(unit: Unit, final_is_causal: bool, outputs: Iterable[Output]) -> set[str]:
    both: tuple[Output, ...] = ("causal", "final")
    return {trajectory_file(unit, output) for output in (both if final_is_causal else outputs)}


def files_of_ours(directory: Path) -> frozenset[str]:
    """Return the file of outcomes in a directory, if it is one, and the files that its lines say were written."""
    try:
        content = read_input(directory / OUTCOMES)
    except DataError:
        return frozenset()
    if not (content.startswith(_OUR_START) or _OUR_START.startswith(content)):
        return frozenset()
    named = (line for line in whole_lines(content) if line.startswith(_FILES_START))
    return frozenset({OUTCOMES, *(name for line in named for name in _files_named(line))})


def _files_named(line: bytes) -> tuple[str, ...]:
    try:
        record = _DECODER.decode(line)
    except msgspec.DecodeError:
        return ()
    named = record.files if isinstance(record, FilesRecord) else ()
    return tuple(name for name in named if PurePosixPath(name).parts[:1] == (_TRAJECTORIES,) and ".." not in name)


def _records_in(path: Path) -> Iterable[UncheckedRecord | FilesRecord]:
    """Yield what the lines of a file hold; a last line without its end was cut off by a kill and is not read."""
    if not path.exists():
        return
    for number, line in enumerate(whole_lines(read_input(path)), start=1):
        try:
            record = _DECODER.decode(line)
        except msgspec.DecodeError as error:
            what = " ".join(str(error).split())
            raise DataError(f"{path}, line {number}: is no outcome ({what}); delete the line, and repeat") from error
        if isinstance(record, OutcomeRecord) and not _is_as_written(line, record):
            raise DataError(
                f"{path}, line {number}: was changed since it was written, for its checksum is another; delete the "
                "line, and repeat: its run is made anew"
            )
        yield record


def _digest(path: Path) -> str | None:
    try:
        return hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError:
        return None
