"""The audit as a whole: clean recordings pass, each planted fault is found, counted, and repaired or kept."""

import re
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from tests.audit.conftest import clean_recording
from toolkit.audit import audit, faults
from toolkit.errors import UnknownNameError
from toolkit.sequence import Observations, Sequence, check_runnable
from toolkit.simulation import SCENARIOS
from toolkit.simulation.faults import identity_intrinsics

AUDIT_PAGE = Path(__file__).parents[2] / "docs/audit.md"


def beyond_single_precision(sequence: Sequence) -> Sequence:
    seen = sequence.observations
    return replace(sequence, observations=Observations(seen.frame, seen.track_id, seen.uv_px * 1e200))


@pytest.mark.parametrize("scenario", SCENARIOS)
@pytest.mark.parametrize(("seed", "duration_s"), [(0, 30.0), (11, 8.0)])
def test_a_clean_recording_raises_no_finding_and_is_left_as_it_is(scenario: str, seed: int, duration_s: float) -> None:
    sequence = clean_recording(scenario, seed, duration_s)
    outcome = audit(sequence)
    assert outcome.findings == ()
    assert outcome.sequence is sequence


def test_a_planted_fault_is_found_counted_and_repaired(plant: Any) -> None:
    findings = plant.audited.findings
    assert [(f.fault, f.count, f.repaired, f.blocking) for f in findings] == [(plant.fault, plant.count, True, False)]


def test_a_repaired_recording_runs_and_does_not_have_the_fault_again(plant: Any) -> None:
    repaired = plant.audited.sequence
    check_runnable(repaired)
    # A track that lost a sighting to a repair looks, to a second audit, like one that went and came back.
    assert {f.fault for f in audit(repaired).findings} <= {"returning-tracks"} - {plant.fault}


def test_a_kept_fault_is_found_blocks_and_is_left_alone(plant: Any) -> None:
    outcome = audit(plant.planted, keep=frozenset(faults()))
    found = {f.fault: f for f in outcome.findings}
    assert found[plant.fault].count == plant.count
    assert not found[plant.fault].repaired
    assert found[plant.fault].blocking
    assert outcome.sequence is plant.planted


def test_keeping_an_unknown_fault_is_refused_by_name() -> None:
    with pytest.raises(UnknownNameError, match="no fault is called rust; there are clock-jump"):
        audit(clean_recording(), keep=frozenset({"rust"}))


def test_the_audit_imports_nothing_that_takes_as_long_as_an_audit() -> None:
    """Every process that runs an estimator audits first: scipy.stats alone takes a second to import."""
    program = "import sys; from toolkit.audit import faults; faults(); print(*sys.modules)"
    messages = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    ).stdout.split()
    # What an estimator imports anyway (scipy.linalg) is no cost of the audit.
    assert not {"scipy.stats", "scipy.optimize", "scipy.ndimage", "matplotlib", "cv2"}.intersection(messages)


def test_every_fault_has_a_summary_of_one_line_and_a_row_in_the_docs() -> None:
    assert all(summary and "\n" not in summary for summary in faults().values())
    documented = re.findall(r"^\| `([a-z-]+)` \|", AUDIT_PAGE.read_text(encoding="utf-8"), re.MULTILINE)
    assert sorted(documented) == sorted(faults())


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(
    "break_it", [partial(identity_intrinsics, dose=0.0), identity_intrinsics, beyond_single_precision]
)
def test_what_is_broken_is_reported_without_a_warning_of_numpy(break_it: Callable[[Sequence], Sequence]) -> None:
    assert audit(break_it(clean_recording().truncated(40))).findings


@pytest.mark.parametrize("frames", [0, 1, 2])
def test_a_recording_of_hardly_any_frame_is_audited_without_complaint(frames: int) -> None:
    assert audit(clean_recording().truncated(frames)).findings == ()
