"""Read a baseline back; whatever is wrong with the file is told in one line, with the place."""

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, cast

from toolkit.estimate import Output, Status
from toolkit.experiment.units import OUTPUTS
from toolkit.gate import releases
from toolkit.gate.baseline import Baseline, BaselineError, Bounds, Case, Criterion, Measured, Series, Values
from toolkit.gate.baseline_json import SCHEMA

_STATUSES: tuple[Status, ...] = ("ok", "diverged", "failed")
_WORSE = ("larger", "away from 1")


@dataclass(frozen=True)
class _Item:
    """An object of the document and where it stands, for messages."""

    file: str
    place: str
    content: dict[str, Any]

    def wrong(self, what: str) -> BaselineError:
        return BaselineError(f"{self.file}: {self.place} {what}; make the baseline again with vislam baseline")

    def get(self, name: str, *kinds: type) -> Any:
        value = self.content.get(name)
        if type(value) not in kinds or (isinstance(value, float) and not math.isfinite(value)):
            raise self.wrong(f"has no usable {name!r}")
        return value

    def item(self, name: str) -> "_Item":
        return _Item(self.file, f"{self.place}.{name}", self.get(name, dict))

    def items(self) -> list[tuple[str, "_Item"]]:
        return [(name, self.item(name)) for name in self.content]

    def number(self, name: str, above: float) -> float:
        value = float(self.get(name, float, int))
        if value <= above:
            raise self.wrong(f"has {name!r} of {value:g}, which is not above {above:g}")
        return value

    def row(self, name: str, count: int, *kinds: type) -> tuple[Any, ...]:
        """Return a list with an entry of one of the kinds for each seed."""
        given = self.get(name, list)
        bad = any(type(x) not in kinds or (isinstance(x, float) and not math.isfinite(x)) for x in given)
        if len(given) != count or bad:
            raise self.wrong(f"does not have an entry a seed in {name!r}")
        return tuple(given)


def load_baseline(path: Path) -> Baseline:
    """Read a baseline from its file, or from a folder the one made with the releases installed here.

    Raises BaselineError where there is none, or it is not one.
    """
    if path.is_dir():
        return _of_these_releases(path)
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise BaselineError(f"{path}: cannot be read ({error.strerror}); vislam baseline makes one") from error
    except ValueError as error:
        raise BaselineError(f"{path}: is not JSON ({error}); make the baseline again with vislam baseline") from error
    if not isinstance(content, dict) or content.get("schema") != SCHEMA:
        raise BaselineError(f"{path}: is no baseline of this version ({SCHEMA}); make it again with vislam baseline")
    return _baseline(_Item(str(path), "the document", content))


def _of_these_releases(folder: Path) -> Baseline:
    known = {path: load_baseline(path) for path in sorted(folder.glob("*.json"))}
    fitting = {path: one for path, one in known.items() if not releases.differences(one.releases)}
    if len(fitting) == 1:
        return next(iter(fitting.values()))
    here = ", ".join(f"{name} {release}" for name, release in releases.installed().items())
    if not fitting:
        raise BaselineError(f"{folder}: none of {len(known)} baselines is for {here}; make one with vislam baseline")
    raise BaselineError(f"{folder}: {', '.join(path.name for path in fitting)} are all for {here}; name one of them")


def check_releases(baseline: Baseline, name: str) -> None:
    """Raise BaselineError where the baseline was made with other releases than are installed."""
    others = releases.differences(baseline.releases)
    if others:
        raise BaselineError(
            f"{name}: made with {'; '.join(others)}, which alone may change results; make a baseline with these "
            "releases, or compare all the same with --allow-other-releases"
        )


def _baseline(item: _Item) -> Baseline:
    rate = item.number("false_alarm_rate", 0.0)
    if rate >= 1.0:
        raise item.wrong("has a false_alarm_rate of 1 or more")
    cases = item.get("sequences", list)
    if not cases or not all(isinstance(case, dict) for case in cases):
        raise item.wrong("lists no sequences")
    return Baseline(
        {name: item.item("releases").get(name, str) for name in item.get("releases", dict)},
        tuple(_case(_Item(item.file, f"sequences[{i}]", case)) for i, case in enumerate(cases)),
        _bounds(item.item("bounds")),
        rate,
        {name: str(value) for name, value in item.get("made_by", dict).items()},
    )


def _bounds(item: _Item) -> Bounds:
    kinds = (("simulated", "margin_percent"), ("recorded", "bound_percent"))
    simulated, recorded = (
        {key: _criterion(one, percent) for key, one in item.item(kind).items()} for kind, percent in kinds
    )
    return Bounds(simulated, recorded, item.number("coverage_points", -1e-9), item.number("speed_ratio", 1.0))


def _criterion(item: _Item, percent: str) -> Criterion:
    worse = item.get("worse", str)
    if worse not in _WORSE:
        raise item.wrong(f"has 'worse' of {worse!r}, which is none of {', '.join(_WORSE)}")
    return Criterion(cast(Literal["larger", "away from 1"], worse), item.number(percent, -1e-9))


def _case(item: _Item) -> tuple[Case, Measured]:
    simulated = item.get("kind", str) == "simulated"
    duration_s = None if item.content.get("duration_s") is None else item.number("duration_s", 0.0)
    seeds = tuple(item.get("seeds", list))
    if not seeds or any(type(seed) is not int or seed < 0 for seed in seeds) or len(set(seeds)) != len(seeds):
        raise item.wrong("has no usable 'seeds'")
    runs = {name: _series(one, len(seeds)) for name, one in item.item("runs").items()}
    if not runs:
        raise item.wrong("has no runs")
    truth = item.get("truth", str, type(None))
    case = Case(item.get("source", str), simulated, seeds, tuple(runs), duration_s, truth)
    hashes, prints = (item.row(name, len(seeds), str) for name in ("hashes", "fingerprints"))
    return case, Measured(hashes, prints, runs)


def _series(item: _Item, seeds: int) -> Series:
    status = item.row("status", seeds, str)
    if not set(status) <= set(_STATUSES):
        raise item.wrong(f"has a status that is none of {', '.join(_STATUSES)}")
    given: list[Output] = [output for output in OUTPUTS if output in item.content]
    outputs = {output: _metrics(item.item(output), seeds) for output in given}
    return Series(status, item.row("speed", seeds, float, int, type(None)), outputs)


def _metrics(item: _Item, seeds: int) -> dict[str, Values]:
    return {key: item.row(key, seeds, float, int, type(None)) for key in item.content}
