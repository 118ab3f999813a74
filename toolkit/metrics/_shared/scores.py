"""The answer of a metric: a number, or the reason why there is none."""

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field


class Unavailable(Exception):  # noqa: N818 - not an error: the run or the sequence simply lacks what the metric needs
    """Raised where a metric cannot be computed; its message is the reason the reader gets."""


@dataclass(frozen=True)
class Scores:
    """Values by metric key, None where there is none, and notes by key: reasons and remarks.

    A value that is not finite becomes None, with that as its reason.
    """

    values: dict[str, float | None]
    notes: dict[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        bad = [key for key, value in self.values.items() if value is not None and not math.isfinite(value)]
        object.__setattr__(self, "values", self.values | dict.fromkeys(bad))
        object.__setattr__(self, "notes", self.notes | dict.fromkeys(bad, "the result is not finite"))

    def remarked(self, keys: Iterable[str], remark: str) -> "Scores":
        """Return the scores with a remark on those of the keys that have a value; an empty remark adds nothing."""
        added = {key: remark for key in keys if remark and self.values[key] is not None}
        return Scores(self.values, self.notes | added)


def evaluate(metrics: Mapping[str, Callable[[], float]]) -> Scores:
    """Compute each metric by itself, so that one that is unavailable leaves the others their values."""
    values: dict[str, float | None] = {}
    notes: dict[str, str] = {}
    for key, compute in metrics.items():
        try:
            values[key] = compute()
        except Unavailable as reason:
            values[key], notes[key] = None, str(reason)
    return Scores(values, notes)
