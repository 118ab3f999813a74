"""Where the results of a comparison go: a directory for each sequence, checked before anything runs."""

from collections.abc import Iterable, Sequence
from pathlib import Path

from toolkit.experiment.comparison import plain_name
from toolkit.experiment.pipeline import Case
from toolkit.files import check_parent
from toolkit.report.run_directory import check_run_directory


def directories_for(cases: Sequence[Case], out: Path) -> tuple[Path, ...]:
    """Return the run directory of each case: ``out`` for a single one, else folders in it by the sequences' names.

    Raises OutputError where one cannot be written or holds something else.
    """
    names = unique_names(case.name for case in cases)
    directories = (out,) if len(names) == 1 else tuple(out / name for name in names)
    if len(names) > 1:
        check_parent(out)
    for directory in directories:
        check_run_directory(directory)
    return directories


def unique_names(names: Iterable[str]) -> list[str]:
    """Turn sequence names into directory names, all different; a second ``drive`` becomes ``drive-2``."""
    taken: list[str] = []
    for name in names:
        plain = plain_name(name) or "sequence"
        candidate, n = plain, 2
        while candidate in taken:
            candidate, n = f"{plain}-{n}", n + 1
        taken.append(candidate)
    return taken
