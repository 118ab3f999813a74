"""The report as one HTML file that opens from disk: what run directories hold, laid side by side.

Reading order: run_files (what is read) -> payload (what is shown of it) -> page (how it becomes one file). The page
itself is page.html, style.css and the scripts in ``scripts``, which :mod:`~toolkit.report.html.page` puts together.
"""

from collections.abc import Sequence
from pathlib import Path

from toolkit.files import replaced_file

__all__ = ["write_html"]


def write_html(directories: Sequence[Path], target: Path) -> None:
    """Write the report of run directories, in the order given, to a file; the same directories give the same bytes.

    Raises DataError for a directory that cannot be read as one, OutputError where ``target`` cannot be written;
    nothing is left behind then.
    """
    # Here, because pages of other systems' trajectories are made without what reads a run directory.
    from toolkit.report.html.page import page_text
    from toolkit.report.html.payload import payload_of
    from toolkit.report.html.run_files import read_run

    runs = [read_run(directory) for directory in directories]
    text = page_text(payload_of(runs))
    with replaced_file(target) as partial:
        partial.write_text(text, encoding="utf-8")
