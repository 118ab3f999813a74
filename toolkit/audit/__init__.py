"""The audit: faults of a recording, found from its data alone, reported and (by default) repaired.

A file in this folder that holds a ``FAULT`` is a fault, found by being here; ``parts`` is what several of them share.
Read ``fault``, then ``no_disparity`` for the smallest fault, ``stale_frames`` and ``mixed_axes`` for the others' kinds.
"""

import importlib
import pkgutil
from dataclasses import dataclass
from functools import cache
from graphlib import TopologicalSorter

from toolkit.audit.fault import Evidence, Fault, Finding, Symptom
from toolkit.errors import VislamError, no_such
from toolkit.sequence import Sequence

__all__ = ["Audit", "Finding", "audit", "faults"]


@dataclass(frozen=True, eq=False)
class Audit:
    """The sequence after the audit's repairs, and what was found in it, in the order it was checked."""

    sequence: Sequence
    findings: tuple[Finding, ...]


def audit(sequence: Sequence, keep: frozenset[str] = frozenset()) -> Audit:
    """Check every fault in turn and repair it, unless its name is in ``keep``; each sees the repairs before it.

    Raises VislamError where ``keep`` names a fault that does not exist.
    """
    unknown = keep - faults().keys()
    if unknown:
        raise VislamError(no_such("fault", min(unknown), faults()))
    evidence, findings = Evidence(sequence), []
    for fault in _ordered():
        symptom = fault.check(evidence)
        if symptom is None:
            continue
        remedy = None if fault.name in keep else symptom.remedy
        findings.append(_finding(fault, symptom, repaired=remedy is not None))
        if remedy is not None:
            evidence = evidence.after(remedy)
    return Audit(evidence.sequence, tuple(findings))


def faults() -> dict[str, str]:
    """Return the name and a one-line summary of every fault the audit knows, in the order they are checked."""
    return {fault.name: fault.summary for fault in _ordered()}


def _finding(fault: Fault, symptom: Symptom, repaired: bool) -> Finding:
    left_alone = symptom.remedy is not None and not repaired
    outcome = "left as it is" if left_alone else symptom.treatment
    return Finding(
        fault.name, symptom.count, repaired, f"{symptom.detail}; {outcome}", symptom.harmful and not repaired
    )


@cache
def _ordered() -> tuple[Fault, ...]:
    """Load the faults of this folder, each after the ones it names; equals by name."""
    modules = sorted(m.name for m in pkgutil.iter_modules(__path__) if not m.ispkg)
    loaded = (importlib.import_module(f"{__name__}.{name}") for name in modules)
    known = {module.FAULT.name: module.FAULT for module in loaded if hasattr(module, "FAULT")}
    order = TopologicalSorter({name: fault.after for name, fault in known.items()}).static_order()
    return tuple(known[name] for name in order)
