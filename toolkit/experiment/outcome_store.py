"""Outcomes kept on disk: each is added to a file of the run directory as it ends, and is found there afterwards.

An outcome is read back exactly as it was kept. An outcome of other data, settings or code has another key and is never
returned instead. A run whose process died is not kept: it is tried again. A line of the file ``outcomes.jsonl`` holds
one outcome, exactly, and all that it depends on (docs/scaling.md).
"""

import hashlib
import math
import platform
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cache
from importlib.metadata import PackageNotFoundError, entry_points, version
from importlib.util import find_spec
from pathlib import Path, PurePosixPath
from typing import Annotated, Any

import msgspec
import numpy as np
from msgspec import Meta, Struct

from toolkit import datasets, metrics, registry
from toolkit.answers import Output, Status
from toolkit.errors import DataError, OutputError
from toolkit.experiment.units import Outcome, Scored, Unit
from toolkit.files.documents import of_attributes
from toolkit.files.reading import read_input
from toolkit.files.writing import LineFile, plain_name, whole_lines
from toolkit.geometry import Array
from toolkit.metrics import Scores, repeated, without_requests
from toolkit.settings import Settings, as_values

# JSON has neither NaN, which is null, nor infinities, which are the texts inf and -inf.
Number = float | str | None
Series = Annotated[tuple[Number, ...], Meta(description="one a frame; null where unknown")]
OUTCOMES, _TRAJECTORIES = "outcomes.jsonl", "trajectories"
# Every line of such a file begins so. Those of the first version had no checksum, and are of other code.
_OUR_START, _OF_VERSION_1 = b'{"schema":"vislam.outcome', b'{"schema":"vislam.outcome/1"'
_FILES_START = b'{"schema":"vislam.outcome-files/1"'
# Series of an output.
_SERIES = ("nees_pose", "position_m", "drift_m", "heldout_px")
# A line ends with its checksum.
_CHECKSUM = slice(-66, -2)
# Distributions by their name in a manifest.
NUMERIC_PACKAGES = {
    "numpy": "numpy",
    "scipy": "scipy",
    "gtsam": "gtsam",
    "opencv": "opencv-python-headless",
    "numba": "numba",
}
# The toolkit's layers above the experiment, which it cannot import: they change no result.
_ABOVE = ("api.py", "cli", "evaluation", "gate", "report", "verify.py")
_CODE = (".py", ".so", ".pyd")
_ANNOUNCED = (registry.ENTRY_POINT_GROUP, metrics.ENTRY_POINT_GROUP, datasets.ENTRY_POINT_GROUP)


@cache
def code_digest() -> str:
    """Return the SHA-256 of the code that loads, runs and scores: the toolkit's, and every announced package's."""
    digest = hashlib.sha256()
    for name, path in sorted(_code_files()):
        digest.update(f"{name}\0{hashlib.sha256(path.read_bytes()).hexdigest()}\n".encode())
    return digest.hexdigest()


@cache
def numeric_versions() -> dict[str, str]:
    """Return the versions of Python and of the packages that compute, by name; empty for one not installed."""
    return {"python": platform.python_version()} | {
        name: installed_version(package) or "" for name, package in NUMERIC_PACKAGES.items()
    }


@cache
def installed_version(package: str) -> str | None:
    """Return the version of a distribution, or None where it is not installed."""
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def _code_files() -> Iterator[tuple[str, Path]]:
    """Yield every file of code by a name that does not depend on where it is installed."""
    toolkit = Path(__file__).parents[1]
    for name, path in _files_of("toolkit", toolkit):
        if path.relative_to(toolkit).parts[0] not in _ABOVE:
            yield name, path
    packages = {point.value.split(".")[0] for group in _ANNOUNCED for point in entry_points(group=group)}
    for package in packages - {"toolkit"}:
        spec = find_spec(package)
        for folder in [] if spec is None else spec.submodule_search_locations or []:
            yield from _files_of(package, Path(folder))


def _files_of(package: str, folder: Path) -> Iterator[tuple[str, Path]]:
    for path in folder.rglob("*"):
        if path.suffix in _CODE:
            yield f"{package}/{path.relative_to(folder).as_posix()}", path


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


class OutcomeRecord(Struct, frozen=True, kw_only=True, tag_field="schema", tag="vislam.outcome/2"):
    """An outcome as its line holds it; a final output that only repeats the causal one is not there."""

    unit: UnitKey
    requested: Annotated[tuple[str, ...], Meta(description="metrics on request that were computed")]
    status: Status
    sequence_hash: Annotated[str, Meta(description="SHA-256 of the recording it read")]
    final_is_causal: bool
    outputs: dict[Output, ScoredRecord]
    files: Annotated[dict[str, str], Meta(description="SHA-256 of its trajectories by their relative paths")]
    log: tuple[str, ...]
    sha256: Annotated[str, Meta(description="of the line with this empty: a line that was edited is refused")] = ""


class FilesRecord(Struct, frozen=True, kw_only=True, tag_field="schema", tag="vislam.outcome-files/1"):
    """Files that are written next, so that they are known as ours whatever happens then."""

    files: tuple[str, ...]


def _line_of(record: OutcomeRecord) -> bytes:
    line = msgspec.json.encode(record)
    return line[:-2] + hashlib.sha256(line).hexdigest().encode() + line[-2:]


