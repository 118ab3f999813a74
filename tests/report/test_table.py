"""The table says everything a reader needs, in 100 characters, with the noise that was assumed above it."""

import os
from dataclasses import replace
from pathlib import Path

import pytest

from tests.report.conftest import rescored
from toolkit.audit import Finding
from toolkit.experiment.comparison import Comparison, Row
from toolkit.experiment.pipeline import Plan, run
from toolkit.measurements import NS_PER_S
from toolkit.metrics import Scores, known_metrics, metrics_called
from toolkit.noise import MeasuredNoise, MotionScale, TrackWeight
from toolkit.registry import discover
from toolkit.report import text as texts
from toolkit.report.comparison_table import change_lines, comparison_table, comparison_text, report_text
from toolkit.report.evaluation import best_of
from toolkit.report.headers import explained_metrics, header_lines, noise_line, rules_line, shown_metrics
from toolkit.report.messages import note_lines
from toolkit.report.records import read_manifest
from toolkit.report.run_directory import MadeBy, write_run
from toolkit.report.text import Table, as_markdown, as_text, heading, number, unit_of
from toolkit.sequence import Provenance
from toolkit.settings import Noise, Settings
from toolkit.simulation import SCENARIOS, simulate


def test_every_output_of_every_run_has_a_line_or_shares_one(comparison: Comparison) -> None:
    lines = [line.split()[:3] for line in as_text(comparison_table(comparison)).splitlines()]
    for row in comparison.rows:
        label = "both" if row.run.final_is_causal else row.output
        assert lines.count([row.estimator, label, row.status]) == 1


def test_pairs_and_coverage_that_all_rows_share_stand_above_the_table(comparison: Comparison) -> None:
    heads = [lines[0] for lines in comparison_table(comparison).headings]  # one run of it gave no answer
    assert heads[3:5] == ["cover", "pairs"]
    assert "scored:" not in comparison_text(comparison)
    answered = replace(comparison, outcomes=tuple(outcome for outcome in comparison.outcomes if outcome.outputs))
    shared = {"pairs": 120.0, "coverage_percent": 97.5}
    same = rescored(answered, lambda row: Scores(row.scores.values | shared, {}))
    assert comparison_text(same).splitlines()[1] == "scored: coverage 97.5 %, pairs 120"
    assert "pairs" not in as_text(comparison_table(same))


def test_a_budget_of_tracks_that_leaves_some_out_stands_above_the_table(comparison: Comparison) -> None:
    assert "tracks a frame" not in rules_line(comparison)
    limited = replace(comparison, sequence=replace(comparison.sequence, track_budget=12))
    visible = len(comparison.sequence.visible) / comparison.sequence.frame_count
    assert f"at most 12 of {visible:.0f} tracks a frame" in rules_line(limited)


def test_a_mark_stands_below_how_the_run_ended_and_beside_it_in_markdown() -> None:
    table = Table((("name",), ("output",), ("status",), ("m",)), (("ekf", "both", "ok", "0.1"),) * 2, 3)
    marked = table._replace(marks=("overconfident", ""))
    assert as_text(marked).splitlines()[2:4] == ["ekf   both    ok      0.1", "              overconfident"]
    assert "| ok, overconfident |" in as_markdown(marked)


def test_a_real_drive_leads_with_drift_and_the_error_that_keeps_the_vertical(comparison: Comparison) -> None:
    driven = rescored(comparison, lambda row: Scores(dict(row.scores.values) | {"kitti_t_percent": 1.0}))
    real = replace(driven, sequence=replace(driven.sequence, provenance=Provenance("kitti", "a drive")))
    usual, of_real = ([metric.key for metric in shown_metrics(one)] for one in (driven, real))
    # Before them stand only pairs and coverage, in which these rows differ.
    assert [key for key in of_real if key not in ("pairs", "coverage_percent")][:3] == [
        "kitti_t_percent",
        "ate_yaw_m",
        "ate_se3_m",
    ]
    assert "kitti_t_percent" not in usual
    assert set(usual) - set(of_real) <= {"rpe_100m_percent"}
    assert "kitti_t_percent" in {metric.key for metric in explained_metrics(real)}


@pytest.mark.parametrize(
    ("value", "text"),
    [
        *[(0.0, "0"), (0.0237, "0.0237"), (0.123, "0.123"), (9.996, "10.0"), (99.96, "100"), (15.8, "15.8")],
        *[(123.456, "123"), (-0.5, "-0.500"), (26509.65, "26510"), (3.2e11, "3e+11"), (5.31e-4, "5.3e-4")],
    ],
)
def test_a_number_has_three_significant_digits_and_its_whole_part(value: float, text: str) -> None:
    assert number(value) == text


@pytest.mark.parametrize(
    ("values_m", "unit"), [([0.05, 0.09, 3.0], "mm"), ([0.05, 0.09, 30.0], "m"), ([0.05, 0.2, 0.3], "m"), ([], "m")]
)
def test_a_column_of_lengths_is_in_millimetres_where_most_are_short_and_none_is_long(
    values_m: list[float], unit: str
) -> None:
    (metric,) = (metric for metric in known_metrics() if metric.key == "ate_se3_m")
    assert unit_of(metric, values_m).name == unit
    (percent,) = (metric for metric in known_metrics() if metric.key == "kitti_t_percent")
    assert unit_of(percent, values_m).name == "%"


