"""``report.md``: the table, the figures and, in plain words, what they mean and how far to trust them."""

from collections.abc import Iterable, Iterator, Mapping

from toolkit.report.comparison import Comparison
from toolkit.report.messages import finding_lines, header_lines, missing_lines, remark_lines, status_lines, truth_lines
from toolkit.report.table import as_markdown, comparison_table, explained_metrics

_HOW_TO_READ = """\
Every estimator read the same packets, with the same noise, from the same start. A **causal** line is scored on what the
estimator knew at each frame, a **final** line on its answer after the last frame; compare like with like.
A line named for a file, as in `openvins (est.txt)`, was not run here: what another system made of the recording was
read from that file and scored by the same rules. An error over half a recording is not half an error: read it beside
the matched pairs and the coverage above the table, or in it where the rows differ.

{metrics}

`metrics.json` has every metric, and for each one that is missing the reason."""

_TITLES = {
    "start": "Where every estimator started",
    "audit": "What the audit found in the recording",
    "facts": "What to know about this recording",
    "notes": "Notes",
    "remarks": "Remarks on single numbers",
}


def report_text(comparison: Comparison, captions: Mapping[str, str]) -> str:
    """Return the report; ``captions`` maps the file names of the figures, beside the report, to their captions."""
    parts = [
        f"# {' / '.join(run.estimator for run in comparison.runs)} on {comparison.sequence.name}",
        *(f"{line}." for line in header_lines(comparison)),
        as_markdown(comparison_table(comparison)),
        *_section("notes", [*status_lines(comparison), *truth_lines(comparison), *missing_lines(comparison)]),
        *_section("remarks", remark_lines(comparison)),
        *_section("start", [comparison.prior.source]),
        *_section("audit", finding_lines(comparison)),
        *_section("facts", comparison.sequence.provenance.facts),
        "## Figures",
        *(f"![{caption}](figures/{name})\n\n*{caption}*" for name, caption in captions.items()),
        "## How to read the table",
        _HOW_TO_READ.format(metrics=_meanings()),
    ]
    return "\n\n".join(parts) + "\n"


def _meanings() -> str:
    """Return a line for each metric of the table."""
    return "\n".join(f"- **{metric.name}**: {metric.meaning}" for metric in explained_metrics())


def _section(key: str, entries: Iterable[str]) -> Iterator[str]:
    lines = [f"- {entry}" for entry in entries]
    if lines:
        yield f"## {_TITLES[key]}"
        yield "\n".join(lines)
