"""``report.md`` of a comparison over seeds: the table, its figures and what they mean; and the same for a terminal."""

import textwrap
from collections.abc import Iterable, Iterator, Mapping

from toolkit.experiment.comparison import Comparison
from toolkit.report.seeds_table import consistency_lines, seeds_table, status_lines
from toolkit.report.table import as_markdown, as_text

_WIDTH = 118
_OUTSIDE_BY_DESIGN = """\
Some estimators may stay outside their band, and are compared all the same. A decoupled filter, like the seed report's,
takes its map for exact when it corrects the pose and forgets that both share their errors: it counts the same
information again and again, and its covariance shrinks whatever the error does. A plain joint filter keeps the
correlations, but linearises one landmark at many different estimates of the same pose, and so believes to have
measured its heading and position, which nothing measured. The rungs after it exist to mend this: for them, being
outside the band is a defect of the estimator or of its noise."""
_HOW_TO_READ = f"""\
Every estimator read the same recording under each seed; the seed draws every error, the trajectory stays. Numbers are
means over the runs that are ok; `seeds.json` has median, spread and each seed's value of every metric.

- **ok of N**: how many runs ended well. The others are named above and are in no mean.
- **ATE none**: root mean square position error with only the first pose placed, and **std**, its standard deviation
  over the seeds. **ATE yaw**: the same error after a fit of heading and position.
- **NEES**: the squared error over what the stated covariance expects, of rotation, position and the whole pose, over
  their degrees of freedom; 1 where the covariance is honest, above where the estimator is too sure of itself.
- **NEES in band**: the share of the frames at which the pose NEES averaged over the seeds lies within the two-sided
  95 % chi-square band for that many runs: 95 % on average for a consistent estimator. The frames of a run share their
  errors, so the share itself scatters widely from one set of seeds to another.
- **NIS**: normalised innovations squared over their degrees of freedom, likewise.
- **frame, total**: wall clock of one step and of a run, with as many runs side by side as the manifest says.

{_OUTSIDE_BY_DESIGN}"""


def headline(over: Comparison) -> str:
    """Return the comparison in one line."""
    seeds = f"seeds {over.seeds[0]} to {over.seeds[-1]}"
    return f"{over.name}: {over.frames_s.size} frames, {over.frames_s[-1]:.1f} s, {over.sequence.motion_kind}, {seeds}"


def seeds_text(over: Comparison) -> str:
    """Return the comparison as plain text."""
    lines = [headline(over), "", as_text(seeds_table(over)), ""]
    for title, entries in (
        ("start", [over.prior.source]),
        ("nees", consistency_lines(over)),
        ("notes", status_lines(over)),
    ):
        lines += _section(title, entries)
    return "\n".join(lines)


def seeds_report(over: Comparison, captions: Mapping[str, str]) -> str:
    """Return the report; ``captions`` maps the file names of the figures, beside the report, to their captions."""
    parts = [
        f"# {' / '.join(over.estimators)} on {over.name}, {len(over.seeds)} seeds",
        headline(over) + ".",
        as_markdown(seeds_table(over)),
        *_bullets("Is the stated uncertainty honest?", consistency_lines(over)),
        *_bullets("Notes", status_lines(over)),
        *_bullets("Where every estimator started", [over.prior.source]),
        "## Figures",
        *(f"![{caption}](figures/{name})\n\n*{caption}*" for name, caption in captions.items()),
        "## How to read the table",
        _HOW_TO_READ,
    ]
    return "\n\n".join(parts) + "\n"


def _bullets(title: str, entries: Iterable[str]) -> Iterator[str]:
    lines = [f"- {entry}" for entry in entries]
    if lines:
        yield f"## {title}"
        yield "\n".join(lines)


def _section(title: str, entries: Iterable[str]) -> Iterator[str]:
    for i, entry in enumerate(entries):
        label = f"{title}:" if i == 0 else ""
        yield textwrap.fill(entry, _WIDTH, initial_indent=f"{label:<7}", subsequent_indent=" " * 9)