def test_what_rounding_makes_equal_is_not_the_best() -> None:
    columns = ([0.00355, 0.00371], [0.003551, 0.003553, 0.00371], [0.00355, 0.00355], [None, 0.1], [0.1], [])
    (metric,) = metrics_called(("ate_se3_m",))
    assert [best_of(values, metric) for values in columns] == [{0}, set(), {0, 1}, {1}, set(), set()]


def test_the_report_has_the_audit_the_start_and_the_facts(comparison: Comparison) -> None:
    words = " ".join(report_text(comparison, {}).split())
    assert comparison.findings[0].detail in words
    assert "not decidable: time-offset, twist-lag: too little change of rotation" in words
    assert comparison.prior.source in words
    assert all(fact in words for fact in comparison.sequence.provenance.facts)


def test_a_warning_of_the_audit_is_a_note_with_its_times(without_truth: Comparison) -> None:
    start_ns = int(without_truth.sequence.frames_t_ns[0])
    spans_ns = ((start_ns + 2 * NS_PER_S, start_ns + 5 * NS_PER_S),)
    warning = Finding("conflict", 1, False, "they disagree", False, warning=True, spans_ns=spans_ns)
    warned = replace(without_truth, findings=(warning,))
    for text in (comparison_text(warned), report_text(warned, {})):
        assert "conflict: vision and the measured motion disagree" in text
        assert "distrust 2-5 s" in text
    assert "distrust" not in comparison_text(without_truth)


def test_below_the_table_stand_the_verdict_and_the_most_harmful_notes_and_no_more(comparison: Comparison) -> None:
    below = comparison_text(comparison).split("\n\n")[-1].splitlines()
    assert below[0].startswith("Nothing to compare") or "steady" in below[0]
    assert len(below) <= 7
    assert any("astray diverged" in line for line in below)
    assert f"{len(list(note_lines(comparison))) - 3} more in report.md" in below[-1] + below[-2]


def test_remarks_are_reported_once_and_those_on_the_vertical_beside_the_table(comparison: Comparison) -> None:
    def remarked(row: Row) -> Scores:
        values = dict(row.scores.values) | {"ate_yaw_m": 1.0, "reproj_median_px": 1.0, "reproj_rmse_px": 1.0}
        notes = {"ate_yaw_m": "tilted", "reproj_median_px": "half of them", "reproj_rmse_px": "half of them"}
        return Scores(values, notes)

    messages = rescored(replace(comparison, outcomes=comparison.outcomes[:1]), remarked)
    assert "ate_yaw_m: tilted" in comparison_text(messages)
    assert "half of them" not in comparison_text(messages)
    report = report_text(messages, {})
    assert "- reproj_median_px and reproj_rmse_px: half of them" in report
    assert report.count("tilted") == 1


@pytest.mark.parametrize(("columns", "width"), [(80, 80), (200, texts.WIDTH), (7, 40)])
def test_prose_is_as_wide_as_the_terminal_and_no_wider_than_tables(
    columns: int, width: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(texts, "get_terminal_size", lambda _: os.terminal_size((columns, 24)))
    assert texts.width_of_output() is None  # read by a program: not wrapped
    monkeypatch.setattr("sys.stdout.isatty", lambda: True, raising=False)
    assert texts.width_of_output() == width
    lines = texts.filled("word " * 100, texts.width_of_output(), "notes: ", "       ").splitlines()
    assert max(map(len, lines)) <= width


def test_the_widest_default_table_fits_100_characters() -> None:
    """The estimators there are, every column there can be, errors of six characters, and a ladder below."""
    metrics = [metric for metric in known_metrics() if metric.table != "on request"]
    cells = [
        "0.0123" if metric.best != "most" and metric.unit not in ("s", "ms", "") else "12.34" for metric in metrics
    ]
    rows = tuple((name, "causal", "diverged", *cells) for name in discover())
    labels = (("estimator", "", ""), ("output", "", ""), ("status", "", ""))
    under = tuple(change_lines((name, entry.change()) for name, entry in discover().items()))
    table = Table((*labels, *(heading(metric, unit_of(metric, [])) for metric in metrics)), rows, len(labels), under)
    assert max(map(len, as_text(table).splitlines())) <= 100


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
        (MeasuredNoise(motion=MotionScale(5.0, 0.3, 20.0)), Noise(measured_s=30.0), ("white", "odometry 5 +-", "30 s")),
        (MeasuredNoise(why_not="3 frames are too few"), Noise(), ("not measured: 3 frames are too few",)),
        (None, Noise(track_weight=1.0, motion_scale=2.0), ("at 1 of its information, as set", "2 times as noisy")),
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
    write_run(comparison, tmp_path / "run", MadeBy("vislam compare"))
    assert read_manifest(tmp_path / "run" / "manifest.json").noise == comparison.measured
