"""Every JSON document of the toolkit: its record, the function that reads it, and its schema in docs/schemas.

``python -m toolkit.report.records docs/schemas`` writes the schemas. :mod:`toolkit.files.documents` reads, writes and
describes records; each stands with the function that fills it.
"""

import json
import sys
from collections.abc import Mapping
from pathlib import Path

import msgspec

from toolkit.evaluation.against_baseline import TrajectoryBaselineRecord
from toolkit.evaluation.standings import EvaluationRecord
from toolkit.files.documents import reader, schema
from toolkit.files.writing import write_text
from toolkit.gate.baseline import BaselineRecord
from toolkit.gate.verdict import OLDER_CHECKS, Check
from toolkit.report.card import CardRecord, read_card
from toolkit.report.differences import DiffRecord
from toolkit.report.explanation import ExplanationRecord, read_explanation
from toolkit.report.export import BundleRecord
from toolkit.report.manifest import Manifest, read_manifest
from toolkit.report.report_json import Report, SeedsReport, read_report, read_seeds_report
from toolkit.report.scores import MetricsDocument, Seeds, read_metrics, read_seeds
from toolkit.report.sweep import SweepRecord, read_sweep
from toolkit.verify import VerificationRecord

__all__ = [
    "RECORDS",
    "read_card",
    "read_check",
    "read_explanation",
    "read_manifest",
    "read_metrics",
    "read_report",
    "read_seeds",
    "read_seeds_report",
    "read_sweep",
    "schema_files",
]
# By the name of the schema's file, without its ending.
RECORDS: Mapping[str, type[msgspec.Struct]] = {
    "metrics-1": MetricsDocument,
    "seeds-1": Seeds,
    "report-1": Report,
    "report-over-seeds-1": SeedsReport,
    "manifest-1": Manifest,
    "baseline-1": BaselineRecord,
    "trajectory-baseline-1": TrajectoryBaselineRecord,
    "check-2": Check,
    "card-2": CardRecord,
    "evaluation-1": EvaluationRecord,
    "verification-1": VerificationRecord,
    "diff-1": DiffRecord,
    "bundle-1": BundleRecord,
    "sweep-1": SweepRecord,
    "explain-1": ExplanationRecord,
}


read_check = reader(Check, "repeat vislam check", older=OLDER_CHECKS)


def schema_files() -> dict[str, str]:
    return {f"{name}.json": json.dumps(schema(record), indent=2) + "\n" for name, record in RECORDS.items()}


if __name__ == "__main__":
    for name, text in schema_files().items():
        write_text(Path(sys.argv[1]) / name, text)
