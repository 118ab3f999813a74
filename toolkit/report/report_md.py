"""``report.md``: the table, the figures and, in plain words, what they mean and how far to trust them."""

from collections.abc import Iterable, Iterator, Mapping

from toolkit.experiment.comparison import Comparison
from toolkit.report.messages import finding_lines, missing_lines, remark_lines, sequence_line, status_lines, truth_lines
from toolkit.report.table import as_markdown, comparison_table

_HOW_TO_READ = """\
Every estimator read the same packets, with the same noise, from the same start. A **causal** line is scored on what the
estimator knew at each frame, a **final** line on what it said when it had seen everything; compare like with like.
A line named for a file, as in `openvins (est.txt)`, was not run here: what another system made of the recording was
read from that file and scored by the same rules.

- **pairs, cover**: how many poses were compared with the truth, and the share of the frames that have an answer at all.
  An error over half a recording is not half an error: read it beside its coverage.
- **ATE**: root mean square position error after the alignment that is named with it. SE(3) moves and turns the whole
  trajectory to fit best; yaw moves it and turns it about the vertical only, so that errors in roll and pitch count.
- **RPE 100 m**, **KITTI trans**: drift over pieces of the path, in percent of their length.
- **end drift**: the error at the end of the path, in percent of its length.
- **reproj own**: median distance in the image between a sighting and the estimator's own landmark.
- **reproj held-out**: the same for one track in ten that no estimator ever saw. It needs no truth and cannot be won by
  fitting the data too closely.
- **NIS**: the normalised innovation squared over its degrees of freedom; 1 where an estimator's stated uncertainty is
  honest, above 1 where it is too sure of itself.
- **frame, total**: wall clock of one step and of the whole run.

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
        sequence_line(comparison.sequence) + ".",
        as_markdown(comparison_table(comparison)),
        *_section("notes", [*status_lines(comparison), *truth_lines(comparison), *missing_lines(comparison)]),
        *_section("remarks", remark_lines(comparison)),
        *_section("start", [comparison.prior.source]),
        *_section("audit", finding_lines(comparison)),
        *_section("facts", comparison.sequence.provenance.facts),
        "## Figures",
        *(f"![{caption}](figures/{name})\n\n*{caption}*" for name, caption in captions.items()),
        "## How to read the table",
        _HOW_TO_READ,
    ]
    return "\n\n".join(parts) + "\n"


def _section(key: str, entries: Iterable[str]) -> Iterator[str]:
    lines = [f"- {entry}" for entry in entries]
    if lines:
        yield f"## {_TITLES[key]}"
        yield "\n".join(lines)
