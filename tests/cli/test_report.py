"""``vislam report``: where the page goes, what may be laid side by side, and one line for what cannot be shown."""

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

Vislam = Callable[..., int]
OneLine = Callable[[], str]

pytestmark = pytest.mark.usefixtures("unrendered")

QUICK = ("--estimators", "dead-reckoning", "--max-frames", "10", "--workers", "1", "--figures", "none")


def payload_of(page: Path) -> dict[str, Any]:
    text = page.read_text(encoding="utf-8")
    (found,) = re.findall(r'<script type="application/json" id="payload">(.*?)</script>', text, flags=re.S)
    payload: dict[str, Any] = json.loads(found)
    return payload


def test_the_page_goes_into_the_run_directory(
    vislam: Vislam, short_run: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    capsys.readouterr()
    assert vislam("report", "run") == 0
    messages = capsys.readouterr()
    assert messages.out == "report: run/report.html\n"
    assert messages.err == ""
    (case,) = payload_of(short_run / "report.html")["cases"]
    assert case["title"] == "drive"
    assert vislam("compare", "drive", *QUICK, "--out", "run") == 0  # the run directory is still one of ours


def test_several_runs_make_one_page_beside_them(vislam: Vislam) -> None:
    assert vislam("compare", "drive", "drive-imu", *QUICK, "--out", "all") == 0
    assert vislam("report", "all/drive", "all/drive-imu", "all/drive") == 0
    titles = [case["title"] for case in payload_of(Path("report.html"))["cases"]]
    assert titles == ["drive (all/drive)", "drive-imu", "drive (all/drive)"]
    assert vislam("report", "all") == 0
    assert [case["title"] for case in payload_of(Path("all/report.html"))["cases"]] == ["drive", "drive-imu"]
    assert vislam("compare", "drive", "drive-imu", *QUICK, "--out", "all") == 0  # the page is in nobody's way
    assert vislam("report", "all/drive", "--out", "pages/one.html") == 0
    assert Path("pages/one.html").is_file()
    (Path("all/drive") / "manifest.json").unlink()  # nothing is left out in silence
    assert vislam("report", "all") == 3


def test_a_comparison_over_seeds_has_a_page(vislam: Vislam, short_run: Path) -> None:
    quick = ("--estimators", "ekf", "--max-frames", "10", "--seeds", "2", "--workers", "1")
    assert vislam("compare", "drive", *quick, "--out", "seeds") == 0
    assert vislam("report", "seeds", str(short_run), "--out", "both.html") == 0
    seeds, run = payload_of(Path("both.html"))["cases"]
    assert [seeds["kind"], run["kind"]] == ["seeds", "run"]
    document = json.loads(Path("seeds/seeds.json").read_text())
    (row,) = seeds["rows"]
    assert row["output"] == "both"
    assert row["metrics"]["ate_none_m"] == document["runs"][0]["metrics"]["ate_none_m"]["mean"]
    assert row["values"]["ate_none_m"] == document["runs"][0]["metrics"]["ate_none_m"]["values"]
    assert len(row["nees"]["pose"]) == len(row["errors"]["position_m"]) == 10


@pytest.mark.parametrize(
    ("words", "status", "why"),
    [
        ((), 2, "RUN_DIR"),
        (("nowhere",), 3, "nowhere is not a directory"),
        (("empty",), 3, "empty is not a run directory"),
        (("run", "--out", "empty"), 4, "empty is a directory"),
        (("run", "--out", "file/report.html"), 4, "file/report.html cannot be written"),
    ],
)
def test_trouble_is_reported_in_one_line(
    vislam: Vislam,
    capsys: pytest.CaptureFixture[str],
    one_line: OneLine,
    short_run: Path,
    words: tuple[str, ...],
    status: int,
    why: str,
) -> None:
    Path("empty").mkdir()
    Path("file").touch()
    capsys.readouterr()
    assert vislam("report", *words) == status
    assert why in one_line()
    assert list(Path("empty").iterdir()) == []


def test_a_run_of_an_earlier_version_says_how_to_repeat_it(
    vislam: Vislam, short_run: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (short_run / "report.json").unlink()
    assert vislam("report", str(short_run)) == 3
    assert "repeat it: vislam compare drive" in capsys.readouterr().err
