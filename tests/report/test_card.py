"""The card says of planted errors what they are, in figures and in words."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from toolkit.cli import main
from toolkit.experiment.comparison import Comparison
from toolkit.experiment.pipeline import Plan, run
from toolkit.motion_samples import TwistSamples
from toolkit.noise import card_of, measured_noise
from toolkit.report.card import card_lines, card_record
from toolkit.report.comparison_table import comparison_text, report_text
from toolkit.report.html.payload import payload_of
from toolkit.report.records import read_card
from toolkit.report.report_json import report_document
from toolkit.report.run_directory import MadeBy, read_run, write_run
from toolkit.sequence import Sequence
from toolkit.settings import Settings
from toolkit.simulation import DRIVE, noise_free, simulate
from toolkit.simulation.faults import match_offset, persistent_mismatch, stretched_disparity, track_walk


@pytest.fixture(scope="module")
def walking() -> Sequence:
    exact = simulate(noise_free(replace(DRIVE, duration_s=12.0)), 0)
    return match_offset(track_walk(exact, 0.13, 1), 0.7, 2)


def test_errors_that_walk_are_correlated(walking: Sequence) -> None:
    card = card_of(walking)
    assert card.correlated
    assert card.correlation[0].min() > 0.4
    assert card.weight == measured_noise(walking).tracks
    assert any(f"{card.weight.correlation:.2f}" in line and "noise.track_weight" in line for line in card_lines(card))


def test_a_scale_of_one_is_found_within_its_error_whatever_the_pairing_of_twists() -> None:
    exact = simulate(noise_free(replace(DRIVE, duration_s=12.0)), 0)
    found = [card_of(match_offset(track_walk(exact, 0.13, seed), 0.7, seed)).scale for seed in range(6)]
    values, errors = np.array([(one.value, one.error) for one in found if one is not None]).T
    assert len(values) == 6
    assert abs(values.mean() - 1.0) < 3.0 * np.sqrt(np.mean(errors**2) / 6.0) < 0.003
    motion, step_ns = exact.motion, int(exact.frames_t_ns[1] - exact.frames_t_ns[0])
    assert isinstance(motion, TwistSamples)
    at_end = TwistSamples(
        np.append(motion.t_ns[0], motion.t_ns + step_ns),
        *(np.vstack([samples[:1], samples]) for samples in (motion.v_mps, motion.w_radps)),
        "end",
    )
    for measured in (motion, at_end):
        scale = card_of(replace(exact, motion=measured)).scale
        assert scale is not None
        assert abs(scale.value - 1.0) < 1e-4


def test_white_errors_are_not() -> None:
    card = card_of(simulate(replace(DRIVE, duration_s=10.0), 0))
    assert not card.correlated
    # What a landmark takes of a few sightings makes the rest of them anticorrelated.
    assert card.correlation[0].max() < 0.1
    assert card.tails < 0.002
    assert card.at_odds < 0.005
    assert any("are white" in line for line in card_lines(card))


def test_a_scale_and_strays_are_reported(walking: Sequence) -> None:
    short = walking.truncated(70)
    card = card_of(stretched_disparity(persistent_mismatch(short, 0.2, 4), 1.03))
    assert card.scale is not None
    assert card.scale.value == pytest.approx(1.0 / 1.03, abs=0.012)
    # A mismatch in the last sighting of a track, or of one too short, does not show.
    assert 0.07 < card.at_odds < 0.25
    messages = " ".join(card_lines(card))
    assert "shorter than the measured motion's" in messages
    assert "lasting mismatches" in messages


def test_the_command_prints_the_card_and_writes_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    target = tmp_path / "card.json"
    assert main(["card", "drive", "--max-frames", "50", "--json", str(target)]) == 0
    record = read_card(target)
    assert record.schema == "vislam.card/2"
    printed = capsys.readouterr().out
    assert all(line in printed for line in record.words)


def compared(sequence: Sequence) -> Comparison:
    return run(Plan((sequence,), ("dead-reckoning",), settings=Settings(card=True), workers=1))[0]


def test_a_report_and_its_page_have_the_card_on_request(walking: Sequence, tmp_path: Path) -> None:
    comparison = compared(walking.truncated(50))
    assert comparison.card is not None
    words = tuple(card_lines(comparison.card))
    assert report_document(comparison).card == card_record(comparison.card)
    assert "## Its tracks" in report_text(comparison, {})
    assert all(line in comparison_text(comparison, width=None) for line in words)
    write_run(comparison, tmp_path / "run", MadeBy("vislam compare"))
    assert tuple(payload_of([read_run(tmp_path / "run")])["cases"][0]["card"]) == words


def test_a_card_that_cannot_be_had_costs_a_comparison_nothing_and_is_told(walking: Sequence) -> None:
    comparison = compared(walking.truncated(4))
    assert (comparison.card, comparison.runs[0].status) == (None, "ok")
    assert "no card of its tracks: " in report_text(comparison, {})