def _is_as_written(line: bytes) -> bool:
    bare = line[: _CHECKSUM.start] + line[_CHECKSUM.stop :]
    return hashlib.sha256(bare).hexdigest().encode() == line[_CHECKSUM]


def _outcome_of(record: OutcomeRecord, requested: tuple[str, ...]) -> Outcome:
    """Return the outcome of a line to the bit, without metrics on request that are not ``requested``."""
    outputs = {output: _scored(one, requested) for output, one in record.outputs.items()}
    if record.final_is_causal:
        outputs["final"] = replace(outputs["causal"], scores=repeated(outputs["causal"].scores))
    return Outcome(
        record.unit.seed, record.unit.estimator, record.status, outputs, record.log, record.sequence_hash,
        record.final_is_causal, files=record.files,
    )  # fmt: skip


def _scored_record(scored: Scored) -> ScoredRecord:
    return ScoredRecord(
        values={k: v.item() if isinstance(v, np.generic) else v for k, v in scored.scores.values.items()},
        notes=dict(scored.scores.notes),
        nis_dof=None if scored.nis_dof is None else _number(float(scored.nis_dof)),
        **{name: tuple(map(_number, getattr(scored, name).tolist())) for name in _SERIES},
    )


def _scored(record: ScoredRecord, requested: tuple[str, ...]) -> Scored:
    scores = without_requests(Scores(dict(record.values), dict(record.notes)), requested)
    nis_dof = None if record.nis_dof is None else float(record.nis_dof)
    return Scored(scores, nis_dof=nis_dof, **{name: _array(getattr(record, name)) for name in _SERIES})


def _number(value: float) -> Number:
    return value if math.isfinite(value) else None if math.isnan(value) else str(value)


def _array(numbers: tuple[Number, ...]) -> Array:
    return np.array([math.nan if number is None else number for number in numbers], dtype=float)


_DECODER = msgspec.json.Decoder(OutcomeRecord | FilesRecord)


@dataclass(frozen=True)
class Conditions:
    """What the units of a case share: the ``data``, as :class:`Prepared` has it under seed 0, and what is kept.

    A unit may keep more. ``own`` are the SHA-256 of estimators in files of the user's own, by name.
    """

    data: str
    keep: frozenset[str] = frozenset()
    own: Mapping[str, str] = field(default_factory=dict)

    def key(self, unit: Unit) -> UnitKey:
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
        self._of_version_1 = 0
        try:
            for number, line in enumerate(whole_lines(read_input(self._path)) if self._lines else (), start=1):
                self._read(line, number)
        except BaseException:
            self.close()
            raise

    def _read(self, line: bytes, number: int) -> None:
        """Take in a line; a last one without its end, cut off by a kill, is none."""
        if line.startswith(_OF_VERSION_1):
            self._of_version_1 += 1
            return
        try:
            record = _DECODER.decode(line)
        except msgspec.DecodeError as error:
            why = f"is no outcome ({' '.join(str(error).split())}); delete the line, and repeat"
            raise DataError(f"{self._path}, line {number}: {why}") from error
        if isinstance(record, OutcomeRecord) and not _is_as_written(line):
            raise DataError(
                f"{self._path}, line {number}: was changed since it was written, for its checksum is another; delete "
                "the line, and repeat: its run is made anew"
            )
        if isinstance(record, OutcomeRecord):
            self._records.setdefault(record.unit.text(), []).append(record)

    @property
    def unusable(self) -> int:
        """Return how many outcomes are of other data, code or repairs, so that no unit of the case can use them."""
        of_others = (not self._conditions.fit(one.unit) for records in self._records.values() for one in records)
        return self._of_version_1 + sum(of_others)

    def find(self, unit: Unit) -> Outcome | None:
        """Return the outcome of a unit with everything that is requested of it, or None."""
        if unit.build is not None:  # a function, which cannot be told from another of its name
            return None
        metric_keys = unit.settings.metrics.requested()
        for record in self._records.get(self._conditions.key(unit).text(), []):
            if set(metric_keys) <= set(record.requested):
                outcome = _outcome_of(record, metric_keys)
                unchanged = {k: v for k, v in record.files.items() if _digest(self._directory / k) == v}
                wanted = {trajectory_file(unit, output) for output in outcome.outputs}
                if not unit.keep_trajectories or unchanged.keys() == wanted:
                    self.found += 1
                    return replace(outcome, files=unchanged)
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
        metric_keys, repeats = unit.settings.metrics.requested(), outcome.final_is_causal
        outputs = {k: _scored_record(v) for k, v in outcome.outputs.items() if not (repeats and k == "final")}
        record = of_attributes(
            OutcomeRecord, outcome, unit=self._conditions.key(unit), requested=metric_keys, outputs=outputs,
            files=digests, sha256="",
        )  # fmt: skip
        self._lines.append(_line_of(record))
        return _outcome_of(record, metric_keys)

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


def trajectory_file(unit: Unit, output: Output) -> str:
    return f"{_TRAJECTORIES}/seed-{unit.seed}/{plain_name(unit.estimator)}_{output}.tum"


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


def _files_named(line: bytes) -> Iterator[str]:
    with suppress(msgspec.DecodeError):
        for name in msgspec.json.decode(line, type=FilesRecord).files:
            if PurePosixPath(name).parts[:1] == (_TRAJECTORIES,) and ".." not in name:
                yield name


def _digest(path: Path) -> str | None:
    try:
        return hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError:
        return None
