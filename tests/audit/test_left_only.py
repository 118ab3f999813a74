"""Sightings that lack the right image are no fault: they are counted, kept, and do not hide what is one."""

from collections.abc import Callable

import numpy as np
import pytest

from toolkit.audit import audit
from toolkit.sequence import Sequence, check_runnable
from toolkit.simulation import faults


@pytest.fixture
def third(clean_recording: Callable[..., Sequence]) -> Sequence:
    return faults.missing_right(clean_recording(), 1.0 / 3.0, 0)


def test_they_are_counted_and_left_as_they_are(third: Sequence) -> None:
    outcome = audit(third)
    (finding,) = outcome.findings
    assert (finding.fault, finding.blocking, finding.repaired, finding.warning) == ("left-only", False, False, False)
    assert finding.count == np.isnan(third.observations.uv_px[:, 1]).sum()
    assert outcome.sequence is third
    check_runnable(outcome.sequence)


@pytest.mark.parametrize("fault", ["stale-frames", "not-finite", "no-disparity", "twist-lag", "doubled-disparity"])
def test_what_is_a_fault_is_found_beside_them(
    clean_recording: Callable[..., Sequence], planted: Callable[[str, Sequence], Sequence], fault: str
) -> None:
    recording = clean_recording("drive", 0, 30.0 if fault == "twist-lag" else None)
    found = audit(faults.missing_right(planted(fault, recording), 0.2, 0)).findings
    assert [(f.fault, f.repaired) for f in found if f.fault != "left-only"] == [(fault, True)]


def test_without_any_pair_there_is_a_warning(clean_recording: Callable[..., Sequence]) -> None:
    warnings = [f.fault for f in audit(faults.missing_right(clean_recording(), 1.0, 0)).findings if f.warning]
    assert "left-only" in warnings
