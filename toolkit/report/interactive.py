"""Comparisons from within a program or a notebook: nothing is written, tables and figures come back as values.

comparison = compare("drive", ["ekf", "batch"])
table(comparison, "ATE SE(3)", "NIS mean")
figures(comparison)["top_all"]
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from matplotlib.figure import Figure

from toolkit.audit import audit
from toolkit.datasets.io.truth_file import load_truth, with_truth
from toolkit.estimator import Build, find_all
from toolkit.experiment.monte_carlo import OverSeeds
from toolkit.experiment.workers import usable_cpus
from toolkit.initialization import start_from_measurements
from toolkit.metrics import known_metrics
from toolkit.progress import Silent
from toolkit.report import session
from toolkit.report.comparison import Comparison
from toolkit.report.figures import drawn, over_seeds
from toolkit.report.seeds_session import OverSeedsRequest, run_over_seeds
from toolkit.report.seeds_table import seeds_table
from toolkit.report.session import Request, changes_of, load_audited
from toolkit.report.table import Table, as_markdown, as_text, comparison_table, shown_metrics
from toolkit.sequence import Sequence

NOTHING_OF_ITS_OWN: Mapping[str, Build] = {}
_NOWHERE = Path()


@dataclass(frozen=True)
class ShownTable:
    """A table that a notebook shows as such and ``print`` shows as text."""

    table: Table

    def __str__(self) -> str:
        return as_text(self.table)

    def __repr__(self) -> str:
        return as_text(self.table)

    def _repr_markdown_(self) -> str:
        return as_markdown(self.table)


def compare(
    recording: str | Sequence,
    estimators: Iterable[str],
    *,
    own: Mapping[str, Build] = NOTHING_OF_ITS_OWN,
    truth: Path | None = None,
    max_frames: int | None = None,
    keep: Iterable[str] = (),
    seed: int = 0,
) -> Comparison:
    """Audit a recording, run estimators on it from the same start, and score them, as ``vislam compare`` does.

    ``recording`` is a source as on the command line, or a sequence; ``estimators`` are names, or the word for the
    whole ladder; ``own`` adds functions ``build(setup)`` under names of their own. ``truth`` is a TUM file; ``keep``
    names faults that the audit reports and leaves alone. Raises EstimatorError, DataError and VislamError as
    :func:`toolkit.report.session.compare_all` does.
    """
    names = tuple(estimators)
    entries = find_all(names)
    builds = {name: entry.load() for name, entry in entries.items()} | dict(own)
    judged_by = None if truth is None else load_truth(truth)
    if isinstance(recording, str):
        audited = load_audited(recording, judged_by, frozenset(keep), seed)
    else:
        audited = audit(recording if judged_by is None else with_truth(recording, judged_by), frozenset(keep))
    if max_frames is not None:
        audited = replace(audited, sequence=audited.sequence.truncated(max_frames))
    prior = start_from_measurements(audited.sequence)
    compared = session.compare(audited, prior, builds, lambda _: Silent())
    return replace(compared, changes=changes_of(Request((), names, _NOWHERE), entries))


def compare_over_seeds(
    source: str,
    estimators: Iterable[str],
    seeds: int,
    *,
    max_frames: int | None = None,
    first_seed: int = 0,
    workers: int | None = None,
) -> OverSeeds:
    """Repeat a comparison on a simulated source over seeds, in processes side by side (default: one a CPU).

    Only estimators that are found by name can run in other processes. Raises as :func:`compare` does.
    """
    request = Request((source,), tuple(estimators), _NOWHERE, max_frames=max_frames, seed=first_seed)
    asked = OverSeedsRequest(request, seeds, workers or usable_cpus())
    return run_over_seeds(source, asked, find_all(request.estimators), lambda _: Silent())[0]


def table(result: Comparison | OverSeeds, *columns: str) -> ShownTable:
    """Return the table of a result, or only the columns named, in the order given; see :func:`columns_of`.

    Columns are metrics, by key or by name. Raises VislamError for a name that no metric has.
    """
    chosen = columns or None
    whole = comparison_table(result, chosen) if isinstance(result, Comparison) else seeds_table(result, chosen)
    return ShownTable(whole)


def columns_of(result: Comparison | OverSeeds) -> tuple[str, ...]:
    """Return the names by which :func:`table` knows the metrics that have a value in a result."""
    if isinstance(result, Comparison):
        return tuple(metric.name for metric in shown_metrics(result, "all"))
    return tuple(m.name for m in known_metrics() if any(group.spread(m.key) for group in result.groups))


def figures(result: Comparison | OverSeeds) -> dict[str, Figure]:
    """Draw every figure that there is data for; return them by name, as ``vislam compare`` names their files."""
    drawings = drawn(result) if isinstance(result, Comparison) else over_seeds.draw(result)
    return {name: figure for name, _, figure in drawings}
