"""Write the JSON schemas of the docs again: python docs/site/schemas.py"""

import json
from collections.abc import Mapping
from pathlib import Path

import msgspec

from toolkit.evaluation.against_baseline import TrajectoryBaselineRecord
from toolkit.evaluation.standings import EvaluationRecord
from toolkit.files.documents import schema
from toolkit.files.writing import write_text
from toolkit.gate.baseline import BaselineRecord
from toolkit.gate.verdict import Check
from toolkit.report.card import CardRecord
from toolkit.report.differences import DiffRecord
from toolkit.report.explanation import ExplanationRecord
from toolkit.report.export import BundleRecord
from toolkit.report.manifest import Manifest
from toolkit.report.report_json import Report, SeedsReport
from toolkit.report.scores import MetricsDocument, Seeds
from toolkit.report.sweep import SweepRecord
from toolkit.verify import VerificationRecord

SCHEMAS = Path(__file__).resolve().parents[1] / "schemas"
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


def schema_files() -> dict[str, str]:
    return {f"{name}.json": json.dumps(schema(record), indent=2) + "\n" for name, record in RECORDS.items()}


if __name__ == "__main__":
    for name, text in schema_files().items():
        write_text(SCHEMAS / name, text)
