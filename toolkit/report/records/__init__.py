"""The JSON documents a comparison or a check leaves behind, as typed records, each read from its file by a function.

Reading order: scores (one run of each estimator, or many), report (what the figures draw, what the tracks are like),
manifest; a check's are in :mod:`toolkit.gate.verdict`. How they are read and written is
:mod:`toolkit.files.documents`; :mod:`toolkit.report.schemas` writes docs/schemas.
"""

from pathlib import Path

from toolkit.files.documents import read
from toolkit.gate.verdict import OLDER_CHECKS, CheckDocument
from toolkit.report.records.manifest import Manifest
from toolkit.report.records.report import CardRecord, Report, SeedsReport
from toolkit.report.records.scores import Metrics, Seeds

__all__ = [
    "CardRecord",
    "CheckDocument",
    "Manifest",
    "Metrics",
    "Report",
    "Seeds",
    "SeedsReport",
    "read_card",
    "read_check",
    "read_manifest",
    "read_metrics",
    "read_report",
    "read_seeds",
    "read_seeds_report",
]

_REPEAT = "repeat the comparison"


def read_metrics(path: Path) -> Metrics:
    """Read a ``metrics.json``; raises DataError, in one line with the place, where it is not one."""
    return read(path, Metrics, remedy=_REPEAT)


def read_seeds(path: Path) -> Seeds:
    """Read a ``seeds.json``; raises DataError, in one line with the place, where it is not one."""
    return read(path, Seeds, remedy=_REPEAT)


def read_report(path: Path) -> Report:
    """Read the ``report.json`` of a comparison; raises DataError, in one line with the place, where it is not one."""
    return read(path, Report, remedy=_REPEAT)


def read_seeds_report(path: Path) -> SeedsReport:
    """Read a ``report.json`` over seeds; raises DataError, in one line with the place, where it is not one."""
    return read(path, SeedsReport, remedy=_REPEAT)


def read_manifest(path: Path) -> Manifest:
    """Read a ``manifest.json``; raises DataError, in one line with the place, where it is not one."""
    return read(path, Manifest, remedy=_REPEAT)


def read_check(path: Path) -> CheckDocument:
    """Read what ``vislam check --json`` wrote; raises DataError, in one line with the place, where it is not that."""
    return read(path, CheckDocument, remedy="repeat vislam check", older=OLDER_CHECKS)


def read_card(path: Path) -> CardRecord:
    """Read what ``vislam card --json`` wrote; raises DataError, in one line with the place, where it is not that."""
    return read(path, CardRecord, remedy="repeat vislam card")
