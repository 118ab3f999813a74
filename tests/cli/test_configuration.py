"""What a comparison is asked for: files of settings, single settings, columns, and a run repeated from its manifest."""

import json
import re
from pathlib import Path
from typing import Any

import pytest

from toolkit.cli import parser
from toolkit.metrics import cost, known_metrics

pytestmark = pytest.mark.usefixtures("unrendered", "one_process")
QUICK = ("--max-frames", "10", "--workers", "1", "--figures", "none")
COST = {metric.key for metric in cost.METRICS}


def manifest(run: str = "run") -> dict[str, Any]:
    read: dict[str, Any] = json.loads(Path(run, "manifest.json").read_text())
    return read


def metrics(run: str) -> list[dict[str, Any]]:
    """Return the scores of a run directory without those of its cost."""
    runs: list[dict[str, Any]] = json.loads(Path(run, "metrics.json").read_text())["runs"]
    for one in runs:
        one["metrics"] = {key: value for key, value in one["metrics"].items() if key not in COST}
    return runs


def test_a_file_says_what_is_compared_and_with_which_settings(vislam, capsys):
    Path("run.toml").write_text(
        'start = "truth"\nfirst_seed = 7\n'
        "[window]\nlag_s = 3.0\n[noise]\npixel_sigma_px = 0.7\n"
        '[compare]\nsequences = ["drive-imu"]\nestimators = ["dead-reckoning"]\nmax_frames = 8\nkeep = ["time-gap"]\n'
    )
    assert vislam("compare", "--config", "run.toml", "--out", "run") == 0
    assert "started from the truth" in capsys.readouterr().out
    document = manifest()
    assert (document["sequence"]["name"], document["estimators"]) == ("drive-imu", ["dead-reckoning"])
    assert document["seeds"] == {"sequence": 7}
    assert "truth" in document["start"]
    assert document["settings"]["window"]["lag_s"] == 3.0
    assert document["settings"]["noise"]["pixel_sigma_px"] == 0.7
    assert (document["compare"]["max_frames"], document["compare"]["keep"]) == (8, ["time-gap"])
    assert json.loads(Path("run/metrics.json").read_text())["sequence"]["frames"] == 8


def test_what_the_command_line_says_by_options_or_by_set_goes_before_the_file(vislam):
    Path("run.toml").write_text(
        'start = "truth"\nfirst_seed = 7\n[window]\nlag_s = 3.0\nmost_states = 9\n'
        '[compare]\nsequences = ["drive-imu"]\nestimators = ["batch"]\nmax_frames = 8\n'
    )
    words = ("drive", "--estimators", "dead-reckoning", "--max-frames", "5", "--seed", "2", "--start", "measurements")
    # What an option and --set both say may be said twice.
    given = ("--set", "window.lag_s=4", "--window", "4s", "--set", "first_seed=2", "--set", "start=measurements")
    assert vislam("compare", "--config", "run.toml", *words, *given, "--out", "run") == 0
    document = manifest()
    settings = document["settings"]
    assert (settings["window"]["lag_s"], settings["window"]["most_states"]) == (4.0, 9)
    assert (settings["first_seed"], settings["start"]) == (2, "measurements")
    assert (document["compare"]["sequences"], document["compare"]["estimators"]) == (["drive"], ["dead-reckoning"])
    assert document["compare"]["max_frames"] == 5


def test_a_run_is_repeated_from_its_manifest(vislam):
    """With whatever changed the first: settings, start, seed, cut."""
    words = ("--estimators", "dead-reckoning,ekf", "--max-frames", "12", "--seed", "3", "--start", "truth")
    changed = ("--set", "noise.pixel_sigma_px=0.7", "--no-repair")
    assert vislam("compare", "drive", *words, *changed, "--out", "once") == 0
    assert vislam("compare", "--config", "once/manifest.json", "--out", "again") == 0
    assert metrics("again") == metrics("once")
    once, again = manifest("once"), manifest("again")
    for expected in (once, again):
        for key in ("command", "date", "threads"):
            del expected[key]
    assert again == once


@pytest.mark.parametrize("width", ["40", "400"])
def test_piped_output_is_never_wrapped_or_cut(vislam, capsys, monkeypatch, width):
    monkeypatch.setenv("COLUMNS", width)
    words = ("compare", "drive", "--estimators", "dead-reckoning", *QUICK, "--out", "run", "--columns", "all")
    assert vislam(*words) == 0
    *heads, rule, line = capsys.readouterr().out.partition("\n\n")[2].partition("\n\n")[0].strip().splitlines()
    with_value = [key for key, value in json.loads(Path("run/metrics.json").read_text())["runs"][0]["metrics"].items()]
    columns = len(re.findall("-+", rule))
    assert len(rule) > 100
    assert columns == len(line.split())
    assert 3 + 10 < columns <= 3 + len(with_value) <= 3 + len(known_metrics())
    assert max(map(len, heads)) <= len(rule)


@pytest.mark.parametrize(
    ("text", "seconds"), [("3", 3.0), ("3s", 3.0), (" 500ms ", 0.5), ("2min", 120.0), ("1e-1s", 0.1)]
)
def test_every_option_in_seconds_reads_the_same_words(text, seconds):
    options = parser().parse_args(["compare", "drive", "--window", text, "--from", text, "--to", text])
    read = [vars(options)["--window=window.lag_s"], options.from_s, options.to_s]
    read.append(parser().parse_args(["simulate", "drive", "--out", "s", "--duration", text]).duration)
    assert read == pytest.approx([seconds] * 4)


def test_what_is_no_duration_is_refused(capsys):
    for text in ("3m", "s", "3 s s", "nan", "inf", "-1s", "0"):
        with pytest.raises(SystemExit):
            parser().parse_args(["simulate", "drive", "--out", "s", f"--duration={text}"])
        assert "argument --duration: expected seconds" in capsys.readouterr().err
