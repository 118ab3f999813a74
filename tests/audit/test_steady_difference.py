"""A scale and a direction that no chance makes are told with their size, and none of them on sound drives."""

import re
from collections.abc import Callable
from dataclasses import replace

import pytest

from toolkit.audit import audit
from toolkit.audit.calibration import steady_difference
from toolkit.audit.fault import Evidence, Symptom
from toolkit.sequence import Sequence
from toolkit.simulation import SCENARIOS, faults, simulate


def drive(seed: int, duration_s: float = 25.0, scenario: str = "drive") -> Sequence:
    return simulate(replace(SCENARIOS[scenario], duration_s=duration_s, varied=seed % 2 == 1), seed)


@pytest.mark.parametrize("seed", [41, 42])
@pytest.mark.parametrize(
    ("fault", "dose", "percent"),
    [
        (faults.wrong_focal_length, 1.02, 2.0),
        (faults.baseline_unit, 1.02, 2.0),
        (faults.stretched_disparity, 1.02, -2.0),
        (faults.linear_unit, 1.02, -2.0),
        (faults.wrong_focal_length, 0.97, -3.0),
    ],
)
def test_two_percent_of_scale_are_reported_with_their_error(
    fault: Callable[[Sequence, float, int], Sequence], dose: float, percent: float, seed: int
) -> None:
    found = steady_difference(Evidence(fault(drive(seed), dose, seed)))
    assert isinstance(found, Symptom) and not found.harmful
    match = re.search(r"steps are ([\d.]+) \+- ([\d.]+) % (longer|shorter)", found.detail)
    assert match is not None and match[3] == ("longer" if percent > 0.0 else "shorter")
    # The tracks' noise makes vision's steps up to half a percent longer.
    assert float(match[1]) == pytest.approx(abs(percent), abs=0.6)
    assert float(match[2]) < 0.6


@pytest.mark.parametrize("seed", range(43, 47))
def test_a_principal_point_that_is_12_px_off_is_reported_by_the_direction(seed: int) -> None:
    found = steady_difference(Evidence(faults.shifted_centre(drive(seed), 12.0, seed)))
    assert isinstance(found, Symptom)
    match = re.search(r"equivalent to (\d+) px of the principal point", found.detail)
    assert match is not None and float(match[1]) == pytest.approx(12.0, abs=2.5)


@pytest.mark.parametrize("scenario", ["drive", "drive-realistic"])
@pytest.mark.parametrize("seed", range(50, 60))
def test_a_sound_drive_has_no_steady_difference(scenario: str, seed: int) -> None:
    assert steady_difference(Evidence(drive(seed, 8.0 + (seed % 5) * 3.0, scenario))) is None


def test_what_is_more_than_slip_is_a_fault_of_its_own() -> None:
    found = {finding.fault for finding in audit(faults.stretched_disparity(drive(47), 1.08)).findings}
    assert "vision-scale" in found and "steady-difference" not in found
