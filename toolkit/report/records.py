"""What reads the JSON documents of the toolkit as typed records: ``read_metrics(path)`` and its kin.

Each record stands with the function that fills it; :mod:`toolkit.files.documents` reads, writes and describes them.
"""

from toolkit.files.documents import reader
from toolkit.gate.verdict import OLDER_CHECKS, Check
from toolkit.report.card import read_card
from toolkit.report.explanation import read_explanation
from toolkit.report.manifest import read_manifest
from toolkit.report.report_json import read_report, read_seeds_report
from toolkit.report.scores import read_metrics, read_seeds
from toolkit.report.sweep import read_sweep

__all__ = [
    "read_card",
    "read_check",
    "read_explanation",
    "read_manifest",
    "read_metrics",
    "read_report",
    "read_seeds",
    "read_seeds_report",
    "read_sweep",
]

read_check = reader(Check, "repeat vislam check", older=OLDER_CHECKS)
