"""The card says of planted errors what they are, in figures and in words."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from toolkit.track_errors import Fit, card_of, fit_track_noise

from toolkit.cli import main
from toolkit.errors import DataError
from toolkit.experiment import Plan, run
from toolkit.experiment.configuration import Configuration
from toolkit.files.documents import to_line
from toolkit.report.card import card_lines, card_record, card_text
from toolkit.report.comparison_text import comparison_text, report_text
from toolkit.report.html.payload import payload_of
from toolkit.report.records import read_card
from toolkit.report.report_json import report_document
from toolkit.report.run_directory import MadeBy, read_run, write_run
from toolkit.sequence import Sequence
from toolkit.settings import settings_of
from toolkit.simulation.track_faults import disparity_scale, persistent_mismatch


def test_errors_that_walk_are_correlated_and_drift_apart_as_fitted(walking: Sequence, walking_fit: Fit) -> None:
    card = card_of(walking, walking_fit)
    assert card.correlation[0].min() > 0.4
    # In the column a landmark that is too near or too far bends what a walk leaves; rows show it as it is.
    np.testing.assert_allclose(np.sqrt(card.structure_px2[:5, 2]), np.sqrt(card.fitted_px2[:5, 2]), rtol=0.15)
    assert any("are correlated" in line and "noise.tracks=fitted" in line for line in card_lines(card))
    # The measured motion is interpolated between samples, which makes it 0.2 % short.
    assert card.scale is not None and card.scale.value == pytest.approx(1.0, abs=0.006)


def test_white_errors_are_not(white: Sequence, white_fit: Fit) -> None:
    card = card_of(white, white_fit)
    # What a landmark takes of a few sightings makes the rest of them anticorrelated.
    assert card.correlation[0].max() < 0.1
    assert card.tails < 0.002 and card.at_odds < 0.005
    assert any("are white" in line and "should be the most accurate" in line for line in card_lines(card))


def test_a_scale_and_strays_are_reported(exact: Sequence, walking: Sequence) -> None:
    short = walking.truncated(70)
    off = disparity_scale(persistent_mismatch(short, 0.2, 4), 0.03)
    card = card_of(off, fit_track_noise(off))
    assert card.scale is not None and card.scale.value == pytest.approx(1.0 / 1.03, abs=0.01)
    # A mismatch in the last sighting of a track, or of one too short, does not show.
    assert 0.07 < card.at_odds < 0.25
    messages = " ".join(card_lines(card))
    assert "shorter than the measured motion's" in messages and "lasting mismatches" in messages


def test_intervals_without_a_common_track_are_counted(walking: Sequence, walking_fit: Fit) -> None:
    seen = walking.observations
    cut = replace(seen, track_id=seen.track_id + 10_000 * (seen.frame >= 40) + 10_000 * (seen.frame >= 80))
    card = card_of(replace(walking, observations=cut), walking_fit)
    assert (card.blind_intervals, card.intervals) == (2, walking.frame_count - 1)


def test_the_record_has_what_the_text_says(walking: Sequence, walking_fit: Fit) -> None:
    card = card_of(walking, walking_fit)
    record = card_record(card)
    assert record.words == tuple(card_lines(card))
    assert record.correlated and record.offset_px[1] == pytest.approx(card.noise.offset_px[1], rel=1e-5)
    assert all(line in card_text(walking, card, None) for line in record.words)


def test_the_command_prints_the_card_and_writes_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    target = tmp_path / "card.json"
    assert main(["card", "drive", "--max-frames", "50", "--json", str(target)]) == 0
    record = read_card(target)
    assert json.loads(target.read_text(encoding="utf-8"))["schema"] == "vislam.card/1"
    printed = capsys.readouterr().out
    assert all(line in printed for line in record.words)


def test_the_command_refuses_a_recording_without_tracks_in_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["card", "drive", "--max-frames", "4"]) == DataError.exit_status
    assert "too few to fit their noise" in capsys.readouterr().err


def test_a_report_and_its_page_have_the_card_where_the_noise_was_fitted(walking: Sequence, tmp_path: Path) -> None:
    settings = settings_of({"noise": {"tracks": "fitted"}}, "test")
    comparison = run(Plan((walking.truncated(50),), ("dead-reckoning",), settings=settings, workers=1))[0]
    assert comparison.card is not None
    report, words = report_document(comparison), tuple(card_lines(comparison.card))
    assert report.card == card_record(comparison.card)
    assert "## Its tracks" in report_text(comparison, {})
    assert all(line in comparison_text(comparison, width=None) for line in words)
    assert "fitted to the whole recording, which causal answers use too early" in comparison_text(
        comparison, width=None
    )
    assert any("causal answers use it too early" in fact for fact in report.words.facts)
    write_run(comparison, tmp_path / "run", MadeBy("vislam compare", Configuration()))
    assert tuple(payload_of([read_run(tmp_path / "run")])["cases"][0]["card"]) == words


def test_a_report_has_no_card_that_nobody_requested(walking: Sequence) -> None:
    comparison = run(Plan((walking.truncated(20),), ("dead-reckoning",), workers=1))[0]
    assert comparison.card is None
    assert '"card"' not in to_line(report_document(comparison))


def test_a_card_that_cannot_be_had_costs_a_comparison_nothing_and_is_told(walking: Sequence) -> None:
    settings = settings_of({"card": True}, "test")
    comparison = run(Plan((walking.truncated(4),), ("dead-reckoning",), settings=settings, workers=1))[0]
    assert (comparison.card, comparison.runs[0].status) == (None, "ok")
    text = comparison_text(comparison, width=None)
    assert "no card of its tracks: " in text and "too few to fit their noise" in text
