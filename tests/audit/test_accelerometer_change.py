"""A gravity that is read otherwise from some time on is told with its size, and none in sound recordings."""

import re
from dataclasses import replace

import pytest

from toolkit.audit.agreement import accelerometer_change
from toolkit.audit.fault import Evidence, Symptom
from toolkit.sequence import Sequence
from toolkit.simulation import SCENARIOS, faults, simulate


def recording(scenario: str, seed: int, duration_s: float) -> Sequence:
    return simulate(replace(SCENARIOS[scenario], duration_s=duration_s, varied=seed % 2 == 1), seed)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("dose", [0.97, 1.03, 1.06])
@pytest.mark.parametrize(("scenario", "duration_s"), [("drive-imu", 12.0), ("flight", 8.0), ("flight-realistic", 8.0)])
def test_an_accelerometer_whose_scale_changes_is_reported_with_its_error(
    scenario: str, duration_s: float, dose: float, seed: int
) -> None:
    sound = recording(scenario, seed, duration_s)
    found = accelerometer_change(Evidence(faults.changed_speed(sound, dose, seed)))
    assert isinstance(found, Symptom) and found.warns and not found.harmful
    match = re.search(r"from about (\d+) s .* gravity that is ([\d.]+) \+- ([\d.]+) m/s\^2 (more|less)", found.detail)
    assert match is not None and match[4] == ("more" if dose > 1.0 else "less")
    assert float(match[1]) == pytest.approx(0.5 * duration_s, abs=1.0)
    # Half of what drifting tracks make of it, and three standard errors as they are rounded.
    assert float(match[2]) == pytest.approx(9.81 * abs(dose - 1.0), abs=0.08 + 3.0 * float(match[3]) + 0.02)


@pytest.mark.parametrize("scenario", ["drive-imu", "flight", "flight-realistic"])
@pytest.mark.parametrize("seed", range(20, 28))
def test_a_sound_accelerometer_reads_one_gravity(scenario: str, seed: int) -> None:
    found = accelerometer_change(Evidence(recording(scenario, seed, 5.0 + (seed % 4) * 2.0)))
    assert not isinstance(found, Symptom)
