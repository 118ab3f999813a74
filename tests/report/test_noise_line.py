"""The line above a table says which noise every estimator assumed, and where it is from; the manifest has it too."""

from dataclasses import replace
from pathlib import Path

import pytest

from toolkit.experiment import Plan, run
from toolkit.experiment.comparison import Comparison
from toolkit.experiment.configuration import Configuration
from toolkit.noise import MeasuredNoise, MotionScale, TrackWeight
from toolkit.report.comparison_table import header_lines, noise_line
from toolkit.report.records import read_manifest
from toolkit.report.run_directory import MadeBy, write_run
from toolkit.settings import Noise, Settings
from toolkit.simulation import SCENARIOS, simulate

WALKING = TrackWeight(0.05, 0.01, correlation=0.92, variance=0.8, pairs=9000)
COVERED = replace(WALKING, value=1.0, error=0.0)


@pytest.mark.parametrize(
    ("measured", "settings", "words"),
    [
        (
            MeasuredNoise(WALKING),
            Noise(),
            ("0.05 +- 0.01 of its information", "0.92", "odometry as stated", "the recording"),
        ),
        (MeasuredNoise(COVERED), Noise(), ("in full", "0.92", "smaller than stated")),
        (MeasuredNoise(motion=MotionScale(5.0, 0.3, 20.0)), Noise(), ("white", "odometry 5 +- 0.3 times as noisy")),
        (MeasuredNoise(WALKING), Noise(measured_s=30.0), ("0.05 +- 0.01", "first 30 s")),
        (MeasuredNoise(), Noise(track_weight=0.2), ("at 1 of its information, as set", "odometry as stated")),
        (MeasuredNoise(why_not="3 frames are too few"), Noise(), ("not measured: 3 frames are too few",)),
        (
            None,
            Noise(track_weight=1.0, motion_scale=2.0),
            ("at 1 of its information, as set", "2 times as noisy as stated, as set"),
        ),
    ],
)
def test_the_noise_that_all_estimators_assumed_is_said_with_its_source(
    measured: MeasuredNoise | None, settings: Noise, words: tuple[str, ...], comparison: Comparison
) -> None:
    line = noise_line(replace(comparison, measured=measured, settings=Settings(noise=settings)))
    assert line.startswith("noise: sightings 1 px, ")
    assert all(word in line for word in words), line
    assert (measured is None or bool(measured.why_not)) == ("measured on" not in line)


def test_the_manifest_has_what_was_measured_and_the_table_says_it_once(tmp_path: Path) -> None:
    recording = simulate(replace(SCENARIOS["drive-realistic"], duration_s=4.0), 0)
    comparison = run(Plan((recording,), ("dead-reckoning",), workers=1))[0]
    assert comparison.measured is not None
    assert comparison.sequence.rig.track_weight == comparison.measured.tracks.value < 0.5
    assert [line.startswith("noise: ") for line in header_lines(comparison)].count(True) == 1
    write_run(comparison, tmp_path / "run", MadeBy("vislam compare", Configuration()))
    assert read_manifest(tmp_path / "run" / "manifest.json").noise == comparison.measured
