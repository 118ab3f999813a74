"""The one pipeline of every comparison: load, audit, start, run, score; one seed or many, here or on a cluster.

Reading order: recording (what is read) -> units (what is run) -> workers, cluster (where) -> outcome_store (what is
kept of it) -> pipeline -> comparison (what comes of it) -> statistics -> consistency (whose stated uncertainty cannot
be right).
"""

from toolkit.experiment.comparison import Comparison, Record, Row
from toolkit.experiment.pipeline import Plan, comparisons, prepared_cases, run, stores_of, workers_of

__all__ = ["Comparison", "Plan", "Record", "Row", "comparisons", "prepared_cases", "run", "stores_of", "workers_of"]
