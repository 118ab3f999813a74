"""The JSON schemas of all documents as files: ``python -m toolkit.report.schemas docs/schemas``."""

import json
import sys
from collections.abc import Mapping
from pathlib import Path

import msgspec

from toolkit.evaluation.document import EvaluationRecord
from toolkit.files.documents import schema
from toolkit.gate.baseline_file import BaselineRecord
from toolkit.gate.trajectory_baseline import TrajectoryBaselineRecord
from toolkit.report.differences import DiffRecord
from toolkit.report.export import BundleRecord
from toolkit.report.records import CardRecord, CheckDocument, Manifest, MetricsDocument, Report, Seeds, SeedsReport
from toolkit.report.verify_text import VerificationRecord

# By the name of the schema's file, without its ending.
RECORDS: Mapping[str, type[msgspec.Struct]] = {
    "metrics-1": MetricsDocument,
    "seeds-1": Seeds,
    "report-1": Report,
    "report-over-seeds-1": SeedsReport,
    "manifest-1": Manifest,
    "baseline-1": BaselineRecord,
    "trajectory-baseline-1": TrajectoryBaselineRecord,
    "check-2": CheckDocument,
    "card-1": CardRecord,
    "evaluation-1": EvaluationRecord,
    "verification-1": VerificationRecord,
    "diff-1": DiffRecord,
    "bundle-1": BundleRecord,
}


def schema_files() -> dict[str, str]:
    """Return the text of every schema by the name of its file."""
    return {f"{name}.json": json.dumps(schema(record), indent=2) + "\n" for name, record in RECORDS.items()}


def write_schemas(directory: Path) -> None:
    """Write every schema into an existing directory, in the place of earlier ones."""
    for name, text in schema_files().items():
        (directory / name).write_text(text, encoding="utf-8")


if __name__ == "__main__":
    write_schemas(Path(sys.argv[1]))
