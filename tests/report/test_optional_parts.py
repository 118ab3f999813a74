"""Where an optional part of the noise model is asked for, the table says so and names who does without."""

from dataclasses import replace

import msgspec

from toolkit.estimator import find_all
from toolkit.experiment.pipeline import decisive_parts, lacking, to_bridge
from toolkit.experiment.recording import Recording, prepare
from toolkit.report.comparison_table import rules_line
from toolkit.report.messages import note_lines
from toolkit.settings import DEFAULTS, Noise, Settings
from toolkit.simulation import DRIVE, DRIVE_IMU, SCENARIOS, simulate
from toolkit.simulation.track_faults import cut_tracks

BOTH = Noise(disparity_scale=0.02, bridge_gaps=True)
SCALE_ALONE = Noise(disparity_scale=0.02, bridge_gaps=False)


def test_who_has_no_such_part_is_found_by_what_estimators_say_of_themselves():
    entries = find_all(["ekf", "fixed-lag", "batch", "msckf-slam"])
    cut = cut_tracks(simulate(replace(SCENARIOS["drive-realistic"], duration_s=4.0), 0), 0.2, 1)
    everything, white = (prepare(Recording(one, max_frames=40)) for one in (cut, "drive"))
    assert decisive_parts(everything) == {"disparity_scale", "bridge_gaps", "match_tracks"}
    without = {"bridge_gaps": ("ekf",), "match_tracks": ("ekf",)}
    assert lacking(entries, DEFAULTS.noise, everything) == without
    assert lacking(entries, BOTH, everything) == {"disparity_scale": ("ekf", "fixed-lag", "msckf-slam")} | without
    assert lacking(entries, DEFAULTS.noise, white) == {}
    assert lacking(entries, Noise(bridge_gaps=False, match_tracks=False), everything) == {}


def test_where_the_audit_found_correlated_tracks_those_who_take_them_for_white_are_named():
    white, realistic = (prepare(Recording(name, max_frames=40)) for name in ("drive", "drive-realistic"))
    entries = find_all(["dead-reckoning", "ekf", "ekf-slam", "riekf", "msckf", "smart"])
    assert "match_tracks" not in lacking(entries, DEFAULTS.noise, white)
    assert lacking(entries, DEFAULTS.noise, realistic)["match_tracks"] == ("ekf", "riekf")
    flown = prepare(Recording("flight-realistic", max_frames=60))
    assert lacking(entries, DEFAULTS.noise, flown)["match_tracks"] == ("ekf",), "riekf obeys beside an IMU"


def test_gaps_are_bridged_between_measured_twists_only():
    drive = simulate(replace(DRIVE, duration_s=2.0), 0)
    assert not to_bridge(drive)
    assert to_bridge(cut_tracks(drive, 0.2, 1))
    assert not to_bridge(cut_tracks(simulate(replace(DRIVE_IMU, duration_s=2.0), 0), 0.2, 1))


def test_the_table_says_what_is_taken_into_account_and_by_whom_it_is_not(comparison):
    requested = replace(comparison, settings=Settings(noise=SCALE_ALONE), lacking={"disparity_scale": ("ekf", "smart")})
    assert rules_line(requested).endswith("; disparities scaled by 0 +- 2 %, a state; gaps between tracks not bridged")
    assert any("ekf and smart" in line and "scale of the disparities" in line for line in note_lines(requested))
    assert "disparities" not in rules_line(comparison)
    assert "bridged" not in rules_line(comparison)
    assert msgspec.structs.replace(BOTH, disparity_scale=None) == DEFAULTS.noise
