"""Comparisons within a program say what the command line says, and take estimators that are no files."""

from dataclasses import replace

import pytest
from matplotlib.figure import Figure
from toolkit.experiment.monte_carlo import OverSeeds
from toolkit.report.comparison import Comparison
from toolkit.report.interactive import columns_of, compare, compare_over_seeds, figures, table

from toolkit.audit import faults
from toolkit.datasets import load_sequence
from toolkit.errors import VislamError
from toolkit.estimator import LADDER, find
from toolkit.report.table import comparison_table

FRAMES = 20


@pytest.fixture(scope="module")
def comparison() -> Comparison:
    return compare("drive", ["dead-reckoning", "ekf"], max_frames=FRAMES)


@pytest.fixture(scope="module")
def over() -> OverSeeds:
    return compare_over_seeds("drive", ["dead-reckoning"], 2, max_frames=FRAMES, workers=2)


def test_a_sequence_and_its_source_give_the_same(comparison: Comparison) -> None:
    again = compare(load_sequence("drive"), ["dead-reckoning", "ekf"], max_frames=FRAMES)
    for row, other in zip(comparison.rows, again.rows, strict=True):
        assert row.scores.values["ate_se3_m"] == other.scores.values["ate_se3_m"]


def test_an_estimator_that_is_no_file_is_compared_under_its_own_name(comparison: Comparison) -> None:
    with_own = compare("drive", ["ekf"], own={"mine": find("dead-reckoning").load()}, max_frames=FRAMES)
    assert [run.estimator for run in with_own.runs] == ["ekf", "mine"]
    assert with_own.rows[-1].scores.values["ate_se3_m"] == comparison.rows[0].scores.values["ate_se3_m"]


def test_faults_that_are_kept_are_not_repaired() -> None:
    drive = load_sequence("drive")
    uv_px = drive.observations.uv_px.copy()
    uv_px[::97, 1] = uv_px[::97, 0]  # no disparity
    faulty = replace(drive, observations=replace(drive.observations, uv_px=uv_px))
    found = {keep: compare(faulty, [], keep=keep, max_frames=FRAMES).findings for keep in ((), tuple(faults()))}
    assert [[finding.repaired for finding in findings] for findings in found.values()] == [[True], [False]]


def test_only_the_ladder_tells_what_its_rungs_change(comparison: Comparison) -> None:
    assert not comparison.changes
    assert compare("drive", [LADDER], max_frames=2).changes["ekf"]


def test_a_table_has_the_columns_asked_for_in_their_order(comparison: Comparison) -> None:
    whole, chosen = comparison_table(comparison), table(comparison, "NIS mean", "ATE SE(3)").table
    assert [heading[:2] for heading in chosen.headings[whole.labels :]] == [("NIS", "mean"), ("ATE", "SE(3)")]
    at = [heading[:2] for heading in whole.headings].index(("ATE", "SE(3)"))
    assert [row[-1] for row in chosen.rows] == [row[at] for row in whole.rows]


def test_an_unknown_column_is_refused(comparison: Comparison) -> None:
    with pytest.raises(VislamError, match="no column is called ATE"):
        table(comparison, "ATE")


def test_a_table_is_text_and_markdown(comparison: Comparison) -> None:
    shown = table(comparison, "ATE SE(3)")
    assert " ATE SE(3) [m] |" in shown._repr_markdown_()
    assert "dead-reckoning" in str(shown)
    assert repr(shown) == str(shown)


def test_figures_come_by_name(comparison: Comparison, over: OverSeeds) -> None:
    assert {"top_all", "top_ekf", "errors_over_time"} <= figures(comparison).keys()
    drawn = figures(over)
    assert set(drawn) == {"errors_over_seeds", "nees_over_seeds"}
    assert all(isinstance(figure, Figure) for figure in drawn.values())


def test_seeds_are_repeated_and_their_table_has_columns_by_name(over: OverSeeds) -> None:
    assert over.seeds == (0, 1)
    assert "NEES pose" in columns_of(over)
    assert len(table(over, "NEES pose").table.rows) == len(over.groups)
