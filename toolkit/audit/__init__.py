"""The audit: faults of a recording, found from its data alone, reported and (by default) repaired.

A file with a ``FAULT`` in one of these folders is a fault and needs no registration: ``timing``, ``tracks``,
``samples``, ``calibration``, ``agreement`` (of vision with the motion) and ``truth``; ``parts`` has computations that
several faults share. Read ``fault``, then ``tracks.no_disparity`` (the smallest fault), then ``tracks.stale_frames``
and ``calibration.mixed_axes`` (repairs of tracks and of the calibration).

The audit itself reports values that are impossible, so that NumPy's warnings about them are not shown.
"""

import importlib
import pkgutil
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cache
from graphlib import TopologicalSorter

import numpy as np

from toolkit.audit.fault import Evidence, Fault, Finding, Symptom, Undecided
from toolkit.errors import UnknownNameError, no_such
from toolkit.sequence import Sequence

# Largest share of the sightings that a repair may drop; beyond it the finding blocks. Sightings of frames that the
# repair cuts off are not counted.
MOST_LOST = 0.2

__all__ = ["Audit", "Finding", "audit", "checked_again", "faults"]


@dataclass(frozen=True, eq=False)
class Audit:
    """The sequence after the audit's repairs, and the findings in the order in which faults are checked.

    ``undecided`` names the faults that could not be decided from the recording, with the reason.
    """

    sequence: Sequence
    findings: tuple[Finding, ...]
    undecided: Mapping[str, str] = field(default_factory=dict)


@np.errstate(all="ignore")
def audit(sequence: Sequence, keep: frozenset[str] = frozenset()) -> Audit:
    """Check every fault in turn and repair it, unless its name is in ``keep``; each sees the repairs before it.

    Raises UnknownNameError where ``keep`` names a fault that does not exist.
    """
    unknown = keep - faults().keys()
    if unknown:
        raise UnknownNameError(no_such("fault", min(unknown), faults()))
    evidence, findings, undecided = Evidence(sequence), [], {}
    for fault in _ordered():
        symptom = fault.check(evidence)
        if isinstance(symptom, Undecided):
            undecided[fault.name] = symptom.why
        elif symptom is not None:
            remedy = None if fault.name in keep else symptom.remedy
            findings.append(_finding(fault, symptom, evidence.sequence, repaired=remedy is not None))
            if remedy is not None:
                evidence = evidence.after(remedy)
            elif symptom.spoils_vision:
                evidence = Evidence(evidence.sequence, fault.name)
    return Audit(evidence.sequence, tuple(findings), undecided)


@np.errstate(all="ignore")
def checked_again(found: Audit, name: str, sequence: Sequence) -> Audit:
    """Return an audit with one fault, which must have no repair, checked again in a changed recording."""
    fault = next(fault for fault in _ordered() if fault.name == name)
    findings = tuple(finding for finding in found.findings if finding.fault != name)
    undecided = {key: why for key, why in found.undecided.items() if key != name}
    symptom = fault.check(Evidence(sequence))
    if isinstance(symptom, Undecided):
        undecided[name] = symptom.why
    elif symptom is not None:
        findings = (*findings, _finding(fault, symptom, sequence, repaired=False))
    return replace(found, findings=findings, undecided=undecided)


def faults() -> dict[str, str]:
    """Return the name and a one-line summary of every fault the audit knows, in the order they are checked."""
    return {fault.name: fault.summary for fault in _ordered()}


def _finding(fault: Fault, symptom: Symptom, before: Sequence, repaired: bool) -> Finding:
    left_alone = symptom.remedy is not None and not repaired
    detail = f"{symptom.detail}; {'left as it is' if left_alone else symptom.treatment}"
    lost = _share_lost(before, symptom.remedy) if repaired and symptom.remedy is not None else 0.0
    if symptom.harmful and lost > MOST_LOST:
        detail += f"; it takes {lost:.0%} of the sightings, with which the recording is another one"
    blocking = symptom.harmful and (not repaired or lost > MOST_LOST)
    return Finding(fault.name, symptom.count, repaired, detail, blocking, symptom.warns, symptom.spans_ns)


def _share_lost(before: Sequence, after: Sequence) -> float:
    """Return the share of the sightings that a repair drops from the frames it keeps."""
    in_kept_frames = np.isin(before.frames_t_ns, after.frames_t_ns)[before.observations.frame].sum()
    return 1.0 - len(after.observations) / int(in_kept_frames) if in_kept_frames else 0.0


@cache
def _ordered() -> tuple[Fault, ...]:
    """Load the faults of the folders here, each after the ones it names; equals by the name of their file."""
    files = [m.name for m in pkgutil.walk_packages(__path__, f"{__name__}.") if not m.ispkg]
    by_file = sorted(files, key=lambda name: name.rpartition(".")[2])
    loaded = map(importlib.import_module, by_file)
    known = {module.FAULT.name: module.FAULT for module in loaded if hasattr(module, "FAULT")}
    order = TopologicalSorter({name: fault.after for name, fault in known.items()}).static_order()
    return tuple(known[name] for name in order)
