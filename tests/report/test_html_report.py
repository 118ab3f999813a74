"""The page shows the run directory's numbers, needs nothing but itself, and takes no text of a recording for code."""

import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from toolkit.errors import DataError
from toolkit.experiment.comparison import Comparison
from toolkit.report.html import page_text
from toolkit.report.html.payload import highlights, payload_of, running_median, with_peaks
from toolkit.report.messages import ContestRecord, Rival
from toolkit.report.run_directory import MadeBy, read_run, write_run

Json = dict[str, Any]
HOSTILE = "</script><script>window.broken = 1</script><!-- <img src=x onerror=alert(1)> {{ script }} \u2028"


@pytest.fixture(scope="module")
def case(run_directory: Path) -> Json:
    one: Json = payload_of([read_run(run_directory)])["cases"][0]
    return one


@pytest.fixture(scope="module")
def page(run_directory: Path) -> str:
    return page_text(payload_of([read_run(run_directory)]))


def embedded(page: str) -> Json:
    (text,) = re.findall(r'<script type="application/json" id="payload">(.*?)</script>', page, flags=re.S)
    payload: Json = json.loads(text)
    return payload


def row(case: Json, estimator: str) -> Json:
    (found,) = [one for one in case["rows"] if one["estimator"] == estimator]
    assert isinstance(found, dict)
    return found


def test_every_number_is_that_of_metrics_json(page: str, run_directory: Path) -> None:
    reported = json.loads((run_directory / "metrics.json").read_text())
    (case,) = embedded(page)["cases"]
    by_line = {(run["estimator"], run["output"]): run for run in reported["runs"]}
    for one in case["rows"]:
        run = by_line[one["estimator"], "causal" if one["output"] == "both" else one["output"]]
        assert one["metrics"] == run["metrics"]
        assert one["notes"] == run["notes"]
        assert one["status"] == run["status"]
    assert case["sequence"] == reported["sequence"]
    shown = {column["key"] for column in embedded(page)["columns"]}
    assert {key for run in reported["runs"] for key in run["metrics"]} <= shown


@pytest.mark.parametrize("estimator", ["steady", "late"])
def test_tracks_are_aligned_as_the_metric_says(case: Json, estimator: str) -> None:
    one = row(case, estimator)
    truth, track = case["truth"], one["track"]
    assert np.allclose(truth["t_s"], track["t_s"], atol=1e-3)
    offsets = [np.array(track[axis]) - np.array(truth[axis]) for axis in "xyz"]
    rmse_m = np.sqrt(np.mean(np.sum(np.square(offsets), axis=0)))
    assert rmse_m == pytest.approx(one["metrics"]["ate_se3_m"], abs=2e-3)  # drawn to the millimetre


@pytest.mark.usefixtures("unrendered")
def test_without_truth_there_is_a_page_too(without_truth: Comparison, tmp_path: Path) -> None:
    write_run(without_truth, tmp_path / "run", MadeBy("vislam compare"))
    (case,) = payload_of([read_run(tmp_path / "run")])["cases"]
    assert case["truth"] is None
    assert case["error"]["what"].startswith("difference from")


def test_nothing_is_fetched(page: str) -> None:
    markup = re.sub(r"<script.*?</script>", "", page, flags=re.S)
    assert not re.search(r"\b(src|href)\s*=\s*(?![\"']?#)", markup)
    assert "@import" not in page
    assert "url(" not in page
    assert not re.search(r"\b(fetch|import|XMLHttpRequest|WebSocket|sendBeacon)\s*\(", page)
    assert "default-src 'none'" in page


def test_a_hostile_name_stays_text(run_called: Callable[[str], Path], page: str) -> None:
    text = page_text(payload_of([read_run(run_called(HOSTILE))]))
    for mark in ("<script", "</script", "<!--", "<img"):
        assert text.count(mark) == page.count(mark)
    assert embedded(text)["cases"][0]["title"] == HOSTILE


def test_thinning_keeps_peaks_and_ends() -> None:
    values = np.random.default_rng(0).normal(size=20_000)
    values[777], values[15_000], values[5] = 50.0, -60.0, np.nan
    kept = with_peaks(values, 1200)
    assert kept.size <= 1200
    assert {0, 777, 15_000, 19_999} <= set(kept.tolist())
    assert np.all(np.diff(kept) > 0)
    assert with_peaks(values[:100], 1200).tolist() == list(range(100))


def test_the_running_median_ignores_a_single_spike_and_what_is_missing() -> None:
    values: list[float | None] = [2.0] * 40
    values[20], values[3], values[4] = 900.0, None, None
    assert running_median(values) == [2.0] * 40
    assert running_median([None, None]) == [None, None]


@pytest.mark.parametrize(
    ("winner", "leaders", "mark", "answer", "row"),
    [
        ("one", ("one",), "", "one", "one"),
        (None, ("one", "other"), "", "no clear winner", None),
        (None, ("one",), "overconfident", "no winner", None),
    ],
)
def test_a_card_names_whom_the_contest_does_and_a_marked_row_wins_nothing(
    winner: str | None, leaders: tuple[str, ...], mark: str, answer: str, row: str | None
) -> None:
    first = Rival(estimator="one", output="causal", value=3.0, ratio=None, interval=None)
    other = Rival(estimator="other", output="causal", value=4.0, ratio=1.3, interval=(0.9, 1.8))
    ranked = {"metric": "ate_yaw_m", "by": "stretches of the path", "rivals": (first, other)}
    contest = ContestRecord(question="accuracy in the end", leaders=leaders, winner=winner, **ranked)
    rows = [{"id": name, "estimator": name, "output": "both", "mark": mark} for name in ("one", "other")]
    card = highlights([contest], rows, "one run")[0]
    assert (card["answer"], card["row"]) == (answer, row)
    assert "ATE yaw 3.00" in card["detail"]


def edited(change: Callable[[Json], object]) -> Callable[[str], str]:
    """Return what changes a JSON document."""

    def apply(text: str) -> str:
        document = json.loads(text)
        change(document)
        return json.dumps(document)

    return apply


@pytest.mark.parametrize(
    ("name", "spoil", "expected"),
    [
        ("report.json", None, "has no report.json: an earlier version wrote it, or that was removed; repeat it"),
        ("metrics.json", lambda _: "{}", "has not the schema vislam.metrics/1"),
        ("trajectories/late_final.tum", None, "late_final.tum is missing; repeat the comparison"),
        ("trajectories/late_final.tum", lambda _: "1 2 3\n", "columns"),
        ("landmarks/late.csv", lambda _: "track_id,x_m,y_m,z_m\n1,two,3,4\n", "late.csv"),
        ("report.json", edited(lambda d: d["runs"].pop()), "does not have the runs of metrics.json"),
        (
            "report.json",
            edited(lambda d: d["maps"][0].update(estimator="nobody")),
            "has the map of a run it does not have",
        ),
    ],
)
def test_a_damaged_run_directory_is_reported_in_one_line(
    run_directory: Path, tmp_path: Path, name: str, spoil: Callable[[str], str] | None, expected: str
) -> None:
    file = Path(shutil.copytree(run_directory, tmp_path / "run")) / name
    text = file.read_text()
    file.unlink()
    if spoil is not None:
        file.write_text(spoil(text))
    with pytest.raises(DataError, match=re.escape(expected)):
        read_run(tmp_path / "run")
