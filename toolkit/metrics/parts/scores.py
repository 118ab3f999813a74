"""The declaration of a metric, a record for each, and the result of a metric file: numbers, or the reasons for none."""

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Literal, get_args

from toolkit.errors import ExtensionError

Best = Literal["least", "most", "one", ""]
InTable = Literal["always", "where rows differ", "on request"]


@dataclass(frozen=True)
class Metric:
    """One metric: what it means and how every table, file and page shows it.

    ``meaning`` is one line with the unit; ``unit`` is the unit as written in a table, "1" for a ratio and "" for a
    count. ``heading`` are the two lines above its column, ``name`` the same in one line where it is not given. ``best``
    says which value is best: the least, the most, the one nearest 1, or "" for none. ``table`` is when the table of a
    comparison has a column for it by default, ``over_seeds`` whether the table over seeds has one.
    """

    key: str
    meaning: str
    unit: str
    heading: tuple[str, str]
    name: str = ""
    best: Best = "least"
    table: InTable = "on request"
    over_seeds: bool = False
    count: bool = False

    def __post_init__(self) -> None:
        for what, value, known in (("best", self.best, Best), ("table", self.table, InTable)):
            if value not in get_args(known):
                raise ExtensionError(f"the metric {self.key} has {what}={value!r}; it is one of {get_args(known)}")
        if not (isinstance(self.heading, tuple) and len(self.heading) == 2):
            raise ExtensionError(
                f"the metric {self.key} has heading={self.heading!r}; it is two lines, as ('ATE', 'yaw')"
            )
        object.__setattr__(self, "name", self.name or " ".join(filter(None, self.heading)))

    @property
    def column(self) -> str:
        """The heading in one line, as it reads above the column: "held-out" of "held-" and "out"."""
        above, below = self.heading
        return above + below if above.endswith("-") else " ".join(filter(None, self.heading))


class Unavailable(Exception):  # noqa: N818 - not an error: the run or the sequence simply lacks what the metric needs
    """Raised where a metric cannot be computed; its message is the reason the reader gets."""


@dataclass(frozen=True)
class Scores:
    """Values by metric key, None where there is none or it is not finite, and notes by key: reasons and remarks."""

    values: dict[str, float | None]
    notes: dict[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        bad = [key for key, value in self.values.items() if value is not None and not math.isfinite(value)]
        object.__setattr__(self, "values", self.values | dict.fromkeys(bad))
        object.__setattr__(self, "notes", self.notes | dict.fromkeys(bad, "the result is not finite"))

    @classmethod
    def none(cls, keys: Iterable[str], reason: str) -> "Scores":
        return cls({}).without(keys, reason)

    @classmethod
    def attempt(cls, metrics: Iterable[Metric], compute: "Callable[[], Scores]") -> "Scores":
        """Return computed scores of some metrics or, where these are Unavailable, no value and the reason for each."""
        try:
            return compute()
        except Unavailable as why:
            return cls.none((metric.key for metric in metrics), str(why))

    def __or__(self, others: "Scores") -> "Scores":
        return Scores(self.values | others.values, self.notes | others.notes)

    def without(self, keys: Iterable[str], reason: str) -> "Scores":
        """Return the scores without a value for the keys, for one reason."""
        gone = tuple(keys)
        return Scores(self.values | dict.fromkeys(gone), self.notes | dict.fromkeys(gone, reason))

    def remarked(self, keys: Iterable[str], remark: str) -> "Scores":
        """Return the scores with a remark on those of the keys that have a value; an empty remark adds nothing."""
        added = {key: remark for key in keys if remark and self.values[key] is not None}
        return Scores(self.values, self.notes | added)


def evaluate(metrics: Mapping[str, Callable[[], float]]) -> Scores:
    """Compute each metric separately, so that an unavailable one does not affect the others."""
    values: dict[str, float | None] = {}
    notes: dict[str, str] = {}
    for key, compute in metrics.items():
        try:
            values[key] = compute()
        except Unavailable as reason:
            values[key], notes[key] = None, str(reason)
    return Scores(values, notes)
