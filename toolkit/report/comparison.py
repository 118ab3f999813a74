"""The value every part of a report reads: one sequence, what was found in it, and every estimator's scored outputs."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from collections.abc import Mapping

    from toolkit.audit import Finding
    from toolkit.estimate import Output, Run, Status
    from toolkit.metrics import Scores
    from toolkit.sequence import Prior, Sequence


@dataclass(frozen=True, eq=False)
class Row:
    """One kind of output of one run with its scores: a line of the table."""

    run: Run
    output: Output
    scores: Scores

    @property
    def estimator(self) -> str:
        """Return the estimator's name."""
        return self.run.estimator

    @property
    def status(self) -> Status:
        """Return how the run ended."""
        return self.run.status

    @property
    def label(self) -> str:
        """Return the kind of output, or "both" where one line serves for the two."""
        return "both" if self.run.final_is_causal else self.output


@dataclass(frozen=True, eq=False)
class Comparison:
    """Several estimators on the same packets of one sequence, from the same start.

    ``sequence`` is what the estimators read, after any repair; ``findings`` is what the audit saw in the
    recording before; ``rows`` are in the order of ``runs``, causal before final. ``changes`` says, on a ladder
    only, what each estimator changes against the rung before.
    """

    sequence: Sequence
    findings: tuple[Finding, ...]
    prior: Prior
    runs: tuple[Run, ...]
    rows: tuple[Row, ...]
    changes: Mapping[str, str] = field(default_factory=dict)

    @property
    def lines(self) -> tuple[Row, ...]:
        """Return the rows to print: a final answer that only repeats the causal one has no line of its own."""
        return tuple(row for row in self.rows if not (row.output == "final" and row.run.final_is_causal))

    @property
    def all_ok(self) -> bool:
        """Say whether every estimator ran to the end with a plausible answer."""
        return all(run.status == "ok" for run in self.runs)


Start = Literal["measurements", "truth"]


def plain_name(name: str) -> str:
    """Return a name as one of a file, without blanks, brackets and the like; it may come out empty."""
    return re.sub(r"[^A-Za-z0-9._-]+", "_", name).strip("._")


def outputs_of(run: Run) -> tuple[Output, ...]:
    """Return the kinds of output a run gave; a run that gave none keeps one line, so that it is never left out."""
    given: list[Output] = []
    if run.causal is not None:
        given.append("causal")
    if run.final is not None:
        given.append("final")
    return tuple(given) or ("final",)
