"""Where an optional part of the noise model is asked for, the table says so and names who does without."""

from dataclasses import replace

import msgspec

from toolkit.estimator import find_all
from toolkit.experiment.pipeline import lacking
from toolkit.report.messages import note_lines, rules_line
from toolkit.settings import DEFAULTS, Noise, Settings

BOTH = Noise(disparity_scale=0.02, bridge_gaps=True)


def test_who_has_no_such_part_is_found_by_what_estimators_say_of_themselves():
    entries = find_all(["ekf", "fixed-lag", "batch"])
    assert lacking(entries, DEFAULTS.noise, "twist") == {}
    assert lacking(entries, BOTH, "twist") == {"disparity_scale": ("ekf", "fixed-lag"), "bridge_gaps": ("ekf",)}


def test_gaps_are_bridged_between_measured_twists_only():
    entries, noise = find_all(["ekf", "batch"]), Noise(bridge_gaps=True)
    assert lacking(entries, noise, "imu") == {"bridge_gaps": ("ekf", "batch")}


def test_the_table_says_what_is_taken_into_account_and_by_whom_it_is_not(comparison):
    asked = replace(comparison, settings=Settings(noise=BOTH), lacking={"disparity_scale": ("ekf", "smart")})
    assert rules_line(asked).endswith("; disparities scaled by 0 +- 2 %, a state; gaps between tracks bridged")
    assert "ekf, smart: without a scale of the disparities (noise.disparity_scale)" in note_lines(asked)
    assert "disparities" not in rules_line(comparison)
    assert msgspec.structs.replace(BOTH, disparity_scale=None, bridge_gaps=False) == DEFAULTS.noise
